"""Driven recordings as the samples the knot learner draws from: states, applied actions, measured
costs. No plant model: fuel and SOC are what was recorded, published limits only mask actions.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np

from tractor_ems.learning.recorded import Drive
from tractor_ems.learning.rewards import RewardConfig, battery_price
from tractor_ems.learning.samples import servable_demand_w
from tractor_ems.policies.genset import power_max_w
from tractor_ems.policies.knot_q import OFF, Measured, feasible, knots_of
from tractor_ems.policies.mlp import Float32Array
from tractor_ems.policies.q_policy import Normalisation, demand_inputs
from tractor_msgs_py.errors import ConfigError
from tractor_msgs_py.observation import Observation, ObservationSpec, init_filters, update_filters
from tractor_msgs_py.trajectory import BoolArray, FloatArray, IntArray
from tractor_sim.powertrain import PlantState, PowertrainParams, power_limits


@dataclass(frozen=True)
class KnotSamples:
    """N ticks of driven runs, end to end; every column of shape (N,) unless said.

    Attributes:
        demand: demand and filters as network inputs, shape (N, D).
        engine_on: state before the decision.
        soc, soc_next: observed before and after the step.
        soc_target: of the run.
        action: output that the applied power stands for.
        cost_kg: fuel burnt, start fuel included.
        battery_w, power_demand_w: applied battery power and demand at the bus [W].
        off, first, last: feasible actions, see ``knot_q.Feasible``.
        after: ticks to the end of the recording, this one included.
        planned: whether the recording ends where the run was planned to end.
        expert: whether DP drove.
    """

    demand: Float32Array
    engine_on: BoolArray
    soc: FloatArray
    soc_next: FloatArray
    soc_target: FloatArray
    action: IntArray
    cost_kg: FloatArray
    battery_w: FloatArray
    power_demand_w: FloatArray
    off: BoolArray
    first: IntArray
    last: IntArray
    after: IntArray
    planned: BoolArray
    expert: BoolArray

    def __len__(self) -> int:
        return len(self.soc)


def features_of(
    spec: ObservationSpec, demands_w: Sequence[FloatArray], dt_s: float
) -> list[FloatArray]:
    """Filters along every demand, (T, F) each, equal to a live run's; those of one length are
    filtered together, which is much faster than ``filter_trace`` one by one."""
    found: dict[bytes, FloatArray] = {}
    by_length: dict[int, dict[bytes, FloatArray]] = {}
    for demand_w in demands_w:
        by_length.setdefault(len(demand_w), {})[demand_w.tobytes()] = demand_w
    for group in by_length.values():
        rows = np.stack(list(group.values()))
        state, columns = init_filters(spec, len(rows)), []
        for k in range(rows.shape[1]):
            state = update_filters(spec, state, rows[:, k], dt_s)
            columns.append(state.values_w)
        found |= dict(zip(group, np.stack(columns, axis=1), strict=True))
    return [found[demand_w.tobytes()] for demand_w in demands_w]


def knot_samples(
    drives: Sequence[Drive],
    experts: Sequence[bool],
    ends: Sequence[bool],
    params: PowertrainParams,
    spec: ObservationSpec,
    scaling: Normalisation,
    knots: int,
) -> KnotSamples:
    """Every tick of every drive.

    Args:
        drives: driven from their first step on.
        experts, ends: of each, whether DP drove and whether it holds the run's last step.
    """
    demands_w = [servable_demand_w(params, drive.power_demand_w) for drive in drives]
    features = features_of(spec, demands_w, params.dt_s)
    parts = [
        _of_drive(drive, expert, end, demand_w, feature_w, params, scaling, knots)
        for drive, expert, end, demand_w, feature_w in zip(
            drives, experts, ends, demands_w, features, strict=True
        )
    ]
    return KnotSamples(
        **{
            item.name: np.concatenate([getattr(part, item.name) for part in parts])
            for item in fields(KnotSamples)
        }
    )


def _of_drive(
    drive: Drive,
    expert: bool,
    end: bool,
    demand_w: FloatArray,
    features_w: FloatArray,
    params: PowertrainParams,
    scaling: Normalisation,
    knots: int,
) -> KnotSamples:
    count, on, top_w = len(demand_w), drive.engine_on, power_max_w(params)
    before_w = np.concatenate(
        (np.where(on[:1], drive.engine_power_w[:1], 0.0), drive.engine_power_w[:-1])
    )
    before_w = np.where(on[:-1], before_w, 0.0)
    state = PlantState(drive.soc[:-1], on[:-1], drive.time_in_state_s[:-1], before_w)
    limits = power_limits(params, state)
    target = np.full(count, drive.soc_target)
    seen = Observation(
        stamp_ns=0,
        power_demand_w=demand_w,
        soc=drive.soc[:-1],
        soc_target=target,
        engine_on=on[:-1],
        time_in_state_s=drive.time_in_state_s[:-1],
        engine_power_w=before_w,
        charge_limit_w=limits.charge_w,
        discharge_limit_w=limits.discharge_w,
        engine_limit_w=limits.engine_w,
        features=features_w,
    )
    allowed, _, _ = feasible(params, seen, knots)
    knot = np.rint(drive.engine_power_w / top_w * (knots - 1)).astype(np.int64)
    return KnotSamples(
        demand=demand_inputs(scaling, demand_w, features_w),
        engine_on=on[:-1],
        soc=drive.soc[:-1],
        soc_next=drive.soc[1:],
        soc_target=target,
        action=np.where(on[1:], 1 + np.clip(knot, 0, knots - 1), OFF),
        cost_kg=drive.fuel_kg,
        battery_w=drive.battery_power_w,
        power_demand_w=demand_w,
        off=allowed.off,
        first=allowed.first,
        last=allowed.last,
        after=count - np.arange(count),
        planned=np.full(count, end),
        expert=np.full(count, expert),
    )


def measured_of(
    samples: KnotSamples, params: PowertrainParams, reward: RewardConfig, knots: int
) -> Measured:
    """Fuel over engine power, and SOC over battery power, fitted to the recorded steps.

    Raises:
        ConfigError: the engine never ran.
    """
    going = (samples.action != OFF) & samples.engine_on
    if not going.any():
        raise ConfigError("targets sampled: the engine never ran in the recordings")
    points_w = knots_of(params, knots)
    engine_w = samples.power_demand_w - samples.battery_w
    served = going & (engine_w >= 0.0) & (engine_w <= points_w[-1])
    fuel_kg = knot_values(engine_w, samples.cost_kg, points_w, served)
    near = np.bincount(samples.action[served] - 1, minlength=knots)
    fuel_kg = np.where(near >= LEAST_SEEN, fuel_kg, UNSEEN_KG)
    x, level = samples.battery_w / 1e5, samples.soc - 0.5
    columns = np.stack((x, x * x, x * level), axis=1)
    fit = np.linalg.lstsq(columns, samples.soc_next - samples.soc, rcond=None)[0]
    up, down = np.array([0.005]), np.array([-0.005])
    price = float(battery_price(reward, params, up, down, np.zeros(1))[0]) / 0.01
    return Measured(
        tuple(fuel_kg.tolist()), (float(fit[0]), float(fit[1]), float(fit[2])), price,
        reward.cost_unit,
    )  # fmt: skip


LEAST_SEEN, UNSEEN_KG = 20, 1.0
"""A knot run in fewer steps than this is not chosen: its fuel is this."""


def running_baseline_kg(
    power_demand_w: FloatArray, cost_kg: FloatArray, points_w: FloatArray, counted: BoolArray
) -> FloatArray:
    """Mean cost of steps as a piecewise linear function of demand, at every step (N,) [kg].

    A fit to the measured costs of the ``counted`` steps. It depends on demand only, so
    subtracting it changes no choice and takes away most of the noise of a return.
    """
    fitted: FloatArray = np.interp(
        power_demand_w, points_w, knot_values(power_demand_w, cost_kg, points_w, counted)
    )
    return fitted


def knot_values(
    x: FloatArray, y: FloatArray, points: FloatArray, counted: BoolArray
) -> FloatArray:
    """Values at evenly spaced ``points`` of the piecewise linear function that fits y(x) best."""
    place = np.interp(x[counted], points, np.arange(len(points)))
    a = np.minimum(place.astype(np.int64), len(points) - 2)
    b, size = place - a, len(points)
    gram, moment = np.zeros((size, size)), np.zeros(size)
    np.add.at(gram, (a, a), (1 - b) ** 2)
    np.add.at(gram, (a + 1, a + 1), b**2)
    np.add.at(gram, (a, a + 1), b * (1 - b))
    np.add.at(gram, (a + 1, a), b * (1 - b))
    np.add.at(moment, a, (1 - b) * y[counted])
    np.add.at(moment, a + 1, b * y[counted])
    # A little stiffness bridges points that nothing is near.
    bend = np.diff(np.eye(size), n=2, axis=0)
    found = np.linalg.lstsq(gram + 1e-3 * bend.T @ bend, moment, rcond=None)[0]
    return np.asarray(found, dtype=np.float64)
