"""``ems policy``: what is known about a policy file."""

from pathlib import Path
from typing import Annotated

import typer

from tractor_ems.cli.output import JsonFlag, print_json

app = typer.Typer(help="Policy files.", no_args_is_help=True)


@app.callback()
def _policy() -> None:
    """Policy files."""


@app.command("card")
def card(
    policy: Annotated[
        str,
        typer.Argument(
            help="Policy file, or a powertrain's name for the one that ships.", metavar="FILE"
        ),
    ],
    scores: Annotated[
        Path | None,
        typer.Option(
            help="JSON with its scores, shaped like docs/data/held_out.json; default FILE with "
            ".scores.json, or what the policy file says."
        ),
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Markdown file to write.")] = None,
    json: JsonFlag = False,
) -> None:
    """What a policy is, was made of, has seen and must not be used for, as Markdown."""
    from tractor_ems.policies.card import card_of, markdown
    from tractor_ems.policies.shipped import shipped_policy
    from tractor_msgs_py.atomic import write_bytes

    path = Path(policy) if policy.endswith(".safetensors") else shipped_policy(policy)
    found = card_of(path, scores)
    if out is not None:
        write_bytes(out, markdown(found).encode())
    if json:
        print_json(found.to_json() | {"out": None if out is None else str(out)})
    elif out is None:
        print(markdown(found), end="")
