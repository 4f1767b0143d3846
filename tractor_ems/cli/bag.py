"""``ems bag``: what a bag holds, whether it can be trusted, what can be learnt from it."""

import csv
import io
from dataclasses import asdict, fields
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from tractor_ems.cli.bag_signals import check_signals, signals
from tractor_ems.cli.output import JsonFlag, print_json, print_table
from tractor_msgs_py.errors import ConfigError

app = typer.Typer(help="MCAP bags.", no_args_is_help=True)

app.command("signals")(signals)

Bag = Annotated[Path, typer.Argument(help="Bag folder or storage file.")]


@app.command("info")
def info(bag: Bag, json: JsonFlag = False) -> None:
    """Topics, provenance and runs of a bag."""
    from tractor_ems.bags.inspect import info as inspect

    document = inspect(bag)
    if json:
        print_json(document)
        return
    print_table(
        f"{document['bag']}: {document['bytes']} bytes, SHA-256 {document['sha256']}",
        ("topic", "type", "messages"),
        [(topic["name"], topic["type"], topic["messages"]) for topic in document["topics"]],
    )
    for run in document["runs"]:
        print_table("run", ("quantity", "value"), list(run.items()))


@app.command("check")
def check(
    bag: Bag,
    powertrain: Annotated[
        str | None, typer.Option(help="Name or YAML; default the shipped one of the same hash.")
    ] = None,
    signals: Annotated[
        str | None,
        typer.Option(help="Signal map of a vehicle's bag: name, or YAML file (config/signals*)."),
    ] = None,
    namespace: Annotated[
        str | None, typer.Option(help="Of the map's topics; default the only one that fits.")
    ] = None,
    dt: Annotated[
        float | None,
        typer.Option(help="With --signals: period [s]; default the powertrain's, or 0.1."),
    ] = None,
    json: JsonFlag = False,
) -> None:
    """Named checks and a verdict; exit code 0 only for "pass", else 2.

    With --signals: what is covered of a vehicle's own topics, how often, and whether it is
    plausible.
    """
    if signals is not None:
        check_signals(bag, signals, namespace, powertrain, dt, json)
        return
    for option, value in (("--namespace", namespace), ("--dt", dt)):
        if value is not None:
            raise ConfigError(f"{option}: {value}, allowed beside --signals")
    from tractor_ems.bags.check import check as run_checks
    from tractor_sim.config import load_powertrain

    report = run_checks(bag, None if powertrain is None else load_powertrain(powertrain))
    if json:
        print_json(report.to_json())
    else:
        rows = [(item.name, item.outcome, item.detail) for item in report.checks]
        print_table(f"{report.bag}: {report.verdict}", ("check", "outcome", "detail"), rows)
    if report.verdict != "pass":
        raise typer.Exit(2)


@app.command("recover")
def recover(bag: Bag, json: JsonFlag = False) -> None:
    """Finalise a recording that was killed; every flushed message is kept."""
    from tractor_ems.bags.recover import recover as finalise

    done = finalise(bag)
    document = asdict(done) | {"bag": str(done.bag)}
    if json:
        print_json(document)
        return
    print_table(
        f"{done.bag}: recovered, {done.cut_bytes} bytes at the end were unreadable",
        ("topic", "messages"),
        list(done.messages.items()),
    )


@app.command("transitions")
def transitions(
    bags: Annotated[list[Path], typer.Argument(help="Bags, or folders of bags.")],
    out: Annotated[Path | None, typer.Option(help="CSV file for the transitions.")] = None,
    json: JsonFlag = False,
) -> None:
    """What bags offer to a learner: traces, and transitions with the applied power."""
    from tractor_ems.bags.transitions import Transitions, iter_traces, transitions_of
    from tractor_msgs_py.atomic import write_bytes

    traces = iter_traces(bags)
    found = transitions_of(traces)
    document: dict[str, Any] = {
        "bags": len({trace.bag for trace in traces}),
        "transitions": len(found),
        "demand_samples": sum(len(trace) for trace in traces),
        "traces": [
            {
                "bag": trace.bag,
                "run_id": trace.run_id or None,
                "policy": trace.policy or None,
                "cycle": trace.cycle or None,
                "steps": len(trace),
                "dt_s": trace.dt_s,
                "demand_only": trace.demand_only,
                "mean_demand_w": float(np.mean(trace.power_demand_w)),
            }
            for trace in traces
        ],
    }
    if out is not None:
        text = io.StringIO()
        writer = csv.writer(text)
        names = [field.name for field in fields(Transitions)]
        writer.writerow(names)
        writer.writerows(zip(*(getattr(found, name).tolist() for name in names), strict=True))
        write_bytes(out, text.getvalue().encode())
    if json:
        print_json(document)
        return
    columns = ("bag", "policy", "cycle", "steps", "demand_only")
    print_table(
        f"{document['transitions']} transitions in {document['bags']} bags",
        columns,
        [[trace[column] for column in columns] for trace in document["traces"]],
    )
