"""Drive policies over cycles in-process: the same plant, filters and policies as the ROS run,
without the transport, and batched."""

import numpy as np

from tractor_ems.policies.protocol import Policy
from tractor_ems.safety import safe
from tractor_msgs_py.codec import wire_soc
from tractor_msgs_py.errors import PolicyError
from tractor_msgs_py.observation import Observation, init_filters, update_filters
from tractor_msgs_py.trajectory import FloatArray, Trajectory
from tractor_msgs_py.types import DEFAULT_T0_NS
from tractor_sim.powertrain import PowertrainParams, initial_state, power_limits, step


def drive(
    policy: Policy,
    params: PowertrainParams,
    power_demand_w: FloatArray,
    soc_initial: FloatArray | float,
    soc_target: FloatArray | float,
    t0_ns: int = DEFAULT_T0_NS,
) -> list[Trajectory]:
    """Drive B tractors at once.

    Args:
        policy: decides for the whole batch.
        params: one powertrain for all.
        power_demand_w: demand at the bus, auxiliaries included, shape (B, T) [W].
        soc_initial, soc_target: fractions, scalar or shape (B,).
        t0_ns: stamp of the first tick.

    Returns:
        B trajectories of T steps. With B = 1 the trajectory hash equals the ROS lockstep run's.

    Raises:
        PolicyError: the policy was made for another step length.
    """
    batch, steps = power_demand_w.shape
    dt_ns = round(params.dt_s * 1e9)
    spec = policy.spec
    if spec.dt_s is not None and abs(spec.dt_s - params.dt_s) > 1e-9:
        raise PolicyError(f"observation dt_s {params.dt_s}, the policy needs {spec.dt_s}")
    target = np.broadcast_to(np.asarray(soc_target, dtype=np.float64), (batch,))
    state = initial_state(params, soc_initial, batch)
    filters, memory = init_filters(spec, batch), policy.init(batch)
    columns: dict[str, list[FloatArray]] = {name: [] for name in _COLUMNS}
    for k in range(steps):
        demand_w = power_demand_w[:, k]
        filters = update_filters(spec, filters, demand_w, params.dt_s)
        limits = power_limits(params, state)
        observed_soc = wire_soc(state.soc)
        observation = Observation(
            stamp_ns=t0_ns + k * dt_ns,
            power_demand_w=demand_w,
            soc=observed_soc,
            soc_target=target,
            engine_on=state.engine_on,
            time_in_state_s=state.time_in_state_s,
            engine_power_w=state.engine_power_w,
            charge_limit_w=limits.charge_w,
            discharge_limit_w=limits.discharge_w,
            engine_limit_w=limits.engine_w,
            features=filters.values_w,
            time_left_s=np.array([(steps - k) * dt_ns * 1e-9]),
        )
        asked, memory = policy.act(observation, memory)
        command = safe(observation, asked)
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
