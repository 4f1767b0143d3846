"""The life of every node: parameters, spinning, signals, exit codes. No physics, no policy.

Measured on rclpy 7.1: the documented ``main`` idiom leaves a traceback in some SIGTERMs, so the
signal handlers are ours, a SingleThreadedExecutor spins in a bounded loop, and the safe command
is sent while the context is still valid.
"""

import math
import signal
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import FrameType
from typing import Any, Protocol, runtime_checkable

import rclpy
from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy._rclpy_pybind11 import RCLError, UnknownROSArgsError
from rclpy.exceptions import (
    InvalidParameterTypeException,
    InvalidParameterValueException,
)
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args, try_shutdown

from tractor_msgs_py.errors import ConfigError, TractorEmsError
from tractor_msgs_py.topics import Qos

SPIN_S = 0.1
_BUILT_IN = ("use_sim_time", "start_type_description_service")
_BAD_ARGUMENTS = (RCLError, UnknownROSArgsError, ValueError)


@dataclass(frozen=True)
class Parameter:
    """One declared parameter; its description ends with unit and range.

    ``minimum``/``maximum`` apply to numbers (NaN and inf are refused by the range), ``choices``
    to strings. A parameter is read once at start, so it is read-only, unless it is ``dynamic``:
    then the node's logic is told of every change by ``on_parameters``.
    """

    name: str
    default: bool | int | float | str | list[str]
    description: str
    unit: str = ""
    minimum: float | None = None
    maximum: float | None = None
    choices: tuple[str, ...] = ()
    dynamic: bool = False

    @property
    def text(self) -> str:
        """Description with unit and range."""
        parts = [self.description]
        if self.unit:
            parts.append(f"[{self.unit}]")
        if self.minimum is not None:
            parts.append(f"range {self.minimum:g}..{self.maximum:g}")
        if self.choices:
            parts.append("one of " + ", ".join(self.choices))
        if self.dynamic:
            parts.append("(can be set while running)")
        return " ".join(parts)


class Logic(Protocol):
    """What a node does; built by its module, driven by :func:`run_node`."""

    def finished(self) -> int | None:
        """Exit code once the work is done (checked after every spin), else None."""

    def shutdown(self) -> None:
        """Send the safe command, close files. The context is still valid; called exactly once."""


@runtime_checkable
class Tunable(Logic, Protocol):
    """Logic of a node with dynamic parameters."""

    def on_parameters(self, values: Mapping[str, Any]) -> None:
        """Valid new values of dynamic parameters, by name; called after they were set."""


def qos_profile(qos: Qos) -> QoSProfile:
    """The rclpy profile of a topic's QoS."""
    return QoSProfile(
        depth=qos.depth,
        reliability=ReliabilityPolicy.RELIABLE
        if qos.reliability == "reliable"
        else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL
        if qos.durability == "transient_local"
        else DurabilityPolicy.VOLATILE,
    )


def _overrides(node: Node) -> Mapping[str, Any]:
    """What command line and parameter files set, by name. rclpy has no public way to ask."""
    return node._parameter_overrides


def declare(node: Node, parameters: Sequence[Parameter]) -> dict[str, Any]:
    """Declare every parameter and return the values.

    Raises:
        ConfigError: a value of the wrong type or outside its range, or an override whose name
            is not declared (rclpy ignores those silently).
    """
    given = _overrides(node)
    values = {}
    for parameter in parameters:
        descriptor = ParameterDescriptor(
            description=parameter.text, read_only=not parameter.dynamic
        )
        # One path is not a list to ROS; whoever gives one means a list of one.
        descriptor.dynamic_typing = isinstance(parameter.default, list)
        if parameter.minimum is not None and parameter.maximum is not None:
            if isinstance(parameter.default, float):
                descriptor.floating_point_range = [
                    FloatingPointRange(
                        from_value=float(parameter.minimum), to_value=float(parameter.maximum)
                    )
                ]
            else:
                descriptor.integer_range = [
                    IntegerRange(
                        from_value=int(parameter.minimum), to_value=int(parameter.maximum)
                    )
                ]
        try:
            value = node.declare_parameter(parameter.name, parameter.default, descriptor).value
        except (InvalidParameterTypeException, InvalidParameterValueException) as error:
            got = given.get(parameter.name)
            shown = got.value if got is not None else error
            kind = type(parameter.default).__name__
            raise ConfigError(
                f"parameter {parameter.name}: {shown!r} is not a valid {kind}; {parameter.text}"
            ) from None
        if isinstance(parameter.default, list):
            value = [value] if isinstance(value, str) else value
            if not (isinstance(value, list) and all(isinstance(item, str) for item in value)):
                raise ConfigError(
                    f"parameter {parameter.name}: {value!r} is not a text or a list of texts; "
                    f"{parameter.text}"
                )
        if parameter.choices and value not in parameter.choices:
            raise ConfigError(f"parameter {parameter.name}: {value!r}; {parameter.text}")
        values[parameter.name] = value
    known = {parameter.name for parameter in parameters}
    for name in given:
        if name not in known and name not in _BUILT_IN and not name.startswith("qos_overrides."):
            raise ConfigError(
                f"parameter {name}: unknown, declared are {', '.join(sorted(known))}"
            )
    return values


def accept_changes(node: Node, parameters: Sequence[Parameter], logic: Tunable) -> None:
    """Tell ``logic`` of every valid change of a dynamic parameter; the others are refused, with
    the reason, before anything is set."""
    dynamic = {parameter.name: parameter for parameter in parameters if parameter.dynamic}

    def validate(changes: list[Any]) -> SetParametersResult:
        for change in changes:
            parameter = dynamic.get(change.name)
            if parameter is None:
                continue  # rclpy refuses what is read-only
            wrong = isinstance(change.value, float) and not math.isfinite(change.value)
            if wrong or (parameter.choices and change.value not in parameter.choices):
                reason = f"parameter {change.name}: {change.value!r}; {parameter.text}"
                return SetParametersResult(successful=False, reason=reason)
        return SetParametersResult(successful=True)

    def commit(changes: list[Any]) -> None:
        values = {change.name: change.value for change in changes if change.name in dynamic}
        if values:
            logic.on_parameters(values)

    node.add_on_set_parameters_callback(validate)
    node.add_post_set_parameters_callback(commit)


def run_node(
    name: str,
    parameters: Sequence[Parameter],
    build: Callable[[Node, Mapping[str, Any]], Logic],
    argv: Sequence[str] | None = None,
) -> int:
    """Run one node until its logic is finished or a signal arrives; returns the exit code.

    0 done or SIGINT/SIGTERM, 2 bad input, 3 run aborted with a named reason. ``--help`` prints
    the parameters.
    """
    args = list(sys.argv if argv is None else argv)
    try:
        rest = remove_ros_args(args)[1:]
    except _BAD_ARGUMENTS as error:
        return _complain(name, error)
    if "-h" in rest or "--help" in rest:
        print(f"ros2 run tractor_ems {name} --ros-args [-p NAME:=VALUE ...]\n")
        for parameter in parameters:
            print(f"  {parameter.name} (default {parameter.default!r})\n      {parameter.text}")
        return 0
    if rest:
        print(
            f"{name}: unexpected argument {rest[0]!r}; parameters go after --ros-args",
            file=sys.stderr,
        )
        return 2
    stopped: list[int] = []

    def on_signal(number: int, _frame: FrameType | None) -> None:
        stopped.append(number)

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, on_signal)
    try:
        rclpy.init(args=args, signal_handler_options=SignalHandlerOptions.NO)
    except _BAD_ARGUMENTS as error:
        return _complain(name, error)
    node: Node | None = None
    executor: SingleThreadedExecutor | None = None
    logic: Logic | None = None
    try:
        node = Node(name)
        logic = build(node, declare(node, parameters))
        if isinstance(logic, Tunable):
            accept_changes(node, parameters, logic)
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        code = logic.finished()
        while code is None and not stopped:
            executor.spin_once(timeout_sec=SPIN_S)
            code = logic.finished()
        return code or 0
    except ExternalShutdownException:
        return 0
    except TractorEmsError as error:
        return _complain(name, error, error.exit_code)
    finally:
        try:
            if logic is not None:
                logic.shutdown()
        finally:
            if executor is not None:
                executor.shutdown()
            if node is not None:
                node.destroy_node()
            try_shutdown()


def _complain(name: str, error: Exception, code: int = 2) -> int:
    """One line on stderr; returns the exit code."""
    print(f"{name}: {' '.join(str(error).split())}", file=sys.stderr)
    return code
