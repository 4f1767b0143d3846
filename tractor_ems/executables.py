"""Where every executable begins: a signal that arrives while a node is still importing rclpy ends
it like any other, with exit code 0 and no traceback. Standard library only.

``run_node`` replaces these handlers as soon as there is something to shut down.
"""

import importlib
import os
import signal
from types import FrameType


def plant_sim() -> int:
    """The plant node."""
    return _node("tractor_sim.nodes.plant_sim")


def rule_based_policy() -> int:
    """The rule policies' node."""
    return _node("tractor_ems.nodes.rule_based_policy")


def dp_policy() -> int:
    """The node of the optimum of one cycle."""
    return _node("tractor_ems.nodes.dp_policy")


def ddqn_policy() -> int:
    """The learned policy's node."""
    return _node("tractor_ems.nodes.ddqn_policy")


def bag_recorder() -> int:
    """The recorder node."""
    return _node("tractor_ems.nodes.bag_recorder")


def bag_player() -> int:
    """The player node."""
    return _node("tractor_ems.nodes.bag_player")


def trainer() -> int:
    """The trainer node."""
    return _node("tractor_ems.nodes.trainer")


def _node(module: str) -> int:
    end_at_once_on_signals()
    code: int = importlib.import_module(module).main()
    # An interpreter takes 0.3 s to end and would die of a second signal meanwhile.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    return code


def end_at_once_on_signals() -> None:
    """Exit with code 0 on SIGINT and SIGTERM: nothing has been begun yet."""

    def leave(_number: int, _frame: FrameType | None) -> None:
        os._exit(0)

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, leave)
