"""Recorded demand as the samples counterfactual learning draws from: (bag, time) pairs."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tractor_ems.policies.mlp import Float32Array
from tractor_ems.policies.q_policy import Normalisation, demand_inputs
from tractor_msgs_py.errors import ConfigError
from tractor_msgs_py.observation import DemandFilter, ObservationSpec, filter_trace
from tractor_msgs_py.trajectory import FloatArray, IntArray
from tractor_sim.generator import to_bus_w
from tractor_sim.powertrain import PowertrainParams


@dataclass(frozen=True)
class DemandSamples:
    """N ticks of demand of several traces, end to end.

    Attributes:
        power_demand_w: shape (N,) [W].
        inputs: demand and filters as network inputs, shape (N, 1 + F).
        steps: ticks k whose successor k + 1 is of the same trace, shape (M,).
    """

    power_demand_w: FloatArray
    inputs: Float32Array
    steps: IntArray


def servable_demand_w(params: PowertrainParams, power_demand_w: FloatArray) -> FloatArray:
    """Demand cut to what engine and battery can serve and take together, any shape [W].

    Beyond these bounds every action saturates alike, so nothing can be learned there; left in, a
    single spike of a sensor would widen the input scaling and every table by its own size.
    """
    peak_w, battery_w = params.engine.power_max_w, params.battery.power_max_w
    engine_w = float(to_bus_w(params.generator, np.array(peak_w), peak_w))
    return np.clip(power_demand_w, -battery_w, engine_w + battery_w)


def demand_scaling(demands_w: Sequence[FloatArray]) -> Normalisation:
    """Mean and spread of demand over all traces.

    Raises:
        ConfigError: there is no demand.
    """
    if not sum(len(demand) for demand in demands_w):
        raise ConfigError("training: the bags hold no demand")
    joined = np.concatenate(demands_w)
    return Normalisation(float(joined.mean()), max(float(joined.std()), 1e3))


def observation_spec(
    scaling: Normalisation, dt_s: float, mean_prior_s: float, *low_pass_s: float
) -> ObservationSpec:
    """What the policy sees of demand: now, its running mean (which starts at the training mean,
    counted as ``mean_prior_s`` of experience) and low passes."""
    return ObservationSpec(
        dt_s=dt_s,
        filters=(
            DemandFilter("running_mean", mean_prior_s, scaling.demand_offset_w),
            *(DemandFilter("low_pass", time_s) for time_s in low_pass_s),
        ),
    )


def demand_samples(
    demands_w: Sequence[FloatArray], spec: ObservationSpec, scaling: Normalisation, dt_s: float
) -> DemandSamples:
    """Filter every trace as a live run would, and lay the traces end to end.

    Raises:
        ConfigError: no trace has two ticks.
    """
    inputs, steps, offset = [], [], 0
    for demand_w in demands_w:
        features_w = filter_trace(spec, demand_w, dt_s)
        inputs.append(demand_inputs(scaling, demand_w, features_w))
        steps.append(np.arange(offset, offset + len(demand_w) - 1, dtype=np.int64))
        offset += len(demand_w)
    joined = np.concatenate(steps)
    if not len(joined):
        raise ConfigError("training: no trace holds two ticks in a row")
    return DemandSamples(np.concatenate(demands_w), np.concatenate(inputs), joined)
