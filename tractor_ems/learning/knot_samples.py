"""Driven recordings as the samples the knot learner draws from: states, applied actions, measured
costs. No plant model: fuel and SOC are what was recorded, published limits only mask actions.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np

from tractor_ems.learning.recorded import Drive
from tractor_ems.learning.samples import servable_demand_w
from tractor_ems.policies.genset import power_max_w
from tractor_ems.policies.knot_q import OFF, feasible
from tractor_ems.policies.mlp import Float32Array
from tractor_ems.policies.q_policy import Normalisation, demand_inputs
from tractor_msgs_py.observation import Observation, ObservationSpec, init_filters, update_filters
from tractor_msgs_py.trajectory import BoolArray, FloatArray, IntArray
from tractor_sim.powertrain import PlantState, PowertrainParams, power_limits


@dataclass(frozen=True)
class KnotSamples:
    """N ticks of driven runs, end to end; every column of shape (N,) unless said.

    Attributes:
        demand: demand and filters as network inputs, shape (N, D).
        engine_on, engine_share: state before the decision.
        soc, soc_next: observed before and after the step.
        soc_target: of the run.
        action: output that the applied power stands for.
        cost_kg: fuel burnt, start fuel included.
        power_demand_w: demand at the bus [W].
        off, first, last: feasible actions, see ``knot_q.Feasible``.
        after: ticks to the end of the recording, this one included.
        planned: whether the recording ends where the run was planned to end.
        expert: whether DP drove.
    """

    demand: Float32Array
    engine_on: BoolArray
    engine_share: FloatArray
    soc: FloatArray
    soc_next: FloatArray
    soc_target: FloatArray
    action: IntArray
    cost_kg: FloatArray
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
        engine_share=before_w / top_w,
        soc=drive.soc[:-1],
        soc_next=drive.soc[1:],
        soc_target=target,
        action=np.where(on[1:], 1 + np.clip(knot, 0, knots - 1), OFF),
        cost_kg=drive.fuel_kg,
        power_demand_w=demand_w,
        off=allowed.off,
        first=allowed.first,
        last=allowed.last,
        after=count - np.arange(count),
        planned=np.full(count, end),
        expert=np.full(count, expert),
    )


def running_baseline_kg(
    power_demand_w: FloatArray, cost_kg: FloatArray, points_w: FloatArray, counted: BoolArray
) -> FloatArray:
    """Mean cost of steps as a piecewise linear function of demand, at every step (N,) [kg].

    A least-squares fit of the measured costs of the ``counted`` steps. It depends on demand only,
    so subtracting it changes no choice and takes away most of the noise of a return.
    """
    place = np.clip(np.interp(power_demand_w, points_w, np.arange(len(points_w))), 0, None)
    low = np.minimum(place.astype(np.int64), len(points_w) - 2)
    share = place - low
    size = len(points_w)
    gram, moment = 1e-3 * np.eye(size), np.zeros(size)
    a, b, y = low[counted], share[counted], cost_kg[counted]
    np.add.at(gram, (a, a), (1 - b) ** 2)
    np.add.at(gram, (a + 1, a + 1), b**2)
    np.add.at(gram, (a, a + 1), b * (1 - b))
    np.add.at(gram, (a + 1, a), b * (1 - b))
    np.add.at(moment, a, (1 - b) * y)
    np.add.at(moment, a + 1, b * y)
    value = np.linalg.solve(gram, moment)
    fitted: FloatArray = (1 - share) * value[low] + share * value[low + 1]
    return fitted
