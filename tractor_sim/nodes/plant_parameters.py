"""The parameters of ``plant_sim``: each with description, unit and range."""

from tractor_msgs_py.ros.shell import Parameter
from tractor_sim.plant_run import UNSET_SOC

WALL = "s wall clock"

PARAMETERS = (
    Parameter("powertrain", "paper", "powertrain, a shipped name or a YAML file"),
    Parameter("cycle", "planter", "duty cycle, a shipped name or a CSV file"),
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
    Parameter("period_s", 0.0, "real time: of one step, 0 for the cycle's", WALL, 0, 60),
    Parameter("command_timeout_s", 2.0, "real time: oldest command obeyed", WALL, 0.01, 60),
    Parameter("output", "", "folder for trajectory.csv and result.json, empty for none"),
)
