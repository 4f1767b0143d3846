"""The parameters that every policy node has, each with unit and range. Nothing else."""

from tractor_ems.envelope_watch import OUTSIDE_S
from tractor_ems.handover import DEFAULT_RAMP_W_PER_S
from tractor_msgs_py.ros.shell import Parameter
from tractor_msgs_py.ros.wire import HISTORY_DEPTH
from tractor_msgs_py.sampling import LAG_S

UNSET = -1.0
COMMON = (
    Parameter("allow_other_powertrain", False, "drive a powertrain the policy was not made for"),
    Parameter(
        "observation_timeout_s",
        2.0,
        "real time: fall back after silence of",
        "s",
        0.01,
        60,
        dynamic=True,
    ),
    Parameter(
        "signals",
        "",
        "signal map of a vehicle, a shipped name or a YAML file; empty: the simulator's topics, "
        "or map signals for a policy that was trained on sampled signals",
    ),
    Parameter(
        "dt_s",
        0.1,
        "signals: decide every, for a policy without a period of its own",
        "s",
        0.001,
        3600,
    ),
    Parameter(
        "lag_s",
        LAG_S,
        "signals: a tick waits for late samples, for a policy that does not say",
        "s",
        0,
        3600,
    ),
    Parameter(
        "time_scale", 1.0, "signals: seconds of stamps per second", "s/s wall clock", 0.01, 1000
    ),
    Parameter(
        "shadow", False, "only say on ~/shadow_command what it would do, until ~/enable is called"
    ),
    Parameter(
        "shadow_log", "", "CSV file for what it would have done against what was done, and JSON"
    ),
    Parameter(
        "ramp_w_per_s",
        UNSET,
        "most change of generator power at a hand-over, 0 for any, -1 for the powertrain's ramp "
        f"or {DEFAULT_RAMP_W_PER_S:g}",
        "W/s",
        -1,
        1e9,
        dynamic=True,
    ),
    Parameter("ramp_always", False, "keep to that ramp also while engaged, in real time"),
    Parameter("report", "", "JSON file for counters and latencies, written at the end"),
    HISTORY_DEPTH,
)

PLANNED_WORK = Parameter(
    "planned_work_s",
    0.0,
    "the work ends so long after this is set, the policy is engaged or the run begins, 0 for "
    "when the run says",
    "s",
    0,
    1e7,
    dynamic=True,
)

SOC_TARGET = Parameter(
    "soc_target",
    UNSET,
    "SOC to end at, -1 for the run's, the map's or the powertrain's",
    "fraction",
    -1,
    1,
    dynamic=True,
)
"""This and the planned end are of every policy that has not solved its run."""

OUTSIDE = (
    Parameter(
        "outside_envelope",
        "warn",
        "demand or SOC outside what the policy was trained on: only warn, or real time: let the "
        "fallback law hold",
        choices=("warn", "fallback"),
        dynamic=True,
    ),
    Parameter(
        "outside_envelope_s",
        OUTSIDE_S,
        "how long outside that is, and how long inside until the policy drives again",
        "s",
        0,
        3600,
        dynamic=True,
    ),
)
"""Of policies that know what they were trained on."""
