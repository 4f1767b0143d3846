"""``ems vehicle``: is a vehicle plausible, and what do recordings say about it."""

from pathlib import Path
from typing import Annotated, Any

import typer

from tractor_ems.cli.output import JsonFlag, print_json, print_table

app = typer.Typer(help="A vehicle's parameters.", no_args_is_help=True)


@app.command("check")
def check(
    vehicle: Annotated[str, typer.Argument(help="Shipped name or YAML file.", metavar="FILE")],
    plot: Annotated[Path | None, typer.Option(help="PNG of the vehicle's curves.")] = None,
    json: JsonFlag = False,
) -> None:
    """Figures of a vehicle's curves, and which values are implausible and why.

    Exit code 0 whatever is found; 2 for a file that cannot be read or is impossible.
    """
    from tractor_ems.vehicle.check import check as judge

    report, found = judge(vehicle)
    if plot is not None:
        from tractor_ems.vehicle.plots import plot_vehicle

        plot_vehicle(plot, found)
    if json:
        print_json(report.to_json() | {"plot": None if plot is None else str(plot)})
        return
    print_table(report.powertrain, ("figure", "value"), list(report.figures.items()))
    print(_hull_in_words(report.hull))
    rows = [(f.severity, f.field, f.value, f.plausible, f.why) for f in report.findings]
    print_table("", ("severity", "field", "value", "plausible", "why"), rows)


def _hull_in_words(hull: Any) -> str:
    if hull.largest < 1e-4:
        return "Fuel over bus power is convex as it stands in the file."
    name = "The convex hull that is driven" if hull.driven else "The convex hull (not driven)"
    low, high = hull.beyond_1_percent_bus_w or (0.0, 0.0)
    over = f", more than 1 % over {low / 1e3:.1f}..{high / 1e3:.1f} kW" if high else ""
    return (
        f"{name} lies below the data by up to {hull.largest:.2%}, at "
        f"{hull.at_bus_w / 1e3:.1f} kW at the bus ({hull.at_crank_w / 1e3:.1f} kW at the "
        f"crankshaft){over}; in fuel by up to {hull.largest_kg_per_s * 1e3:.3f} g/s. Mean below a "
        f"third of rated power {hull.mean_light:.2%}, above {hull.mean_heavy:.2%}."
    )


@app.command("fit")
def fit(
    bag: Annotated[Path, typer.Argument(help="Bag folder or storage file.")],
    powertrain: Annotated[
        str | None,
        typer.Option(help="Name or YAML file of what the recording cannot say."),
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Powertrain YAML to write.")] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace a file that exists.")] = False,
    json: JsonFlag = False,
) -> None:
    """Fuel curve, start fuel, resistance and capacity from a recording, with errors, and what
    it cannot say."""
    from tractor_ems.vehicle.fit import fit as run
    from tractor_ems.vehicle.fit_yaml import check_out, missing_parts, write_fit

    if out is not None:
        check_out(out, force)
    found = run(bag, powertrain)
    origins = None if out is None else write_fit(found, out)
    document = found.to_json()
    if json:
        written = None if out is None else str(out)
        print_json(
            document | {"missing": missing_parts(found), "out": written, "origins": origins}
        )
        return
    columns = ("parameter", "value", "+-", "verdict", "why")
    rows = [(e.name, e.value, e.error, e.verdict, e.why) for e in found.estimates]
    title = f"{bag}: {document['steps']} steps, {document['steps_on']} with the engine on"
    print_table(title, columns, rows)
    for note in document["notes"]:
        print(note)
    if origins is None:
        return
    print_table(f"{out}", ("part", "origin"), list(origins.items()))
