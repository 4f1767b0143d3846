"""What an action means in watts, and which actions mean something different at a state."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tractor_msgs_py.trajectory import BoolArray, FloatArray, IntArray
from tractor_sim.generator import to_bus_w
from tractor_sim.gym.settings import Settings
from tractor_sim.powertrain import (
    ROUNDING_W,
    Command,
    PowerLimits,
    PowertrainParams,
    battery_power_grid_w,
)


@dataclass(frozen=True)
class Actions:
    """A actions.

    Attributes:
        engine: whether they are engine powers, action 0 being off or, where the engine must
            run, its least power.
        power_w: (A,), at the bus, increasing [W].
    """

    engine: bool
    power_w: FloatArray


def make_actions(settings: Settings, params: PowertrainParams) -> Actions:
    """Off and equal steps up to the engine's largest power at the bus, or the paper's grid of
    battery powers over -P_b,max..P_b,max."""
    if settings.actions == "battery":
        return Actions(False, battery_power_grid_w(params, settings.count))
    peak_w = params.engine.power_max_w
    top_w = float(to_bus_w(params.generator, np.array(peak_w), peak_w))
    return Actions(True, np.linspace(0.0, top_w, settings.count))


def command_of(actions: Actions, action: IntArray, power_demand_w: FloatArray) -> Command:
    """The plant's command of B actions, (B,)."""
    power_w = actions.power_w[action]
    if not actions.engine:
        return Command(power_w, np.full(len(action), np.nan))
    return Command(power_demand_w - power_w, np.where(action == 0, 0.0, np.nan))


def action_mask(
    actions: Actions, limits: PowerLimits, power_demand_w: FloatArray
) -> NDArray[np.int8]:
    """1 where an action has an effect of its own, (B, A); never a row of zeros.

    The actions between the limits, and on either side the nearest one beyond, which the plant
    clips to the limit. So every feasible power is within reach, and two actions that differ do
    different things. Engine off is among them where, and only where, it is possible.
    """
    can_run = limits.engine_w > 0.0
    off = (limits.may_be_off & (power_demand_w <= limits.discharge_w)) | ~can_run
    low_w = np.maximum(limits.engine_least_w, power_demand_w - limits.discharge_w)
    low_w = np.minimum(low_w, limits.engine_w)
    high_w = np.minimum(limits.engine_w, power_demand_w + limits.charge_w)
    run = can_run & ((high_w > ROUNDING_W) | ~limits.may_be_off)
    power_w, top = actions.power_w, len(actions.power_w) - 1
    if actions.engine:
        first, last = _reaching(power_w, low_w, high_w)
        first = np.where(off, np.maximum(first, 1), first)
        at_off: IntArray = np.zeros_like(first)
    else:
        first, last = _reaching(power_w, power_demand_w - high_w, power_demand_w - low_w)
        at_off = np.searchsorted(power_w, power_demand_w - ROUNDING_W, side="left")
        last = np.where(off, np.minimum(last, at_off - 1), last)
        at_off = np.minimum(at_off, top)
    last = np.where(high_w > low_w, np.maximum(first, last), first)
    index = np.arange(top + 1)
    inside: BoolArray = (index >= first[:, None]) & (index <= last[:, None]) & run[:, None]
    inside[off, at_off[off]] = True
    return inside.astype(np.int8)


def _reaching(
    power_w: FloatArray, low_w: FloatArray, high_w: FloatArray
) -> tuple[IntArray, IntArray]:
    """Indices of the last power at or below ``low_w`` and of the first at or above ``high_w``."""
    top = len(power_w) - 1
    first = np.clip(np.searchsorted(power_w, low_w, side="right") - 1, 0, top)
    last = np.clip(np.searchsorted(power_w, high_w, side="left"), 0, top)
    return first, last
