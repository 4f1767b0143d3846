"""``ems bag signals`` and ``ems bag check --signals``: bags of vehicles with other topics."""

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape

from tractor_ems.cli.output import NOTES, JsonFlag, print_json, print_table

if TYPE_CHECKING:
    from tractor_ems.signals.candidates import Place

DEFAULT_DT_S = 0.1
COLUMNS = (
    "signal",
    "outcome",
    "rate_hz",
    "largest_gap_s",
    "jitter_s",
    "fresh",
    "low",
    "mean",
    "high",
    "detail",
)


def signals(
    bag: Annotated[Path, typer.Argument(help="Bag folder or storage file.")],
    out: Annotated[Path | None, typer.Option(help="YAML file for a draft signal map.")] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace a file that exists.")] = False,
    json: JsonFlag = False,
) -> None:
    """Every topic with its rate and numbers, and which of them may be which signal."""
    from tractor_ems.bags.topic_fields import topic_fields
    from tractor_ems.signals.candidates import candidates, draft
    from tractor_msgs_py.atomic import write_bytes
    from tractor_msgs_py.errors import BagError, ConfigError

    if out is not None and out.suffix not in (".yaml", ".yml"):
        raise ConfigError(f"{out}: a signal map is written as .yaml")
    if out is not None and out.exists() and not force:
        raise ConfigError(f"{out}: exists already (--force replaces it)")
    found = topic_fields(bag)
    guesses = candidates(found)
    if out is not None:
        if not guesses:
            raise BagError(f"{bag}: no number whose name tells a signal, nothing to draft")
        write_bytes(out, draft(bag.name, guesses, found).encode())
    if json:
        print_json(
            {
                "bag": str(bag),
                "topics": [topic.to_json() for topic in found],
                "candidates": [guess.to_json() for guess in guesses],
                "draft": None if out is None else str(out),
            }
        )
        return
    rows = [(_printable(t.name), _printable(t.type), *asdict(t.rhythm).values()) for t in found]
    print_table("topics", ("topic", "type", "messages", "Hz", "jitter s", "gap s"), rows)
    numbers = [
        (_printable(f"{topic.name} {path}"), *list(item.to_json().values())[1:4])
        for topic in found
        for path, item in topic.fields.items()
    ]
    print_table("numbers", ("field", "min", "mean", "max"), numbers)
    print_table(
        "candidates",
        ("signal", "sources", "scale", "sign", "reason"),
        [
            (g.signal, " * ".join(map(_shown, g.factors)), g.scale, g.sign, g.reason)
            for g in guesses
        ],
    )
    for topic in found:
        if topic.unreadable:
            NOTES.print(topic.unreadable, markup=False, highlight=False, soft_wrap=True)


def _shown(place: "Place") -> str:
    return _printable(f"{place.topic} {place.field}")


def _printable(name: str) -> str:
    """A name from a bag, which can hold anything, as text for a table."""
    return escape("".join(c if c.isprintable() else "?" for c in name))


def check_signals(
    bag: Path,
    signals: str,
    namespace: str | None,
    powertrain: str | None,
    dt_s: float | None,
    json: bool,
) -> None:
    """``ems bag check`` of a bag with topics of its own; exit code 0 only for "pass", else 2."""
    from tractor_ems.signals.config import load_signal_map
    from tractor_ems.signals.coverage import check_coverage
    from tractor_msgs_py.errors import ConfigError
    from tractor_sim.config import load_powertrain

    params = None if powertrain is None else load_powertrain(powertrain)
    if dt_s is None:
        dt_s = DEFAULT_DT_S if params is None else params.dt_s
    if not 1e-3 <= dt_s <= 3600.0:
        raise ConfigError(f"--dt: {dt_s}, allowed 0.001..3600")
    report = check_coverage(
        bag, load_signal_map(signals), dt_s, namespace=namespace, params=params
    )
    if json:
        print_json(report.to_json())
    else:
        rows = [
            [*(getattr(item, column) for column in COLUMNS[:-1]), escape(item.detail)]
            for item in report.signals
        ]
        print_table(f"{report.bag} at {dt_s:g} s: {report.verdict}", COLUMNS, rows)
        print_table(
            "",
            ("check", "outcome", "detail"),
            [(item.name, item.outcome, escape(item.detail)) for item in report.findings],
        )
    if report.verdict != "pass":
        raise typer.Exit(2)
