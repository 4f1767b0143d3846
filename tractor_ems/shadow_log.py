"""What a policy in the shadow would have done against what was done, tick by tick, in fuel.

One step at a time, each from the state that was observed: the powertrain model says what fuel and
battery energy the policy's command and the applied power would take over that step. It is no
second drive: the policy never gets to the states where its own commands would have led.
"""

import contextlib
import math
import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import IO, Any

import numpy as np

from tractor_ems.decide import Applied
from tractor_ems.learning.rewards import RewardConfig, best_specific_fuel_kg_per_j
from tractor_msgs_py.atomic import write_json
from tractor_msgs_py.errors import ConfigError
from tractor_msgs_py.observation import Observation
from tractor_msgs_py.types import BatteryPowerCommand
from tractor_sim.powertrain import Command, PlantState, PowertrainParams, step

FLUSH_S = 1.0
"""How often what was logged goes to the disk [s]."""

COLUMNS = (
    "stamp_ns",
    "power_demand_w",
    "soc",
    "engine_on",
    "applied_battery_power_w",
    "applied_engine_power_w",
    "policy_battery_power_w",
    "policy_engine_power_w",
    "applied_fuel_kg",
    "policy_fuel_kg",
    "battery_difference_j",
    "equivalent_difference_kg",
    "measured_fuel_kg",
)


@dataclass(frozen=True)
class Step:
    """One step, as the model sees both ways through it.

    Attributes:
        engine_power_w: at the bus [W].
        engine_on: during the step.
        fuel_kg: burnt, start fuel included [kg].
        soc_after: SOC at its end.
    """

    engine_power_w: float
    engine_on: bool
    fuel_kg: float
    soc_after: float


@dataclass(frozen=True)
class Price:
    """What a joule of battery energy is worth.

    Attributes:
        kg_per_j: at the target SOC [kg/J].
        kp: relative rise per unit of SOC below the target.
        origin: where the price is from, in words.
    """

    kg_per_j: float
    kp: float
    origin: str


def price_of(params: PowertrainParams, reward: RewardConfig | None = None) -> Price:
    """The price a policy was trained with, or the powertrain's best specific fuel."""
    if reward is not None and reward.kind == "equivalent_fuel":
        known = reward.lambda0_kg_per_j
        kg_per_j = best_specific_fuel_kg_per_j(params) if known is None else known
        return Price(kg_per_j, reward.kp, "the policy's own")
    return Price(best_specific_fuel_kg_per_j(params), 0.0, "the powertrain's best specific fuel")


def predicted(
    params: PowertrainParams,
    observation: Observation,
    battery_power_w: float,
    off: bool,
    was_on: bool,
) -> Step:
    """One step of the model from an observation.

    Args:
        params: the powertrain, its dt_s the step's.
        observation: state before the step, batch of one.
        battery_power_w: commanded or applied [W].
        off: the engine is told to be off.
        was_on: the engine was on before, for whoever would have started it: a start is paid once.
    """
    state = PlantState(
        observation.soc,
        observation.engine_on,
        observation.time_in_state_s,
        np.maximum(observation.engine_power_w, 0.0),
    )
    wish = Command(np.array([battery_power_w]), np.array([0.0 if off else math.nan]))
    after, result = step(params, state, observation.power_demand_w, wish)
    on, start_kg = bool(after.engine_on[0]), params.engine.start_fuel_kg
    fuel_kg = float(result.fuel_kg[0]) - start_kg * bool(result.engine_started[0])
    return Step(
        float(result.engine_power_w[0]),
        on,
        fuel_kg + start_kg * (on and not was_on),
        float(after.soc[0]),
    )


@dataclass
class ShadowSum:
    """Totals of a log; differences are the policy's less the applied, so a saving is negative.

    Attributes:
        ticks: compared.
        seconds: they lasted [s].
        applied_fuel_kg, policy_fuel_kg: by the model [kg].
        battery_difference_j: battery energy that the policy would have taken more [J].
        equivalent_difference_kg: fuel difference, battery energy at its price [kg].
        measured_fuel_kg: where a signal gives it, over ``measured_ticks`` [kg].
    """

    ticks: int = 0
    seconds: float = 0.0
    applied_fuel_kg: float = 0.0
    policy_fuel_kg: float = 0.0
    battery_difference_j: float = 0.0
    equivalent_difference_kg: float = 0.0
    measured_fuel_kg: float = 0.0
    measured_ticks: int = 0

    @property
    def line(self) -> str:
        """The totals in one line."""
        if not self.ticks:
            return "shadow: nothing compared"
        share = self.equivalent_difference_kg / max(self.applied_fuel_kg, 1e-9)
        measured = f", measured {self.measured_fuel_kg:.3f} kg" if self.measured_ticks else ""
        return (
            f"shadow: {self.ticks} ticks, {self.seconds:.0f} s: "
            f"applied {self.applied_fuel_kg:.3f} kg{measured}, "
            f"this policy {self.policy_fuel_kg:.3f} kg and "
            f"{self.battery_difference_j / 3.6e6:+.3f} kWh of battery: "
            f"{self.equivalent_difference_kg:+.3f} kg ({100.0 * share:+.2f} %) equivalent fuel"
        )


class ShadowLog:
    """Compares ticks, keeps the totals and writes a line per tick where a file is asked for.

    Args:
        params: the policy's powertrain.
        dt_s: time between ticks [s].
        price: of battery energy.
        path: CSV file to write, None for the totals alone; an old one is replaced.
        about: what the header says beside the price: policy, map, powertrain ...

    Attributes:
        sum: the totals.
        trouble: why the file ends early, such as a full disk; empty while it does not. The
            totals go on: who drives must not stop for a log.

    Raises ConfigError where the file cannot be written to begin with.
    """

    def __init__(
        self,
        params: PowertrainParams,
        dt_s: float,
        price: Price,
        path: Path | None = None,
        about: Mapping[str, str] | None = None,
    ) -> None:
        self.params = params if params.dt_s == dt_s else replace(params, dt_s=dt_s)
        self.price, self.path, self.sum = price, path, ShadowSum()
        self.about = {**(about or {}), "price_kg_per_j": repr(price.kg_per_j)}
        self.about["price_kp"], self.about["price_of"] = repr(price.kp), price.origin
        self._waiting: tuple[Observation, BatteryPowerCommand] | None = None
        self._policy_on: bool | None = None
        self._flushed_s = 0.0
        self.trouble = ""
        self._file: IO[str] | None = None
        if path is not None:
            self._file = _opened(
                path, [f"# {key}: {value}\n" for key, value in self.about.items()]
            )

    def tick(self, observation: Observation, wish: BatteryPowerCommand, applied: Applied) -> None:
        """A decision of the policy, and what was applied over the step that it ends.

        A step whose beginning was not seen is not compared.
        """
        waiting, self._waiting = self._waiting, (observation, wish)
        expected_ns = round(self.params.dt_s * 1e9)
        if waiting is None or observation.stamp_ns - waiting[0].stamp_ns != expected_ns:
            self._policy_on = None
            return
        if not math.isfinite(applied.engine_power_w):
            return
        self._compare(*waiting, self._whole(waiting[0], applied))

    def _whole(self, before: Observation, applied: Applied) -> Applied:
        """Battery power follows from the bus balance where no signal says it."""
        if math.isfinite(applied.battery_power_w):
            return applied
        battery_w = float(before.power_demand_w[0]) - applied.engine_power_w
        return replace(applied, battery_power_w=battery_w)

    def _compare(self, before: Observation, wish: BatteryPowerCommand, applied: Applied) -> None:
        was_on = bool(before.engine_on[0])
        policy_was_on = was_on if self._policy_on is None else self._policy_on
        off = applied.engine_power_w <= 0.0
        done = predicted(self.params, before, applied.battery_power_w, off, was_on)
        asked_off = wish.engine_power_w == 0.0
        asked = predicted(self.params, before, wish.battery_power_w, asked_off, policy_was_on)
        self._policy_on = asked.engine_on
        energy_j = (done.soc_after - asked.soc_after) * self.params.battery.energy_j
        middle = 0.5 * (done.soc_after + asked.soc_after) - float(before.soc_target[0])
        value_kg = energy_j * self.price.kg_per_j * (1.0 - self.price.kp * middle)
        equivalent_kg = asked.fuel_kg - done.fuel_kg + value_kg
        total = self.sum
        total.ticks += 1
        total.seconds += self.params.dt_s
        total.applied_fuel_kg += done.fuel_kg
        total.policy_fuel_kg += asked.fuel_kg
        total.battery_difference_j += energy_j
        total.equivalent_difference_kg += equivalent_kg
        if math.isfinite(applied.fuel_kg):
            total.measured_fuel_kg += applied.fuel_kg
            total.measured_ticks += 1
        if self._file is None:
            return
        values = (
            before.power_demand_w[0],
            before.soc[0],
            float(was_on),
            applied.battery_power_w,
            applied.engine_power_w,
            wish.battery_power_w,
            asked.engine_power_w,
            done.fuel_kg,
            asked.fuel_kg,
            energy_j,
            equivalent_kg,
        )
        measured = repr(applied.fuel_kg) if math.isfinite(applied.fuel_kg) else ""
        row = (str(before.stamp_ns), *(repr(float(value)) for value in values), measured)
        try:
            self._file.write(",".join(row) + "\n")
        except OSError as error:
            self._give_up(error)

    def flush(self, now_s: float) -> None:
        """Once a second, hand what was logged to the operating system, which survives SIGKILL."""
        if self._file is not None and now_s - self._flushed_s >= FLUSH_S:
            self._flushed_s = now_s
            try:
                self._file.flush()
            except OSError as error:
                self._give_up(error)

    def _give_up(self, error: OSError) -> None:
        self.trouble = f"{self.path}: ends early ({error.strerror})"
        file, self._file = self._file, None
        with contextlib.suppress(OSError):  # what is in its buffer is lost
            if file is not None:
                file.close()

    def close(self) -> None:
        """Write what is left, and the totals as JSON beside the log.

        Raises ConfigError where the totals cannot be written.
        """
        if self.path is None:
            return
        if self._file is not None:
            try:
                self._file.flush()
                os.fsync(self._file.fileno())
                self._file.close()
            except OSError as error:
                self._give_up(error)
            self._file = None
        document: dict[str, Any] = {"about": self.about, "sum": asdict(self.sum)}
        write_json(self.path.with_suffix(".json"), document)


def _opened(path: Path, header: list[str]) -> IO[str]:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        file = path.open("w", encoding="utf-8", newline="")
        file.writelines([*header, ",".join(COLUMNS) + "\n"])
        file.flush()
        return file
    except OSError as error:
        raise ConfigError(
            f"parameter shadow_log: {path} cannot be written ({error.strerror})"
        ) from None
