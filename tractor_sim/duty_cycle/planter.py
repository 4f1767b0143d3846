"""The planter family: passes of noisy high demand broken by headland turns, one cycle per seed.

The paper prints no cycle; this family is calibrated to its tables (766 s, mean 143.0 kW), and
``planter`` is one seed of it. See config/cycle/planter.yaml for every number.
"""

from dataclasses import dataclass

import numpy as np

from tractor_msgs_py.trajectory import FloatArray


@dataclass(frozen=True)
class PlanterParams:
    """Shape of the family.

    Attributes:
        duration_s, dt_s: length and step [s].
        mean_w: every cycle is scaled to this mean [W].
        pass_mean_w, pass_scale_w: demand in a pass is mean + scale * x, x an AR(1) [W].
        ar_coefficient, ar_innovation_sd: of x, per second.
        turn_duration_s: headland turn [s].
        turn_period_min_s, turn_period_max_s: one period per cycle, uniform in between [s].
        turn_mean_w, turn_sd_w: demand in a turn, normal [W].
        clip_min_w, clip_max_w: bounds of demand before scaling [W].
        start_max_w: most demand in the first step, from standstill; the rest makes up for it [W].
    """

    duration_s: int
    dt_s: float
    mean_w: float
    pass_mean_w: float
    pass_scale_w: float
    ar_coefficient: float
    ar_innovation_sd: float
    turn_duration_s: int
    turn_period_min_s: int
    turn_period_max_s: int
    turn_mean_w: float
    turn_sd_w: float
    clip_min_w: float
    clip_max_w: float
    start_max_w: float = float("inf")


def planter_demand_w(params: PlanterParams, seed: int) -> FloatArray:
    """Demand of one cycle, shape (duration,), a function of the seed only [W]."""
    rng = np.random.Generator(np.random.PCG64(seed))
    steps = params.duration_s
    spread = params.ar_innovation_sd / np.sqrt(1.0 - params.ar_coefficient**2)
    innovations = rng.normal(0.0, params.ar_innovation_sd, steps)
    x = np.empty(steps)
    x[0] = rng.normal(0.0, spread)
    for k in range(1, steps):
        x[k] = params.ar_coefficient * x[k - 1] + innovations[k]
    demand = params.pass_mean_w + params.pass_scale_w * x
    period = int(rng.integers(params.turn_period_min_s, params.turn_period_max_s + 1))
    turning = np.arange(steps) % period >= period - params.turn_duration_s
    turn_w = rng.normal(params.turn_mean_w, params.turn_sd_w, steps)
    demand = np.clip(np.where(turning, turn_w, demand), params.clip_min_w, params.clip_max_w)
    scaled: FloatArray = demand * (params.mean_w / demand.mean())
    if scaled[0] > params.start_max_w:
        rest_j = params.mean_w * steps - params.start_max_w
        scaled = demand * (rest_j / demand[1:].sum())
        scaled[0] = params.start_max_w
    return scaled
