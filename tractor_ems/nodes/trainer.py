"""``ems train`` as a node: learns from bags in a thread, tells its progress, exits when done.

SIGINT and SIGTERM leave a checkpoint that ``resume`` continues. Learning itself is not in here.
"""

import json
import sys
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Any, get_args

from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.duration import Duration
from rclpy.node import Node
from std_msgs.msg import String

from tractor_ems.learning.config import Targets, load_train_config, preset_of, rule_share_of
from tractor_ems.learning.rewards import RewardKind
from tractor_ems.learning.train import TrainReport, train
from tractor_ems.signals.config import optional_map
from tractor_msgs_py.errors import ConfigError, TractorEmsError
from tractor_msgs_py.ros.shell import Parameter, qos_profile, run_node
from tractor_msgs_py.topics import Qos

PUBLISH_S = 0.5
PROGRESS_QOS = Qos(durability="transient_local", depth=1)

PARAMETERS = (
    Parameter("bags", [""], "bags or folders of bags to learn from, required"),
    Parameter("rule_bags", [""], "rule-based bags for the seeding of sampled targets"),
    Parameter("output", "", "policy file to write (.safetensors), required"),
    Parameter("preset", "", "config/training name or YAML file; empty: of the targets"),
    Parameter("targets", "", "empty: the preset's", choices=("", *get_args(Targets))),
    Parameter("reward", "", "empty: the preset's", choices=("", *get_args(RewardKind))),
    Parameter("powertrain", "", "shipped name or YAML file; empty: the preset's"),
    Parameter("signals", "", "signal map of a vehicle's bags; empty: the project's own topics"),
    Parameter("updates", 0, "gradient steps, 0: the preset's", "", 0, 100_000_000),
    Parameter("seed", -1, "seed of every generator, -1: the preset's", "", -1, 2**62),
    Parameter("interact", -1, "simulated episodes to add, -1: the preset's", "", -1, 1_000_000),
    Parameter(
        "rule_share", -1.0, "replay share from rule-based bags, -1: 0.25 with rule_bags", "", -1, 1
    ),
    Parameter("allow_other_powertrain", False, "learn from bags of another powertrain"),
    Parameter("allow_held_out", False, "learn from bags of held-out cycles"),
    Parameter("resume", False, "go on from the checkpoint beside the output"),
)


class Trainer:
    """One training run in a thread that is always joined."""

    def __init__(self, node: Node, values: Mapping[str, Any]) -> None:
        bags = [Path(name) for name in values["bags"] if name]
        if not values["output"]:
            raise ConfigError("parameter output: is empty, give the policy file to write")
        if not bags and values["interact"] < 1:
            raise ConfigError("parameter bags: is empty, give the bags to learn from")
        preset = values["preset"] or preset_of(values["targets"]) or "counterfactual"
        config = load_train_config(preset, _overrides(values))
        self._publisher = node.create_publisher(String, "~/progress", qos_profile(PROGRESS_QOS))
        self._clock = Clock(clock_type=ClockType.STEADY_TIME)
        node.create_timer(PUBLISH_S, self._publish, clock=self._clock)
        self._updates = config.updates
        self._latest: dict[str, Any] = {"state": "reading", "step": 0, "updates": config.updates}
        self._stop = threading.Event()
        self._report: TrainReport | None = None
        self._error: BaseException | None = None

        def work() -> None:
            try:
                self._report = train(
                    config,
                    bags,
                    [Path(name) for name in values["rule_bags"] if name],
                    Path(values["output"]),
                    progress=self._note,
                    stop=self._stop.is_set,
                    resume=values["resume"],
                    signals=optional_map(values["signals"]),
                )
            except BaseException as error:
                self._error = error

        self._logger = node.get_logger()
        self._worker = threading.Thread(target=work, name="training")
        self._worker.start()

    def _note(self, step: int, metrics: dict[str, float]) -> None:
        self._latest = {"state": "training", "step": step, "updates": self._updates, **metrics}

    def _publish(self) -> None:
        self._publisher.publish(String(data=json.dumps(self._latest, allow_nan=False)))

    def finished(self) -> int | None:
        """0 when the policy is written; raises what ended the training otherwise."""
        if self._worker.is_alive():
            return None
        self._worker.join()
        self._raise_error()
        return 0

    def _raise_error(self) -> None:
        error, self._error = self._error, None
        if error is not None:
            raise error

    def shutdown(self) -> None:
        """Stop after the present update, which leaves a checkpoint; say how it ended, or raise
        what ended it: a checkpoint that was not written must not look like one that was."""
        self._stop.set()
        self._worker.join()
        self._raise_error()
        if self._report is not None:
            state = "done" if self._report.policy else "stopped"
            self._latest = {**self._latest, "state": state, "step": self._report.updates}
            self._publish()
            self._publisher.wait_for_all_acked(Duration(seconds=1.0))
            written = self._report.policy or self._report.checkpoint
            self._logger.info(f"{state} after {self._report.updates} updates: {written}")


def _overrides(values: Mapping[str, Any]) -> dict[str, Any]:
    """Parameters that were set, as configuration; the rest is the preset's."""
    return {
        "targets": values["targets"] or None,
        "reward.kind": values["reward"] or None,
        "powertrain": values["powertrain"] or None,
        "updates": values["updates"] or None,
        "seed": None if values["seed"] < 0 else values["seed"],
        "interact": None if values["interact"] < 0 else values["interact"],
        "sampled.rule_share": rule_share_of(values["rule_share"], values["rule_bags"]),
        "allow_other_powertrain": values["allow_other_powertrain"] or None,
        "allow_held_out": values["allow_held_out"] or None,
    }


def main() -> int:
    """Entry point."""
    try:
        return run_node("trainer", PARAMETERS, Trainer)
    except TractorEmsError as error:  # from the shutdown, after run_node has its exit code
        print(f"trainer: {' '.join(str(error).split())}", file=sys.stderr)
        return error.exit_code


if __name__ == "__main__":
    sys.exit(main())
