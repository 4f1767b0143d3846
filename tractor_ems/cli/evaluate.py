"""``ems evaluate``: policies over cycles; one run is one result, many are a table."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, get_args

import typer

from tractor_ems.cli.output import JsonFlag, counting, print_json, print_result, print_runs
from tractor_ems.result import Transport
from tractor_msgs_py.errors import ConfigError, RunAborted
from tractor_sim.duty_cycle.cycle import Split

if TYPE_CHECKING:
    from tractor_ems.evaluate_set import Options, Run

Powertrain = Annotated[
    str, typer.Option(help="Shipped name or YAML file; NAME:engine.start_fuel_kg=0.06 changes it.")
]
Cycle = Annotated[str, typer.Option(help="Shipped name, CSV file (time_s,power_demand_w) or bag.")]
Soc0 = Annotated[float | None, typer.Option("--soc0", help="Initial SOC, 0..1.")]


def evaluate(
    policy: Annotated[
        list[str] | None,
        typer.Option(
            help="conventional, rule_based, best_point, myopic_greedy, load_levelling, "
            "never_stop_ecms, ecms, a_ecms, a_ecms_unplanned, dp, default, or a file; several "
            "times or with commas. Default: default."
        ),
    ] = None,
    powertrain: Powertrain = "paper",
    cycle: Annotated[
        list[str] | None,
        typer.Option(
            help="Shipped name, CSV file (time_s,power_demand_w) or bag; several times. "
            "Default: planter."
        ),
    ] = None,
    cycle_set: Annotated[
        list[str] | None,
        typer.Option("--set", help="All cycles of train, validation or held-out; several times."),
    ] = None,
    soc0: Soc0 = None,
    soc_target: Annotated[
        float | None, typer.Option(help="SOC to end at; default the powertrain's, or soc0.")
    ] = None,
    transport: Annotated[str, typer.Option(help="in_process or ros (separate processes).")] = (
        "in_process"
    ),
    record: Annotated[Path | None, typer.Option(help="New bag folder; one run only.")] = None,
    plot: Annotated[
        Path | None, typer.Option(help="PNG with the run's traces; one run only.")
    ] = None,
    allow_other_powertrain: Annotated[
        bool, typer.Option(help="Drive a powertrain the policy was not made for.")
    ] = False,
    signals: Annotated[
        str | None,
        typer.Option(help="Signal map of a vehicle whose bag is the cycle: name, or YAML file."),
    ] = None,
    namespace: Annotated[
        str | None, typer.Option(help="Of the map's topics; default the only one that fits.")
    ] = None,
    soc_guard: Annotated[bool, typer.Option(help="SOC guard of rule_based.")] = True,
    dp: Annotated[bool, typer.Option("--dp/--no-dp", help="Score against DP.")] = True,
    jobs: Annotated[
        int | None, typer.Option(min=1, help="Processes; default one per core.")
    ] = None,
    csv: Annotated[Path | None, typer.Option(help="CSV file with a row per run.")] = None,
    json: JsonFlag = False,
) -> None:
    """Drive policies over cycles and score each run against DP to its own final SOC.

    One policy on one cycle prints its result; --set, several policies or several cycles print a
    table with a row per run and a summary per policy.
    """
    from tractor_ems.evaluate_set import Options, pairs
    from tractor_ems.scenario import is_bag, make_scenario
    from tractor_ems.signals.config import optional_map

    kinds: dict[str, Transport] = {"in_process": "in_process", "ros": "ros"}
    if transport not in kinds:
        raise ConfigError(f"--transport: {transport!r}, allowed {', '.join(kinds)}")
    options = Options(kinds[transport], allow_other_powertrain, soc_guard, dp)
    vehicle = optional_map(signals, namespace)
    if vehicle is not None and transport == "ros":
        raise ConfigError(
            "--signals: allowed with --transport in_process; ems cycle import makes a cycle of "
            "the bag that nodes can drive"
        )
    if vehicle is not None and not any(map(is_bag, _cycles(cycle, cycle_set))):
        raise ConfigError("--signals: no --cycle is a bag, allowed beside one that is")
    scenarios = [
        make_scenario(powertrain, name, soc0, soc_target, signals=vehicle, namespace=namespace)
        for name in _cycles(cycle, cycle_set)
    ]
    runs = pairs(_policies(policy), scenarios)
    if len(runs) == 1 and not cycle_set:
        _one(runs[0], options, record, plot, csv, json)
        return
    for option, value in (("--record", record), ("--plot", plot)):
        if value is not None:
            raise ConfigError(f"{option}: {len(runs)} runs, allowed with one policy on one cycle")
    _many(runs, options, jobs, csv, json)


def _policies(given: list[str] | None) -> list[str]:
    """Names, in order and once each; a file whose name holds a comma is one name."""
    words = [
        name
        for text in given or ["default"]
        for name in ([text] if Path(text).is_file() else text.split(","))
    ]
    if not all(words):
        raise ConfigError("--policy: an empty name")
    return list(dict.fromkeys(words))


def _cycles(given: list[str] | None, sets: list[str] | None) -> list[str]:
    """Cycles of the sets, then the named ones; in order and once each."""
    from tractor_sim.duty_cycle.library import cycle_names

    splits: dict[str, Split] = {split.replace("_", "-"): split for split in get_args(Split)}
    names: list[str] = []
    for text in sets or []:
        split = splits.get(text.replace("_", "-"))
        if split is None:
            raise ConfigError(f"--set: {text!r}, allowed {', '.join(splits)}")
        listed = cycle_names(split)
        if not listed:
            raise ConfigError(f"--set {text}: no cycle is listed in it")
        names += listed
    named = given or ([] if sets else ["planter"])
    return list(dict.fromkeys([*names, *named]))


def _one(
    run: "Run",
    options: "Options",
    record: Path | None,
    plot: Path | None,
    csv: Path | None,
    json: bool,
) -> None:
    from tractor_ems.evaluate import evaluate as drive

    result, trajectory = drive(run.policy, run.scenario, record=record, **vars(options))
    if plot is not None:
        from tractor_ems.plots import plot_runs

        title = f"{result.policy} on {result.cycle}, powertrain {result.powertrain}"
        runs = {result.policy: trajectory}
        plot_runs(plot, title, runs, run.scenario.params, result.soc_target)
    if csv is not None:
        from tractor_ems.summary import write_csv

        write_csv(csv, [result.to_json()])
    if json:
        print_json(result.to_json())
        return
    print_result(result.to_json())


def _many(
    runs: "list[Run]", options: "Options", jobs: int | None, csv: Path | None, json: bool
) -> None:
    """All of them, then the table; aborts at the end where a run could not be made."""
    from tractor_ems.evaluate_set import FailedRun, cores, evaluate_all
    from tractor_ems.policies.registry import make_policy
    from tractor_ems.summary import write_csv

    for name in dict.fromkeys(run.policy for run in runs):
        if name != "dp":  # a wrong name or file is refused before hours of work
            make_policy(
                name,
                runs[0].scenario,
                allow_other_powertrain=options.allow_other_powertrain,
                soc_guard=options.soc_guard,
            )
    with counting("runs", len(runs)) as done:
        rows = evaluate_all(runs, options, jobs=jobs or cores(), progress=done)
    documents = [row.to_json() for row in rows]
    if csv is not None:
        write_csv(csv, documents)
    if json:
        print_json({"results": documents})
    else:
        print_runs(documents)
    failed = [row for row in rows if isinstance(row, FailedRun)]
    if failed:
        more = f" (and {len(failed) - 1} more)" if len(failed) > 1 else ""
        raise RunAborted(f"{len(failed)} of {len(rows)} runs not driven: {failed[0]}{more}")
