"""Demand made from recorded demand: other powers and shorter strokes than were recorded."""

from collections.abc import Sequence

import numpy as np

from tractor_ems.learning.config import Augmentation
from tractor_msgs_py.trajectory import FloatArray


def squeezed(power_demand_w: FloatArray, share: float, scale: float, p_aux_w: float) -> FloatArray:
    """Demand (T,) with its time squeezed to a share and repeated to the old length, and what it
    has beside the auxiliaries' ``p_aux_w`` scaled [W]."""
    work_w, steps = power_demand_w - p_aux_w, len(power_demand_w)
    short = max(round(steps * share), 2)
    times = np.linspace(0.0, steps - 1.0, short)
    stroke_w = np.interp(times, np.arange(steps), work_w) * scale
    return np.resize(stroke_w, steps) + p_aux_w


def augmented(
    demands_w: Sequence[FloatArray],
    config: Augmentation,
    p_aux_w: float,
    rng: np.random.Generator,
) -> list[FloatArray]:
    """The series that ``config`` asks for, each made from one of ``demands_w`` drawn by ``rng``.
    Counts are per 100 series given, so that few bags are not drowned in what they never held."""
    made = []
    for count, shares, scales in (
        (config.scaled, (1.0, 1.0), config.scale_range),
        (config.squeezed, config.squeeze_range, config.squeeze_scale_range),
    ):
        for _ in range(round(count * len(demands_w) / 100)):
            given = demands_w[int(rng.integers(len(demands_w)))]
            share, scale = rng.uniform(*shares), rng.uniform(*scales)
            made.append(squeezed(given, share, scale, p_aux_w))
    return made
