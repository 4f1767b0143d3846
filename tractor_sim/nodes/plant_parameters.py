"""The parameters of ``plant_sim``, each with unit and range, and the pace they ask for.

No node in here.
"""

from collections.abc import Mapping
from typing import Any

from tractor_msgs_py import topics
from tractor_msgs_py.errors import ConfigError
from tractor_msgs_py.provenance import command_line
from tractor_msgs_py.ros.shell import Parameter
from tractor_msgs_py.ros.wire import HISTORY_DEPTH
from tractor_msgs_py.types import DutyCycleInfo
from tractor_sim.lockstep import Lockstep
from tractor_sim.pace import Pace
from tractor_sim.plant_run import UNSET_SOC, PlantRun, prepare_run
from tractor_sim.real_time import RealTime

WALL = "s wall clock"
POLL_S = 0.02
"""How often the plant looks whether it is time for something, at the least [s]."""

LEAST_POLL_S = 0.001
"""And at the most: in real time it looks again when the step is over [s]."""

MIN_PERIOD_S = 0.005
"""Shortest step in real time that a node in Python keeps up with [s]."""

PARAMETERS = (
    Parameter("powertrain", "paper", "powertrain, a shipped name or a YAML file"),
    Parameter("cycle", "planter", "duty cycle, a shipped name or a CSV file"),
    Parameter(
        "demand",
        "cycle",
        f"drive the cycle above, or what a player publishes on {topics.DUTY_CYCLE_DEMAND.name}",
        choices=("cycle", "topic"),
    ),
    Parameter(
        "demand_timeout_s",
        5.0,
        "demand:=topic: end the run when the demand of a tick is missing for this long",
        WALL,
        0.01,
        3600,
    ),
    Parameter(
        "soc_initial", UNSET_SOC, "SOC at the start, -1 for the powertrain's", "fraction", -1, 1
    ),
    Parameter(
        "soc_target",
        UNSET_SOC,
        "SOC to end at, -1 for the powertrain's or where the run starts",
        "fraction",
        -1,
        1,
    ),
    Parameter(
        "mode",
        "lockstep",
        "wait for the answer to each tick, or step on a wall clock",
        choices=("lockstep", "real_time"),
    ),
    Parameter(
        "expected_recorders", 0, "recorders to wait for before the start", "recorders", 0, 16
    ),
    Parameter("match_timeout_s", 0.0, "wait for a policy, 0 waits for ever", WALL, 0, 86400),
    Parameter("answer_timeout_s", 10.0, "lockstep: wait for one answer", WALL, 0.01, 3600),
    Parameter(
        "period_s",
        0.0,
        f"real time: of one step, at least {MIN_PERIOD_S}, 0 for the cycle's",
        WALL,
        0,
        60,
    ),
    Parameter("command_timeout_s", 2.0, "real time: oldest command obeyed", WALL, 0.01, 60),
    Parameter(
        "recover_after",
        1,
        "real time: good commands in a row until a policy that was lost is obeyed again",
        "commands",
        1,
        1000,
    ),
    Parameter(
        "ramp_w_per_s",
        0.0,
        "real time: most change of the generator's set-point, 0 for the powertrain's own limits",
        "W/s",
        0,
        1e9,
    ),
    Parameter(
        "output",
        "",
        "folder for trajectory.csv and result.json, empty for none; an old result is removed",
    ),
    Parameter("command_line", "", "what to record as the origin of the run, empty for its own"),
    HISTORY_DEPTH,
)


def run_of(values: Mapping[str, Any], announced: DutyCycleInfo | None = None) -> PlantRun:
    """The run that was asked for, over a cycle of the plant's own or the one a player announced.

    Raises as ``prepare_run`` does.
    """
    return prepare_run(
        values["powertrain"],
        values["cycle"] if announced is None else announced,
        values["soc_initial"],
        values["soc_target"],
        values["mode"],
        values["expected_recorders"],
        values["command_line"] or command_line(),
    )


def pace_of(run: PlantRun, values: Mapping[str, Any]) -> Pace:
    """The pace that was asked for.

    Raises:
        ConfigError: steps too short for a wall clock.
    """
    match_timeout_s = values["match_timeout_s"]
    if run.info.lockstep:
        return Lockstep(run, values["answer_timeout_s"], match_timeout_s)
    period_s = values["period_s"] or run.params.dt_s
    if period_s < MIN_PERIOD_S:
        raise ConfigError(f"parameter period_s: {period_s:g}, allowed {MIN_PERIOD_S}..60 or 0")
    return RealTime(
        run,
        period_s,
        values["command_timeout_s"],
        match_timeout_s,
        values["recover_after"],
        values["ramp_w_per_s"],
    )


def poll_in_s(pace: Pace, now_s: float) -> float:
    """When to look again whether it is time for something [s]."""
    return max(LEAST_POLL_S, min(POLL_S, pace.wait_s(now_s)))
