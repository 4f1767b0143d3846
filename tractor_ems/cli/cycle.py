"""``ems cycle``: which cycles there are, and what one looks like."""

from typing import Annotated, Any

import numpy as np
import typer

from tractor_ems.cli.output import JsonFlag, print_json, print_table
from tractor_sim.duty_cycle.cycle import DutyCycle, cycle_hash

app = typer.Typer(help="Duty cycles.", no_args_is_help=True)


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
def list_cycles(json: JsonFlag = False) -> None:
    """Shipped cycles with their split."""
    from tractor_sim.duty_cycle.library import cycle_names, load_cycle

    rows = [_row(load_cycle(name)) for name in cycle_names()]
    if json:
        print_json({"cycles": rows})
        return
    columns = ("name", "split", "seed", "duration_s", "mean_w", "peak_w")
    print_table("", columns, [[row[column] for column in columns] for row in rows])


@app.command("show")
def show(
    cycle: Annotated[str, typer.Argument(help="Shipped name, CSV file or bag.")],
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
        "hash": cycle_hash(found),
    }
    if json:
        print_json(row | {"power_demand_w": demand_w.tolist()})
        return
    print_table(found.name, ("quantity", "value"), list(row.items()))
