"""``ems tune``: settings of baselines, and stochastic DP from recordings."""

from pathlib import Path
from typing import Annotated

import typer

from tractor_ems.cli.output import (
    JsonFlag,
    counting,
    print_json,
    print_result,
    print_table,
    stages,
)

app = typer.Typer(help="Tune baselines; fit stochastic DP.", no_args_is_help=True)

Powertrain = Annotated[str, typer.Option(help="Shipped name or YAML file.")]


@app.command("sdp")
def sdp(
    bags: Annotated[
        list[Path], typer.Option(help="Bags, or folders of bags; repeatable, or several at once.")
    ],
    out: Annotated[Path, typer.Option(help="Policy file to write (.safetensors).")],
    powertrain: Powertrain = "field",
    planned: Annotated[
        bool, typer.Option("--planned/--unplanned", help="Use the planned end of the work.")
    ] = True,
    allow_held_out: Annotated[
        bool, typer.Option(help="Learn from bags of held-out cycles; scores on those then lie.")
    ] = False,
    json: JsonFlag = False,
) -> None:
    """Fit a Markov chain to the demand in bags, solve it, and write the policy file."""
    import time

    from tractor_ems.learning.train import check_output
    from tractor_ems.policies.sdp_file import save_sdp
    from tractor_ems.tuning.sdp_bags import sdp_of_bags
    from tractor_sim.config import load_powertrain

    check_output(out)
    began, params = time.perf_counter(), load_powertrain(powertrain)
    with counting("per cent of the horizon", 100) as done:
        policy = sdp_of_bags(
            bags,
            params,
            planned=planned,
            allow_held_out=allow_held_out,
            progress=lambda share: done(round(100 * share)),
        )
    save_sdp(out, policy)
    report = {
        "policy": str(out),
        "name": policy.name,
        "powertrain": params.name,
        "seconds": time.perf_counter() - began,
        "bags": policy.metadata["bag_hashes"],
        "cycles": policy.metadata["cycles"],
        **policy.metadata["training"],
    }
    if json:
        print_json(report)
    else:
        print_result(report)


@app.command("baselines")
def baselines(
    out: Annotated[Path, typer.Option(help="Folder for logs, page and settings.")],
    powertrain: Powertrain = "field",
    preset: Annotated[str, typer.Option(help="smoke or full, of the grid file.")] = "full",
    grid: Annotated[
        Path | None, typer.Option(help="Grid file; default config/baseline/grid.yaml.")
    ] = None,
    policy: Annotated[
        list[str] | None, typer.Option(help="Only these policies of the grid; several times.")
    ] = None,
    workers: Annotated[
        int | None, typer.Option(min=1, help="Processes; default one per core.")
    ] = None,
    json: JsonFlag = False,
) -> None:
    """Search the settings of every baseline on dev cycles with one objective.

    Writes OUT/POLICY.jsonl (everything tried), OUT/POWERTRAIN.yaml (what was chosen, for
    config/baseline) and OUT/baselines.md. With --policy, what an earlier search left in OUT
    about the others stays.
    """
    import dataclasses
    from json import loads

    from tractor_ems.evaluate_set import cores
    from tractor_ems.tuning.chosen_report import chosen_json, page, settings_yaml
    from tractor_ems.tuning.grid import load_grid
    from tractor_ems.tuning.grid_search import search
    from tractor_msgs_py.atomic import write_bytes, write_json
    from tractor_msgs_py.errors import ConfigError
    from tractor_sim.config import load_powertrain

    params = load_powertrain(powertrain)
    whole = load_grid(params, grid)
    chosen_preset = whole.preset(preset)
    order = tuple(chosen_preset.policies)
    for name in policy or ():
        if name not in chosen_preset.policies:
            known = ", ".join(chosen_preset.policies)
            raise ConfigError(f"--policy: {name!r} is not in preset {preset}, allowed {known}")
    if policy:
        kept = {n: axes for n, axes in chosen_preset.policies.items() if n in policy}
        chosen_preset = dataclasses.replace(chosen_preset, policies=kept)
    with stages() as progress:
        found = search(
            params, whole, chosen_preset, out, workers=workers or cores(), progress=progress
        )
    document = chosen_json(whole, found)
    if policy and (out / "chosen.json").is_file():
        earlier = loads((out / "chosen.json").read_text())
        document = {n: {**earlier, **document}[n] for n in order if n in {**earlier, **document}}
    label = params.name.partition(":")[0]
    command = f"ems tune baselines --powertrain {powertrain} --preset {preset} --out DIR"
    text = page(params, whole, chosen_preset, document, command)
    write_bytes(out / f"{label}.yaml", settings_yaml(params, document).encode())
    write_bytes(out / "baselines.md", text.encode())
    write_json(out / "chosen.json", document)
    if json:
        print_json(document)
        return
    columns = ("median", "mean", "worst", "starts", "short", "soc_mean", "soc_max")
    for title in ("dev", "squeezed"):
        rows = [[name, *(row[title][key] for key in columns)] for name, row in document.items()]
        print_table(title, ("policy", *columns), rows)
