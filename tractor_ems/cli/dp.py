"""``ems dp``: the optimum of one cycle or of many, its certificate and its trace."""

from pathlib import Path
from typing import Annotated, get_args

import typer

from tractor_ems.cli.evaluate import Powertrain, Soc0
from tractor_ems.cli.output import JsonFlag, counting, print_json, print_result, print_table
from tractor_msgs_py.errors import ConfigError, RunAborted

KG_PER_J = 1e-9
"""One gram per megajoule."""

SET_COLUMNS = ("cycle", "fuel kg", "starts", "stops", "halving %", "roll-out %", "bracket %", "ok")


def dp(
    powertrain: Powertrain = "paper",
    cycle: Annotated[
        str | None,
        typer.Option(help="Shipped name, CSV file (time_s,power_demand_w) or bag. [planter]"),
    ] = None,
    cycle_set: Annotated[
        list[str] | None,
        typer.Option("--set", help="All cycles of train, validation or held-out; several times."),
    ] = None,
    soc0: Soc0 = None,
    soc_final: Annotated[
        float | None, typer.Option(help="SOC to end at; default the powertrain's target, or soc0.")
    ] = None,
    free_end: Annotated[
        bool, typer.Option("--free-end", help="End anywhere; on plants with engine state.")
    ] = False,
    end_price: Annotated[
        float | None,
        typer.Option(help="With --free-end: what energy left at the end is worth [g/MJ], >= 0."),
    ] = None,
    certify: Annotated[
        bool, typer.Option(help="Halve every grid step until the fuel stands; report the gaps.")
    ] = False,
    trace: Annotated[
        Path | None, typer.Option(help="CSV file with every step and its co-state; one cycle.")
    ] = None,
    jobs: Annotated[
        int | None, typer.Option(min=1, help="Processes of a set; default one per core.")
    ] = None,
    json: JsonFlag = False,
) -> None:
    """Solve a cycle by dynamic programming and drive the optimum on the real plant."""
    if end_price is not None and not free_end:
        raise ConfigError("--end-price: allowed only with --free-end")
    if free_end and (soc_final is not None or certify):
        raise ConfigError("--free-end: not allowed with --soc-final or --certify")
    if not cycle_set:
        end_price_kg_per_j = None if end_price is None else end_price * KG_PER_J
        source = "planter" if cycle is None else cycle
        _one(
            powertrain, source, soc0, soc_final, free_end, end_price_kg_per_j, certify, trace, json
        )
        return
    for option, given in (("--cycle", cycle), ("--trace", trace), ("--free-end", free_end)):
        if given:
            raise ConfigError(f"{option}: not allowed with --set")
    _many(powertrain, cycle_set, soc0, soc_final, certify, jobs, json)


def _one(
    powertrain: str,
    cycle: str,
    soc0: float | None,
    soc_final: float | None,
    free_end: bool,
    end_price_kg_per_j: float | None,
    certified: bool,
    trace: Path | None,
    json: bool,
) -> None:
    from tractor_ems.evaluate import score
    from tractor_ems.optimal.optimum import find_optimum, write_trace
    from tractor_ems.scenario import make_scenario

    scenario = make_scenario(powertrain, cycle, soc0, soc_final)
    optimum = find_optimum(
        scenario.params,
        scenario.power_demand_w,
        scenario.soc_initial,
        None if free_end else scenario.soc_target,
        end_price_kg_per_j=end_price_kg_per_j,
        certified=certified,
    )
    if trace is not None:
        write_trace(trace, optimum, scenario.params.dt_s)
    document = score(optimum.policy, scenario, optimum.trajectory, "in_process").to_json()
    document["co_state_kg_per_j"] = optimum.co_state_kg_per_j.tolist()
    certificate = None if optimum.certificate is None else optimum.certificate.to_json()
    if certificate is not None:
        document["certificate"] = certificate
    if json:
        print_json(document)
    else:
        document.pop("certificate", None)
        print_result(document)
        if certificate is not None:
            print_table("certificate", ("quantity", "value"), list(certificate.items()))
    if certificate is not None and not certificate["ok"]:
        raise RunAborted(f"not certified: {certificate}")


def _many(
    powertrain: str,
    sets: list[str],
    soc0: float | None,
    soc_final: float | None,
    certified: bool,
    jobs: int | None,
    json: bool,
) -> None:
    from tractor_ems.evaluate_set import cores
    from tractor_ems.optimal.optimum_set import find_optima
    from tractor_ems.scenario import make_scenario

    names = dict.fromkeys(name for text in sets for name in _cycles_of(text))
    scenarios = [make_scenario(powertrain, name, soc0, soc_final) for name in names]
    with counting("cycles", len(scenarios)) as done:
        rows = find_optima(scenarios, certified=certified, jobs=jobs or cores(), progress=done)
    documents = [row.to_json() for row in rows]
    if json:
        print_json({"results": documents})
    else:
        table = []
        for row in documents:
            found = row["certificate"] or {}
            gaps = [found.get(name) for name in ("grid_halving_change", "rollout_gap")]
            gaps.append(found.get("bracket_width"))
            percent = [None if gap is None else f"{100.0 * gap:.4f}" for gap in gaps]
            counts = [row[name] for name in ("cycle", "fuel_kg", "starts", "stops")]
            table.append([*counts, *percent, found.get("ok")])
        print_table("", SET_COLUMNS, table)
    failed = [row for row in rows if row.note is not None]
    if failed:
        raise RunAborted(
            f"{len(failed)} of {len(rows)} cycles not solved: {failed[0].cycle}: {failed[0].note}"
        )
    open_ones = [row.cycle for row in rows if row.certificate and not row.certificate["ok"]]
    if open_ones:
        raise RunAborted(f"{len(open_ones)} of {len(rows)} not certified: {', '.join(open_ones)}")


def _cycles_of(text: str) -> list[str]:
    from tractor_sim.duty_cycle.cycle import Split
    from tractor_sim.duty_cycle.library import cycle_names

    splits = {split.replace("_", "-"): split for split in get_args(Split)}
    split = splits.get(text.replace("_", "-"))
    if split is None:
        raise ConfigError(f"--set: {text!r}, allowed {', '.join(splits)}")
    return list(cycle_names(split))
