"""Is a recorded demand the cycle its run announced, auxiliaries taken off?

A plant adds its auxiliaries to every step of the cycle; what a run announces is the hash of the
cycle without them, so they have to come off again without a bit of rounding.
"""

from typing import Literal

import numpy as np

from tractor_msgs_py.errors import CycleError
from tractor_msgs_py.trajectory import FloatArray
from tractor_msgs_py.types import RunInfo
from tractor_sim.duty_cycle.cycle import DutyCycle, cycle_hash
from tractor_sim.duty_cycle.library import cycle_names, load_cycle

Answer = Literal["same", "other", "unknown"]


def compare(demand_w: FloatArray, announced: RunInfo) -> Answer:
    """``same``, ``other``, or ``unknown`` where rounding hides the cycle and it is not a listed
    one.

    Args:
        demand_w: (T,), recorded demand, auxiliaries included [W].
        announced: the run's announcement.
    """
    without_w = demand_w - announced.p_aux_w
    if _has_hash(without_w, announced):
        return "same"
    if announced.p_aux_w == 0.0:
        return "other"
    # Generated cycles are whole watts: that guess is right where the sum is the record exactly.
    whole_w = np.rint(without_w)
    summed = bool(np.all(whole_w + announced.p_aux_w == demand_w))
    if summed and _has_hash(whole_w, announced):
        return "same"
    if announced.cycle in cycle_names():
        listed = load_cycle(announced.cycle)
        if cycle_hash(listed) == announced.cycle_hash:
            same = np.array_equal(listed.power_demand_w + announced.p_aux_w, demand_w)
            return "same" if same else "other"
    return "other" if summed or _exact(demand_w, without_w, announced.p_aux_w) else "unknown"


def _has_hash(demand_w: FloatArray, announced: RunInfo) -> bool:
    try:
        return cycle_hash(DutyCycle("", demand_w, announced.dt_s, "")) == announced.cycle_hash
    except CycleError:  # no cycle at all, for instance at steps of several minutes
        return False


def _exact(demand_w: FloatArray, without_w: FloatArray, p_aux_w: float) -> bool:
    """Whether the plant's sums can have had no rounding, so that the differences are the cycle.

    So where the auxiliaries are a multiple of the difference's last place and the record's last
    place is no coarser, and between whole watts.
    """
    place_w = np.spacing(np.abs(without_w))
    fine = (np.fmod(p_aux_w, place_w) == 0.0) & (np.spacing(np.abs(demand_w)) <= place_w)
    whole = (np.rint(demand_w) == demand_w) & (np.rint(p_aux_w) == p_aux_w)
    return bool(np.all(fine | whole))
