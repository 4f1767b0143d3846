"""``ems cycle``: which cycles there are, what one looks like, new ones, and ones of your own."""

from pathlib import Path
from typing import Annotated, Any, get_args

import numpy as np
import typer

from tractor_ems.cli.output import JsonFlag, print_json, print_result, print_table
from tractor_msgs_py.errors import ConfigError
from tractor_sim.duty_cycle.cycle import DEMAND_LIMIT_W, DutyCycle, Split, cycle_hash

app = typer.Typer(help="Duty cycles.", no_args_is_help=True)

Force = Annotated[bool, typer.Option("--force", help="Replace a file that exists.")]


def _row(cycle: DutyCycle) -> dict[str, Any]:
    return {
        "name": cycle.name,
        "operation": cycle.operation,
        "split": cycle.split,
        "seed": cycle.seed,
        "duration_s": len(cycle) * cycle.dt_s,
        "mean_w": float(cycle.power_demand_w.mean()),
        "peak_w": float(cycle.power_demand_w.max()),
        "source": cycle.source,
    }


@app.command("list")
def list_cycles(
    split: Annotated[
        str | None,
        typer.Option("--set", "--split", help="Only of train, validation or held-out."),
    ] = None,
    operation: Annotated[str | None, typer.Option(help="Only of this operation.")] = None,
    json: JsonFlag = False,
) -> None:
    """Listed cycles with their split."""
    from tractor_sim.duty_cycle.library import listed_cycles, load_cycle

    known = list(dict.fromkeys(row.operation for row in listed_cycles()))
    if operation is not None and operation not in known:
        raise ConfigError(f"--operation: {operation!r}, allowed {', '.join(known)}")
    rows = [_row(load_cycle(row.name)) for row in listed_cycles(_split(split), operation)]
    if json:
        print_json({"cycles": rows})
        return
    columns = ("name", "split", "seed", "duration_s", "mean_w", "peak_w")
    print_table("", columns, [[row[column] for column in columns] for row in rows])


@app.command("show")
def show(
    cycle: Annotated[str, typer.Argument(help="Listed name, CSV file or bag.")],
    json: JsonFlag = False,
) -> None:
    """One cycle: statistics and hash; with --json its samples too."""
    from tractor_ems.scenario import resolve_cycle

    found = resolve_cycle(cycle)
    demand_w = found.power_demand_w
    quantiles = np.quantile(demand_w, (0.05, 0.5, 0.95))
    row = _row(found) | {
        "dt_s": found.dt_s,
        "samples": len(found),
        "energy_j": float(demand_w.sum() * found.dt_s),
        "p05_w": float(quantiles[0]),
        "median_w": float(quantiles[1]),
        "p95_w": float(quantiles[2]),
        "area_ha": found.area_ha,
        "hash": cycle_hash(found),
    }
    if json:
        print_json(row | {"power_demand_w": demand_w.tolist()})
        return
    print_table(found.name, ("quantity", "value"), list(row.items()))


@app.command("generate")
def generate(
    operation: Annotated[str, typer.Argument(help="Kind of work, for instance chisel_plow.")],
    seed: Annotated[int, typer.Option(min=0, help="The same seed gives the same bytes.")],
    out: Annotated[Path, typer.Option(help="CSV file to write.")],
    duration_s: Annotated[
        int | None, typer.Option(help="Length [s], 2..172800; default the operation's.")
    ] = None,
    depth_cm: Annotated[
        float | None, typer.Option(help="Working depth of tillage [cm]; default from the seed.")
    ] = None,
    force: Force = False,
    json: JsonFlag = False,
) -> None:
    """Write one cycle of an operation, listed or new, as CSV."""
    from tractor_ems.cycle_import import check_out
    from tractor_sim.duty_cycle.cycle_csv import write_cycle_csv
    from tractor_sim.duty_cycle.generate import DURATION_MAX_S
    from tractor_sim.duty_cycle.library import generate_cycle
    from tractor_sim.duty_cycle.shipped import with_shipped_split

    check_out(out, force)
    # One sample is a cycle, but a file of one row does not say how long its step is.
    if duration_s is not None and not 2 <= duration_s <= DURATION_MAX_S:
        raise ConfigError(f"--duration-s: {duration_s}, allowed 2..{DURATION_MAX_S}")
    made = generate_cycle(operation, seed, duration_s=duration_s, depth_cm=depth_cm)
    write_cycle_csv(out, made)
    area_ha = made.area_ha
    row = _row(with_shipped_split(made)) | {
        "area_ha": area_ha,
        "hash": cycle_hash(made),
        "file": str(out),
    }
    if json:
        print_json(row)
        return
    print_result(row)


@app.command("import")
def import_(
    source: Annotated[
        Path, typer.Argument(metavar="FILE", help="CSV with time_s,power_demand_w, or a bag.")
    ],
    out: Annotated[Path, typer.Option(help="CSV file to write.")],
    dt: Annotated[float, typer.Option(help="Step of the cycle [s], 0 < dt <= 60.")] = 1.0,
    max_gap_s: Annotated[
        float, typer.Option(help="Longest gap that a straight line fills [s].")
    ] = 10.0,
    max_power_w: Annotated[
        float, typer.Option(help="Larger demand, either way, is dropped; at most 2e6 [W].")
    ] = DEMAND_LIMIT_W,
    max_dropped: Annotated[
        float, typer.Option(help="Share of rows that may be unusable, 0..1.")
    ] = 0.1,
    split_gaps: Annotated[
        bool, typer.Option("--split-gaps", help="Cut at longer gaps, one file per piece.")
    ] = False,
    aux_w: Annotated[
        float | None,
        typer.Option(help="Auxiliaries within the demand, if the recording announces none [W]."),
    ] = None,
    signals: Annotated[
        str | None, typer.Option(help="Signal map of a vehicle's bag: name, or YAML file.")
    ] = None,
    namespace: Annotated[
        str | None, typer.Option(help="Of the map's topics; default the only one that fits.")
    ] = None,
    force: Force = False,
    json: JsonFlag = False,
) -> None:
    """Make a cycle of a recording: even steps, gaps filled, and an account of what was dropped.

    A sample is held until the next and a step is the mean over its time, so energy is kept
    whether samples are closer than the step or further apart.
    """
    from tractor_ems.cycle_import import import_cycle
    from tractor_ems.signals.config import optional_map
    from tractor_sim.duty_cycle.resample import ImportSettings

    settings = ImportSettings(dt, max_gap_s, max_power_w, max_dropped, split_gaps, aux_w)
    paths, account = import_cycle(
        source,
        out,
        settings,
        force=force,
        signals=optional_map(signals, namespace),
        namespace=namespace,
    )
    document = {"source": str(source), "files": [str(path) for path in paths], "dt_s": dt}
    document |= account.to_json()
    if json:
        print_json(document)
        return
    print_result(document)


def _split(text: str | None) -> Split | None:
    if text is None:
        return None
    for split in get_args(Split):
        if text.replace("-", "_") == split:
            found: Split = split
            return found
    raise ConfigError(f"--set: {text!r}, allowed train, validation, held-out")
