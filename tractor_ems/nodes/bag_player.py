"""Plays a bag: its power demand to a plant, or its topics raw. No protocol in here.

``demand_player`` and ``topic_player`` are the two; what they publish when is decided in
``bags.replay_demand`` and ``bags.replay_schedule``.
"""

import sys
from collections.abc import Mapping
from typing import Any

from rclpy.node import Node

from tractor_ems.bags.replay import ANNOUNCED_AUX_W
from tractor_ems.nodes.demand_player import DemandPlayer
from tractor_ems.nodes.topic_player import TopicPlayer
from tractor_msgs_py.errors import ConfigError
from tractor_msgs_py.ros.shell import Logic, Parameter, run_node

WALL = "s wall clock"
RECORDED = "s of the recording"

PARAMETERS = (
    Parameter("bag", "", "bag to play, a folder or an .mcap or .db3 file"),
    Parameter(
        "what",
        "demand",
        "power demand for a plant with demand:=topic, or every topic raw",
        choices=("demand", "topics"),
    ),
    Parameter(
        "pace",
        "auto",
        "lockstep: demand follows the plant's ticks, topics the policy's answers; real_time: a "
        "clock; auto: lockstep for demand, real_time for topics",
        choices=("auto", "lockstep", "real_time"),
    ),
    Parameter("rate", 1.0, "real time: how many times as fast as recorded", "1", 0.001, 1000),
    Parameter("start_s", 0.0, "leave out what is before", RECORDED, 0, 1e9),
    Parameter("duration_s", 0.0, "play this much, 0 to the end", RECORDED, 0, 1e9),
    Parameter("run", 0, "demand: which run, from 1 on; 0 the only one", "run", 0, 1_000_000),
    Parameter(
        "aux_w",
        ANNOUNCED_AUX_W,
        "demand: auxiliaries in the demand of a bag that announces none; -1 what it announces",
        "W",
        -1,
        2e6,
    ),
    Parameter("signals", "", "demand: signal map of a vehicle's bag, a name or YAML file"),
    Parameter("dt_s", 1.0, "demand through signals: step of the plant", "s", 0.001, 60),
    Parameter("topics", [""], "topics: full names to publish, empty for all"),
    Parameter("exclude", [""], "topics: full names to leave out"),
    Parameter(
        "match_timeout_s", 0.0, "wait for the first subscriber, 0 waits for ever", WALL, 0, 86400
    ),
    Parameter(
        "answer_timeout_s",
        20.0,
        "end when the plant's next tick, or in lockstep the policy's answer, takes longer",
        WALL,
        0.01,
        3600,
    ),
)


def build(node: Node, values: Mapping[str, Any]) -> Logic:
    """The player that was asked for.

    Raises:
        ConfigError: no bag was named.
    """
    if not values["bag"]:
        raise ConfigError("parameter bag: '', expected a bag to play")
    return (DemandPlayer if values["what"] == "demand" else TopicPlayer)(node, values)


def main() -> int:
    """Entry point."""
    return run_node("bag_player", PARAMETERS, build)


if __name__ == "__main__":
    sys.exit(main())
