"""Where in its cycle a policy made for one cycle is, and the refusal of any other."""

import numpy as np

from tractor_msgs_py.errors import RunAborted
from tractor_msgs_py.observation import Observation
from tractor_msgs_py.trajectory import FloatArray
from tractor_sim.powertrain import ROUNDING_W


def tick_of(power_demand_w: FloatArray, observation: Observation, t0_ns: int, dt_s: float) -> int:
    """Index of an observation in the cycle (T,) that began at ``t0_ns``.

    Raises:
        RunAborted: the stamp is no tick of the cycle, or the demand is not the cycle's there.
    """
    k, rest = divmod(observation.stamp_ns - t0_ns, round(dt_s * 1e9))
    if rest or not 0 <= k < len(power_demand_w):
        raise RunAborted(
            f"dp: stamp {observation.stamp_ns} ns is tick {k} and {rest} ns, "
            f"the solved cycle has ticks 0..{len(power_demand_w) - 1} from {t0_ns} ns"
        )
    differs = ~(np.abs(observation.power_demand_w - power_demand_w[k]) <= ROUNDING_W)
    if differs.any():
        seen_w = observation.power_demand_w[np.argmax(differs)]
        raise RunAborted(
            f"dp: tick {k}: power_demand is {seen_w} W, the solved cycle has {power_demand_w[k]} W"
        )
    return k
