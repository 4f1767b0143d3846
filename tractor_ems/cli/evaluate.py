"""``ems evaluate``: one policy, one cycle, one row."""

from pathlib import Path
from typing import Annotated

import typer

from tractor_ems.cli.output import JsonFlag, print_json, print_result
from tractor_ems.result import Transport
from tractor_msgs_py.errors import ConfigError

Powertrain = Annotated[str, typer.Option(help="Shipped name or YAML file.")]
Cycle = Annotated[str, typer.Option(help="Shipped name, CSV file (time_s,power_demand_w) or bag.")]
Soc0 = Annotated[float | None, typer.Option("--soc0", help="Initial SOC, 0..1.")]


def evaluate(
    policy: Annotated[
        str,
        typer.Option(
            help="conventional, rule_based, best_point, myopic_greedy, dp, default, or a file."
        ),
    ] = "default",
    powertrain: Powertrain = "paper",
    cycle: Cycle = "planter",
    soc0: Soc0 = None,
    soc_target: Annotated[
        float | None, typer.Option(help="SOC to end at; default the powertrain's, or soc0.")
    ] = None,
    transport: Annotated[str, typer.Option(help="in_process or ros (separate processes).")] = (
        "in_process"
    ),
    record: Annotated[Path | None, typer.Option(help="New bag folder for the run.")] = None,
    plot: Annotated[Path | None, typer.Option(help="PNG with the run's traces.")] = None,
    allow_other_powertrain: Annotated[
        bool, typer.Option(help="Drive a powertrain the policy was not made for.")
    ] = False,
    soc_guard: Annotated[bool, typer.Option(help="SOC guard of rule_based.")] = True,
    json: JsonFlag = False,
) -> None:
    """Drive one policy over one cycle and score it against DP to the run's own final SOC."""
    from tractor_ems.evaluate import evaluate as run
    from tractor_ems.scenario import make_scenario

    kinds: dict[str, Transport] = {"in_process": "in_process", "ros": "ros"}
    if transport not in kinds:
        raise ConfigError(f"--transport: {transport!r}, allowed {', '.join(kinds)}")
    scenario = make_scenario(powertrain, cycle, soc0, soc_target)
    result, trajectory = run(
        policy,
        scenario,
        transport=kinds[transport],
        record=record,
        allow_other_powertrain=allow_other_powertrain,
        soc_guard=soc_guard,
    )
    if plot is not None:
        from tractor_ems.plots import plot_runs

        title = f"{result.policy} on {result.cycle}, powertrain {result.powertrain}"
        plot_runs(plot, title, {result.policy: trajectory}, scenario.params, result.soc_target)
    if json:
        print_json(result.to_json())
        return
    print_result(result.to_json())
