"""Drive one policy over one scenario, in-process or through the real nodes, and score it."""

from pathlib import Path

from tractor_ems.drive import drive
from tractor_ems.optimal.score import dp_ratio
from tractor_ems.policies.protocol import Policy
from tractor_ems.policies.registry import make_policy, node_of
from tractor_ems.result import NOT_ASKED_FOR, Result, Transport, summarise
from tractor_ems.scenario import Scenario
from tractor_msgs_py.errors import TractorEmsError
from tractor_msgs_py.trajectory import Trajectory


def evaluate(
    policy: str,
    scenario: Scenario,
    *,
    transport: Transport = "in_process",
    record: Path | None = None,
    allow_other_powertrain: bool = False,
    soc_guard: bool = True,
    with_dp: bool = True,
) -> tuple[Result, Trajectory]:
    """Drive and score.

    Args:
        policy: a name of ``policies.registry`` or a policy file.
        scenario: what to drive.
        transport: ``ros`` starts plant_sim and the policy node as processes in lockstep; the
            trajectory hash is the same.
        record: folder of a new bag that receives the run; None records nothing.
        allow_other_powertrain: let a learned policy drive a powertrain it was not made for.
        soc_guard: of the rule base.
        with_dp: solve for the matched-SOC DP ratio; without it a run takes a fraction of a second.

    Raises:
        TractorEmsError: bad input, or a run that was aborted.
    """
    options = {"allow_other_powertrain": allow_other_powertrain, "soc_guard": soc_guard}
    if transport == "ros":
        from tractor_ems.ros_run import run_ros

        # The node solves its own cycle; anything else is made here too, to refuse it early.
        made = None if policy == "dp" else make_policy(policy, scenario, **options)
        node = node_of(policy, scenario, **options)
        trajectory = run_ros(node, scenario, record=record).trajectory
        return score(made or policy, scenario, trajectory, transport, with_dp), trajectory
    made = make_policy(policy, scenario, **options)
    if record is not None:
        from tractor_ems.bags.in_process import record_in_process

        trajectory = record_in_process(made, scenario, record)
    else:
        trajectory = drive(
            made,
            scenario.params,
            scenario.power_demand_w[None, :],
            scenario.soc_initial,
            scenario.soc_target,
        )[0]
    return score(made, scenario, trajectory, transport, with_dp), trajectory


def score(
    policy: Policy | str,
    scenario: Scenario,
    trajectory: Trajectory,
    transport: Transport,
    with_dp: bool = True,
) -> Result:
    """The result row of a finished run, with its matched-SOC DP ratio.

    A run that was driven is reported even where DP cannot judge it; ``dp_note`` says why.
    """
    ratio, note = _ratio(scenario, trajectory) if with_dp else (None, NOT_ASKED_FOR)
    return summarise(
        trajectory,
        policy=policy if isinstance(policy, str) else policy.name,
        cycle=scenario.cycle,
        params=scenario.params,
        soc_target=scenario.soc_target,
        transport=transport,
        dp_ratio=ratio,
        dp_note=note,
        trained_on=getattr(policy, "metadata", {}).get("cycle_hashes", ()),
    )


def _ratio(scenario: Scenario, trajectory: Trajectory) -> tuple[float | None, str | None]:
    """The DP ratio, or None and why there is none."""
    shortfall_j = float(trajectory.shortfall_j.sum())
    if shortfall_j > 0.0:
        return None, f"shortfall of {shortfall_j:.0f} J: undelivered work does not score"
    try:
        ratio = dp_ratio(
            scenario.params,
            trajectory.power_demand_w,
            float(trajectory.soc[0]),
            trajectory.soc_final,
            float(trajectory.fuel_kg.sum()),
        )
    except TractorEmsError as error:
        return None, str(error)
    return ratio, None
