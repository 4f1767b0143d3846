"""Stand-ins for field work, short enough for tests: demand at the bus [W] at 1 s."""

import numpy as np

from tractor_ems.drive import drive
from tractor_sim.config import load_powertrain

FIELD = load_powertrain("field")


def passes(high_w, low_w, steps, pass_s=33, turn_s=39):
    """Passes and turns of the measured lengths, with ramps of 60 kW/s between."""
    square = np.where(np.arange(steps) % (pass_s + turn_s) < turn_s, low_w, high_w)
    demand_w = square.astype(float)
    for k in range(1, steps):
        demand_w[k] = np.clip(square[k], demand_w[k - 1] - 60e3, demand_w[k - 1] + 60e3)
    return demand_w


HEAVY = passes(235e3, 40e3, 900)
MEDIUM = passes(100e3, 30e3, 900)
LIGHT = np.full(900, 24e3)
MIXED = np.concatenate([LIGHT[:450], HEAVY[:450]])
ALL = np.stack([HEAVY, MEDIUM, LIGHT, MIXED])


def driven(policy, demand_w, soc=0.55, params=FIELD):
    """Trajectories of a batch (B, T) of demand."""
    return drive(policy, params, np.atleast_2d(demand_w), soc, 0.55)
