"""B plants that drive episodes: what both environments are, without Gymnasium's calling habits."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from tractor_msgs_py.errors import ConfigError
from tractor_msgs_py.trajectory import BoolArray, FloatArray, IntArray
from tractor_sim.batch import batch_plant, empty_result, limits_batch, step_batch
from tractor_sim.gym.actions import action_mask, command_of, make_actions
from tractor_sim.gym.episodes import Episodes
from tractor_sim.gym.observation import FAST_S, SLOW_S, make_scales, observe, running_mean
from tractor_sim.gym.settings import Settings, soc_range, target_soc
from tractor_sim.powertrain import PowerLimits, PowertrainParams, initial_state

Info = dict[str, NDArray[Any]]


class Fleet:
    """B plants, each somewhere on its own cycle."""

    def __init__(
        self, settings: Settings, params: PowertrainParams, batch: int, threads: int = 1
    ) -> None:
        assert settings.equivalence_kg_per_j is not None  # make_settings fills it in
        self.actions = make_actions(settings, params)
        self._settings, self._params, self._threads = settings, params, threads
        self._price_kg_per_j = settings.equivalence_kg_per_j
        self._plant, self._scales = batch_plant(params), make_scales(params)
        self._episodes = Episodes(settings, params)
        self._soc_range = soc_range(settings, params)
        self._state = initial_state(params, params.soc_initial, batch)
        self._result = empty_result(batch)
        self._row: IntArray = np.zeros(batch, dtype=np.int64)
        self._step: IntArray = np.zeros(batch, dtype=np.int64)
        self._target: FloatArray = np.full(batch, target_soc(settings, params))
        self._cycle: NDArray[np.object_] = np.full(batch, "", dtype=object)
        self._demand_w, self._fast_w, self._slow_w = (np.zeros(batch) for _ in range(3))
        self._applied_w = np.zeros(batch)
        self._fuel_kg, self._starts, self._shortfall_j = (np.zeros(batch) for _ in range(3))
        self._refused: BoolArray = np.zeros(batch, dtype=bool)
        self._limits: PowerLimits = limits_batch(self._plant, self._state)
        self._mask: NDArray[np.int8] = np.ones((batch, settings.count), dtype=np.int8)

    def reset(self, i: int, rng: np.random.Generator, options: dict[str, Any] | None) -> None:
        """Put plant ``i`` at the start of an episode; :meth:`look` before anything is read."""
        cycle, soc = _checked(options, self._params)
        row = self._episodes.draw(rng)
        low, high = self._soc_range
        drawn_soc = low if low == high else float(rng.uniform(low, high))
        self._row[i] = row if cycle is None else self._episodes.row(cycle)
        self._cycle[i] = self._episodes.names[self._row[i]]
        self._step[i] = 0
        fresh = initial_state(self._params, drawn_soc if soc is None else soc)
        self._state.soc[i], self._state.engine_on[i] = fresh.soc[0], fresh.engine_on[0]
        self._state.time_in_state_s[i] = fresh.time_in_state_s[0]
        self._state.engine_power_w[i] = fresh.engine_power_w[0]
        target = target_soc(self._settings, self._params)
        self._target[i] = fresh.soc[0] if np.isnan(target) else target
        demand_w = self._episodes.power_demand_w[self._row[i], 0]
        for column in (self._demand_w, self._fast_w, self._slow_w):
            column[i] = demand_w
        result = self._result
        for zeroed in (
            result.battery_power_w,
            result.engine_power_w,
            result.fuel_kg,
            result.engine_started,
            result.shortfall_j,
            result.dissipated_j,
            self._applied_w,
            self._fuel_kg,
            self._starts,
            self._shortfall_j,
            self._refused,
        ):
            zeroed[i] = 0

    def step(self, action: IntArray) -> tuple[FloatArray, BoolArray]:
        """Drive every plant for one step; :meth:`look` before anything is read.

        Returns:
            Rewards and whether the cycle is over, (B,).
        """
        settings, state, result = self._settings, self._state, self._result
        self._refused = self._mask[np.arange(len(action)), action] == 0
        soc_before = state.soc.copy()
        command = command_of(self.actions, action, self._demand_w)
        step_batch(self._plant, state, self._demand_w, command, result, threads=self._threads)

        # Phi(SOC) - Phi(SOC') of the potential E lambda (e - kp e^2 / 2), e = SOC - target: over
        # an episode it adds up to the price of what the battery gave or took in all.
        error = 0.5 * (soc_before + state.soc) - self._target
        energy_j = self._params.battery.energy_j * (soc_before - state.soc)
        cost_kg = result.fuel_kg + energy_j * self._price_kg_per_j * (
            1.0 - settings.soc_slope * error
        )
        cost_kg += settings.start_price_kg * result.engine_started
        cost_kg += settings.shortfall_factor * self._price_kg_per_j * result.shortfall_j
        reward = cost_kg / -settings.reward_unit_kg

        self._applied_w[:] = self._demand_w
        self._fuel_kg += result.fuel_kg
        self._starts += result.engine_started
        self._shortfall_j += result.shortfall_j
        self._step += 1
        over: BoolArray = self._step >= self._episodes.steps[self._row]
        last = self._episodes.power_demand_w.shape[1] - 1
        self._demand_w = self._episodes.power_demand_w[self._row, np.minimum(self._step, last)]
        dt_s = self._params.dt_s
        self._fast_w = running_mean(self._fast_w, self._demand_w, dt_s, FAST_S)
        self._slow_w = running_mean(self._slow_w, self._demand_w, dt_s, SLOW_S)
        return reward, over

    def look(self) -> tuple[NDArray[np.float32], Info]:
        """Observations (B, 13) and infos, every array of B rows and the reader's own."""
        self._limits = limits_batch(self._plant, self._state)
        self._mask = action_mask(self.actions, self._limits, self._demand_w)
        seen = observe(
            self._scales,
            self._state,
            self._limits,
            self._demand_w,
            self._fast_w,
            self._slow_w,
            self._target,
        )
        result = self._result
        info: Info = {
            "action_mask": self._mask,
            "infeasible": self._refused,
            "cycle": self._cycle,
            "soc": self._state.soc,
            "soc_target": self._target,
            "demand_w": self._applied_w,
            "battery_power_w": result.battery_power_w,
            "engine_power_w": result.engine_power_w,
            "fuel_kg": result.fuel_kg,
            "engine_started": result.engine_started,
            "shortfall_j": result.shortfall_j,
            "dissipated_j": result.dissipated_j,
            "episode_fuel_kg": self._fuel_kg,
            "episode_starts": self._starts,
            "episode_shortfall_j": self._shortfall_j,
        }
        return seen, {name: column.copy() for name, column in info.items()}


def _checked(
    options: dict[str, Any] | None, params: PowertrainParams
) -> tuple[str | None, float | None]:
    """Cycle and initial SOC out of the options of ``reset``."""
    chosen = dict(options or {})
    cycle, soc = chosen.pop("cycle", None), chosen.pop("soc_initial", None)
    if chosen:
        raise ConfigError(f"reset: option {next(iter(chosen))!r}, allowed cycle, soc_initial")
    if cycle is not None and not isinstance(cycle, str):
        raise ConfigError(f"reset: option cycle {cycle!r}, allowed a name or CSV file")
    low, high = params.battery.soc_min, params.battery.soc_max
    if soc is None:
        return cycle, None
    if not (isinstance(soc, int | float) and low <= soc <= high):
        raise ConfigError(f"reset: option soc_initial {soc!r}, allowed {low}..{high}")
    return cycle, float(soc)
