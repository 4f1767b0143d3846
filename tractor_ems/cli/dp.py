"""``ems dp``: the optimum of one cycle, and its certificate."""

from typing import Annotated

import typer

from tractor_ems.cli.evaluate import Cycle, Powertrain, Soc0
from tractor_ems.cli.output import JsonFlag, print_json, print_result, print_table
from tractor_msgs_py.errors import RunAborted


def dp(
    powertrain: Powertrain = "paper",
    cycle: Cycle = "planter",
    soc0: Soc0 = None,
    soc_final: Annotated[
        float | None, typer.Option(help="SOC to end at; default the powertrain's target, or soc0.")
    ] = None,
    certify: Annotated[
        bool, typer.Option(help="Halve every grid step until the fuel stands; report the gaps.")
    ] = False,
    json: JsonFlag = False,
) -> None:
    """Solve a cycle by dynamic programming and roll the optimum out on the real plant."""
    from tractor_ems.evaluate import evaluate
    from tractor_ems.optimal.certificate import certify as certify_dp
    from tractor_ems.optimal.certificate import checked_soc
    from tractor_ems.scenario import make_scenario

    scenario = make_scenario(powertrain, cycle, soc0, soc_final)
    question = (
        scenario.params,
        scenario.power_demand_w,
        scenario.soc_initial,
        scenario.soc_target,
    )
    checked_soc(*question)
    result, _ = evaluate("dp", scenario)
    document = result.to_json()
    failed = ""
    if certify:
        found = certify_dp(*question)
        document["certificate"] = found.to_json()
        if not found.ok:
            failed = f"not certified: {document['certificate']}"
    if json:
        print_json(document)
    else:
        certificate = document.pop("certificate", None)
        print_result(document)
        if certificate is not None:
            print_table("certificate", ("quantity", "value"), list(certificate.items()))
    if failed:
        raise RunAborted(failed)
