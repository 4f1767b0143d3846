"""Work of other strokes out of recorded work: time compressed, power scaled.

Stands in for work that was never recorded: beside recorded demand when a chain is counted, and
as cycles to tune on.
"""

from collections.abc import Sequence

import numpy as np

from tractor_msgs_py.trajectory import FloatArray

STEPS = 1800
"""How long squeezed work lasts: it is repeated until then."""


def squeezed(
    power_demand_w: FloatArray, p_aux_w: float, time_share: float, power_scale: float
) -> FloatArray:
    """Demand whose working part runs in ``time_share`` of its time at ``power_scale`` of its
    power, repeated up to :data:`STEPS`; both > 0. Auxiliaries stay as they are [W]."""
    work_w = power_demand_w - p_aux_w
    steps = max(int(len(work_w) * time_share), 2)
    at = np.linspace(0.0, len(work_w) - 1.0, steps)
    short_w = np.interp(at, np.arange(len(work_w)), work_w) * power_scale
    if time_share < 1.0:
        short_w = np.tile(short_w, -(-STEPS // steps))[:STEPS]
    return np.ascontiguousarray(short_w + p_aux_w)


def varied(
    traces_w: Sequence[FloatArray],
    p_aux_w: float,
    count: int,
    rng: np.random.Generator,
) -> list[FloatArray]:
    """``count`` traces drawn from the given ones, squeezed to 0.2-0.7 of their time at 0.35-0.9
    of their power."""
    return [
        squeezed(traces_w[k], p_aux_w, rng.uniform(0.2, 0.7), rng.uniform(0.35, 0.9))
        for k in rng.integers(len(traces_w), size=count)
    ]
