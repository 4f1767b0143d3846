"""The planter family is the paper's pass to the bit, and a function of its seed."""

import numpy as np
import pytest

from tractor_msgs_py.errors import CycleError
from tractor_sim.duty_cycle.cycle import cycle_hash
from tractor_sim.duty_cycle.library import cycle_names, load_cycle

PLANTER_HASH = "11cbea8de1f2b70a1844f75fb8a33a9b21c441fa1864aa0b20822b60532c3d5d"


def test_planter_is_the_papers_pass_to_the_bit():
    cycle = load_cycle("planter")
    assert len(cycle) == 766
    assert cycle.power_demand_w.mean() == pytest.approx(143.0e3)
    assert cycle.power_demand_w.sum() == pytest.approx(109.5e6, rel=1e-3)
    assert cycle_hash(cycle) == PLANTER_HASH


def test_the_same_seed_is_the_same_cycle_and_another_seed_another():
    assert cycle_hash(load_cycle("planter_3")) == cycle_hash(load_cycle("planter_3"))
    names = [name for name in cycle_names() if name.startswith("planter")]
    assert len({cycle_hash(load_cycle(name)) for name in names}) == len(names) == 111


def test_a_pass_is_broken_by_headland_turns():
    demand_w = load_cycle("planter").power_demand_w
    turning = demand_w < 90e3
    assert 0.08 < turning.mean() < 0.25
    assert np.median(demand_w[~turning]) == pytest.approx(160e3, rel=0.1)


@pytest.mark.parametrize("name", ["planter_5000", "planter_x", "plough", ""])
def test_an_unknown_cycle_is_refused(name):
    with pytest.raises(CycleError, match="planter"):
        load_cycle(name)
