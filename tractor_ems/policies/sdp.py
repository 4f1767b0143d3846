"""Stochastic dynamic programming as a policy: the known plant for one step, a table for the rest.

The table is a value after the decision over (demand situation, SOC error, engine on), solved on a
Markov chain of recorded demand; see ``optimal.sdp``.
"""

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from tractor_ems.policies.one_step import (
    Held,
    cheapest,
    command_of,
    hold,
    not_held,
    running_range_w,
)
from tractor_msgs_py.errors import PolicyError
from tractor_msgs_py.observation import DemandFilter, Observation, ObservationSpec
from tractor_msgs_py.trajectory import FloatArray, IntArray
from tractor_sim.battery import soc_after
from tractor_sim.powertrain import Command, PowertrainParams


@dataclass(frozen=True)
class SdpPolicy:
    """Least fuel + start + price of battery energy + gamma W(time left, situation, SOC' - target,
    on').

    Attributes:
        params: the powertrain it was made for.
        filters: of demand, features beside demand itself.
        edges: inner edges of the grid over (demand, *features) [W].
        number: situation of every grid cell.
        times_s: times left to the planned end that W is known at, rising, shape (K,); in between
            it is interpolated, a longer one counts as the last. One alone: it knows of no end.
        offset: even SOC errors of the table, shape (S,).
        value_kg: W, shape (K, Z, S, 2), off and on [kg].
        price_kg: of one unit of SOC; start_kg: of a start; gamma: discount per step.
        metadata: where it came from, as stored in its file.

    Raises PolicyError where shapes do not fit.
    """

    params: PowertrainParams
    filters: tuple[DemandFilter, ...]
    edges: tuple[FloatArray, ...]
    number: IntArray
    times_s: FloatArray
    offset: FloatArray
    value_kg: FloatArray
    price_kg: float
    start_kg: float
    gamma: float
    name: str = "sdp"
    metadata: dict[str, Any] = field(default_factory=dict, compare=False)

    def __post_init__(self) -> None:
        cells = math.prod(len(inner) + 1 for inner in self.edges)
        if len(self.edges) != len(self.filters) + 1 or self.number.shape != (cells,):
            raise PolicyError(
                f"{self.name}: {len(self.edges)} grid features with {self.number.shape} cells, "
                f"allowed {len(self.filters) + 1} with ({cells},)"
            )
        shape = (len(self.times_s), int(self.number.max()) + 1, len(self.offset), 2)
        if self.value_kg.shape != shape or min(shape) < 1 or len(self.offset) < 2:
            raise PolicyError(f"{self.name}: value table {self.value_kg.shape}, allowed {shape}")
        for name in ("times_s", "offset", *(f"edges[{i}]" for i in range(len(self.edges)))):
            axis = self.edges[int(name[6:-1])] if "[" in name else getattr(self, name)
            if not (np.all(np.isfinite(axis)) and np.all(np.diff(axis) > 0)):
                raise PolicyError(f"{self.name}: {name} must be finite and rising")

    @property
    def spec(self) -> ObservationSpec:
        """The filters, at the table's step length."""
        return ObservationSpec(dt_s=self.params.dt_s, filters=self.filters)

    def init(self, batch: int) -> Held:
        """No demand seen."""
        return not_held(batch)

    def act(self, observation: Observation, state: Held) -> tuple[Command, Held]:
        """The cheapest engine power, or off."""
        demand_w = observation.power_demand_w
        features = np.concatenate((demand_w[:, None], observation.features), axis=1)
        cell = np.zeros(len(demand_w), dtype=np.int64)
        for column, inner in enumerate(self.edges):
            cell = cell * (len(inner) + 1) + np.searchsorted(inner, features[:, column])
        z = self.number[cell]
        least_w, most_w, may_run, may_be_off = running_range_w(self.params, observation)
        left_s = observation.time_left_s - self.params.dt_s
        time = np.broadcast_to(_between(self.times_s, left_s), (2, *demand_w.shape))
        engine_w, run_kg = cheapest(
            self.params,
            demand_w,
            least_w,
            most_w,
            lambda power_w: self._after(observation, time, z, 1, power_w),
        )
        still_w = np.minimum(demand_w, observation.discharge_limit_w)[:, None]
        still_kg = self._after(observation, time, z, 0, still_w)[:, 0]
        wants = run_kg + np.where(observation.engine_on, 0.0, self.start_kg) < still_kg
        kept, held = hold(self.params, observation, state)
        return command_of(demand_w, engine_w, (wants | kept | ~may_be_off) & may_run), held

    def _after(
        self,
        observation: Observation,
        time: FloatArray,
        z: IntArray,
        on: int,
        battery_w: FloatArray,
    ) -> FloatArray:
        soc = np.broadcast_to(observation.soc[:, None], battery_w.shape)
        after = soc_after(self.params.battery, soc, battery_w, self.params.dt_s)
        x = (after - observation.soc_target[:, None] - self.offset[0]) / (
            self.offset[1] - self.offset[0]
        )
        j = np.clip(np.floor(x).astype(np.int64), 0, len(self.offset) - 2)
        k = time[0].astype(np.int64)
        value = self._at(k, z, j, x - j, on)
        later = self._at(np.minimum(k + 1, len(self.times_s) - 1), z, j, x - j, on)
        value = value + time[1][:, None] * (later - value)
        cost: FloatArray = self.gamma * value - self.price_kg * (after - soc)
        return cost

    def _at(self, k: IntArray, z: IntArray, j: IntArray, x: FloatArray, on: int) -> FloatArray:
        table, row, column = self.value_kg, k[:, None], z[:, None]
        left, right = table[row, column, j, on], table[row, column, j + 1, on]
        value: FloatArray = left + x * (right - left)
        return value


def _between(times_s: FloatArray, left_s: FloatArray) -> FloatArray:
    """Which table, and the share of the next later one, (2, B)."""
    last = len(times_s) - 1
    near = np.clip(left_s, times_s[0], times_s[last])
    k = np.clip(np.searchsorted(times_s, near, side="right") - 1, 0, max(last - 1, 0))
    width = times_s[np.minimum(k + 1, last)] - times_s[k]
    return np.stack((k, (near - times_s[k]) / np.maximum(width, 1e-9)))
