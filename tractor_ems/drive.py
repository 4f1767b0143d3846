"""Drive policies over cycles in-process: the same plant, filters and policies as the ROS run,
without the transport, and batched."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tractor_ems.policies.protocol import Policy
from tractor_ems.safety import safe
from tractor_msgs_py.codec import wire_soc
from tractor_msgs_py.errors import ConfigError, PolicyError
from tractor_msgs_py.observation import Observation, init_filters, update_filters
from tractor_msgs_py.trajectory import FloatArray, IntArray, Trajectory
from tractor_msgs_py.types import DEFAULT_T0_NS
from tractor_sim.powertrain import Command, PowertrainParams, initial_state, power_limits, step


@dataclass(frozen=True)
class Interference:
    """What stands between plant and policy without the policy's knowledge, per tractor.

    Attributes:
        demand_noise_w: (B, T), added to the demand that the policy sees [W].
        soc_bias: (B,), added to the SOC that it sees; what it sees stays within 0..1.
        delay_steps: (B,), age of a command when the plant gets it, >= 0. Before the first one
            arrives the fallback law holds: no battery power.
        end_factor: (B,), announced duration of the work over the real one, > 0; once the
            announced end has passed no time is left.

    Raises ConfigError where a value is out of range or the shapes do not fit together.
    """

    demand_noise_w: FloatArray
    soc_bias: FloatArray
    delay_steps: IntArray
    end_factor: FloatArray

    def __post_init__(self) -> None:
        batch = self.demand_noise_w.shape[:1]
        for name in ("soc_bias", "delay_steps", "end_factor"):
            shape = getattr(self, name).shape
            if shape != batch:
                raise ConfigError(f"interference.{name}: shape {shape}, allowed {batch}")
        if not np.all(np.isfinite(self.demand_noise_w)):
            raise ConfigError("interference.demand_noise_w: not finite, allowed finite")
        for name, least in (("soc_bias", -1.0), ("delay_steps", 0.0), ("end_factor", 1e-9)):
            value = getattr(self, name)
            if not np.all(value >= least):
                raise ConfigError(f"interference.{name}: {value.min()}, allowed >= {least:g}")


def drive(
    policy: Policy,
    params: PowertrainParams,
    power_demand_w: FloatArray,
    soc_initial: FloatArray | float,
    soc_target: FloatArray | float,
    t0_ns: int = DEFAULT_T0_NS,
    interference: Interference | None = None,
) -> list[Trajectory]:
    """Drive B tractors at once.

    Args:
        policy: decides for the whole batch.
        params: one powertrain for all.
        power_demand_w: demand at the bus, auxiliaries included, shape (B, T) [W].
        soc_initial, soc_target: fractions, scalar or shape (B,).
        t0_ns: stamp of the first tick.
        interference: what the policy is told wrong, and when it is obeyed; None: nothing.

    Returns:
        B trajectories of T steps. With B = 1 the trajectory hash equals the ROS lockstep run's.

    Raises:
        PolicyError: the policy was made for another step length.
        ConfigError: the interference is for another batch or length.
    """
    batch, steps = power_demand_w.shape
    if interference is not None and interference.demand_noise_w.shape != (batch, steps):
        shape = interference.demand_noise_w.shape
        raise ConfigError(f"interference: for {shape} demands, allowed {(batch, steps)}")
    dt_ns = round(params.dt_s * 1e9)
    spec = policy.spec
    if spec.dt_s is not None and abs(spec.dt_s - params.dt_s) > 1e-9:
        raise PolicyError(f"observation dt_s {params.dt_s}, the policy needs {spec.dt_s}")
    target = np.broadcast_to(np.asarray(soc_target, dtype=np.float64), (batch,))
    state = initial_state(params, soc_initial, batch)
    filters, memory = init_filters(spec, batch), policy.init(batch)
    columns: dict[str, list[FloatArray]] = {name: [] for name in _COLUMNS}
    sent: list[Command] = []
    for k in range(steps):
        demand_w = power_demand_w[:, k]
        seen_w = demand_w
        observed_soc = wire_soc(state.soc)
        time_left_s = np.array([(steps - k) * dt_ns * 1e-9])
        if interference is not None:
            seen_w = demand_w + interference.demand_noise_w[:, k]
            observed_soc = np.clip(observed_soc + interference.soc_bias, 0.0, 1.0)
            left = np.maximum(steps * interference.end_factor - k, 0.0)
            time_left_s = left * params.dt_s
        filters = update_filters(spec, filters, seen_w, params.dt_s)
        limits = power_limits(params, state)
        observation = Observation(
            stamp_ns=t0_ns + k * dt_ns,
            power_demand_w=seen_w,
            soc=observed_soc,
            soc_target=target,
            engine_on=state.engine_on,
            time_in_state_s=state.time_in_state_s,
            engine_power_w=state.engine_power_w,
            charge_limit_w=limits.charge_w,
            discharge_limit_w=limits.discharge_w,
            engine_limit_w=limits.engine_w,
            features=filters.values_w,
            time_left_s=time_left_s,
        )
        asked, memory = policy.act(observation, memory)
        command = safe(observation, asked)
        if interference is not None:
            sent.append(command)
            command = _arriving(sent, interference.delay_steps)
        soc = state.soc
        state, result = step(params, state, demand_w, command)
        row = (
            demand_w,
            observed_soc,
            command.battery_power_w,
            command.engine_power_w,
            result.battery_power_w,
            result.engine_power_w,
            result.fuel_kg,
            state.engine_on,
            result.shortfall_j,
            result.dissipated_j,
            soc,
        )
        for name, value in zip(_COLUMNS, row, strict=True):
            columns[name].append(np.asarray(value))
    stamps = t0_ns + dt_ns * np.arange(steps, dtype=np.int64)
    stacked = {name: np.stack(values, axis=1) for name, values in columns.items()}
    return [
        Trajectory(
            stamp_ns=stamps,
            soc_final=float(state.soc[b]),
            **{name: np.ascontiguousarray(values[b]) for name, values in stacked.items()},
        )
        for b in range(batch)
    ]


def _arriving(sent: Sequence[Command], delay_steps: IntArray) -> Command:
    """The command that the plant gets now, of all those sent so far."""
    at = len(sent) - 1 - delay_steps
    battery_w, engine_w = np.zeros(len(at)), np.full(len(at), np.nan)
    for number in np.unique(at[at >= 0]):
        battery_w = np.where(at == number, sent[number].battery_power_w, battery_w)
        engine_w = np.where(at == number, sent[number].engine_power_w, engine_w)
    return Command(battery_w, engine_w)


_COLUMNS = (
    "power_demand_w",
    "soc_observed",
    "command_battery_power_w",
    "command_engine_power_w",
    "battery_power_w",
    "engine_power_w",
    "fuel_kg",
    "engine_on",
    "shortfall_j",
    "dissipated_j",
    "soc",
)
