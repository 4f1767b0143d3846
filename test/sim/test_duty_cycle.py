"""Cycles are a function of their seed, training never sees a held-out one, bad CSV is refused."""

import numpy as np
import pytest

from tractor_msgs_py.errors import CycleError
from tractor_sim.duty_cycle.cycle import cycle_hash, read_cycle_csv
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
    hashes = {cycle_hash(load_cycle(name)) for name in cycle_names()}
    assert len(hashes) == len(cycle_names())


def test_training_and_held_out_cycles_are_disjoint_by_hash():
    held_out = {cycle_hash(load_cycle(name)) for name in cycle_names("held_out")}
    train = {cycle_hash(load_cycle(name)) for name in cycle_names("train")}
    assert len(held_out) >= 5
    assert len(train) >= 66
    assert not held_out & train


def test_a_pass_is_broken_by_headland_turns():
    demand_w = load_cycle("planter").power_demand_w
    turning = demand_w < 90e3
    assert 0.08 < turning.mean() < 0.25
    assert np.median(demand_w[~turning]) == pytest.approx(160e3, rel=0.1)


@pytest.mark.parametrize("name", ["planter_5000", "planter_x", "plough", ""])
def test_an_unknown_cycle_is_refused(name):
    with pytest.raises(CycleError, match="planter"):
        load_cycle(name)


def write(tmp_path, text):
    path = tmp_path / "mine.csv"
    path.write_text(text)
    return path


def test_a_csv_cycle_is_read(tmp_path):
    path = write(tmp_path, "time_s,power_demand_w\n0,1000\n0.5,-2000\n1.0,3000\n")
    cycle = read_cycle_csv(path)
    assert cycle.dt_s == 0.5
    assert cycle.power_demand_w.tolist() == [1000.0, -2000.0, 3000.0]


def test_times_since_1970_are_even_enough(tmp_path):
    rows = "\n".join(f"{1_700_000_000 + k / 10:.1f},{1000 * k}" for k in range(300))
    assert read_cycle_csv(write(tmp_path, f"time_s,power_demand_w\n{rows}\n")).dt_s == 0.1


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("", "rows"),
        ("time_s,power_w\n0,1\n1,2\n", "power_demand_w"),
        ("time_s,power_demand_w\n0,1\n1,nan\n", "sample 1"),
        ("time_s,power_demand_w\n0,1\n1,inf\n", "sample 1"),
        ("time_s,power_demand_w\n0,1\n1,abc\n", "'abc'"),
        ("time_s,power_demand_w\n0,1\n1,\n", "mine.csv:3"),
        ("time_s,power_demand_w\n0,1\n1,2\n3,4\n", "equal steps"),
        ("time_s,power_demand_w\n1,1\n0,2\n", "equal steps"),
    ],
)
def test_a_malformed_csv_is_refused_by_name(tmp_path, text, named):
    with pytest.raises(CycleError) as caught:
        read_cycle_csv(write(tmp_path, text))
    assert named in str(caught.value)
    assert "\n" not in str(caught.value)
