"""The feasible part of the action grid as two integers."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from tractor_ems.policies.action_grid import applied_index, feasible_range, in_range
from tractor_sim.powertrain import project

GRID_W = np.linspace(-250e3, 250e3, 1600)
power = st.floats(-250e3, 250e3)


@given(power, power)
def test_the_range_holds_every_distinct_action_once(lb_w: float, ub_w: float):
    lb, ub = np.array([min(lb_w, ub_w)]), np.array([max(lb_w, ub_w)])
    first, last = feasible_range(GRID_W, lb, ub)
    projected = project(GRID_W, lb, ub)
    inside = projected[first[0] : last[0] + 1]
    assert set(inside) == set(projected)
    assert inside[0] == lb and inside[-1] == ub


@given(power)
def test_engine_off_is_the_last_feasible_action_whatever_the_demand(demand_w: float):
    lb, ub = np.array([-250e3]), np.array([demand_w])
    _, last = feasible_range(GRID_W, lb, ub)
    assert project(GRID_W[last], lb, ub)[0] == demand_w


def test_no_choice_means_lb():
    lb, ub = np.array([260e3, 10e3]), np.array([250e3, -20e3])
    first, last = feasible_range(GRID_W, lb, ub)
    for index in (first, last):
        assert np.array_equal(project(GRID_W[index], lb, ub), lb)


@given(st.integers(0, 1599), st.floats(-250e3, 0.0), st.floats(1e3, 250e3))
def test_an_applied_grid_action_gets_its_own_index(index: int, lb_w: float, ub_w: float):
    lb, ub = np.array([lb_w]), np.array([ub_w])
    applied = project(GRID_W[[index]], lb, ub)
    on = applied < ub
    got = applied_index(GRID_W, applied, on, lb, ub)
    assert project(GRID_W[got], lb, ub) == applied


def test_engine_off_and_almost_off_are_different_actions():
    lb, ub = np.array([-100e3, -100e3]), np.array([50_100.0, 50_100.0])
    applied = np.array([50_100.0, 50_090.0])
    off, on = applied_index(GRID_W, applied, np.array([False, True]), lb, ub)
    assert off == feasible_range(GRID_W, lb, ub)[1][0]
    assert on == off - 1


def test_the_mask_is_the_range():
    mask = in_range(np.array([1, 3]), np.array([2, 3]), 5)
    assert mask.tolist() == [[False, True, True, False, False], [False, False, False, True, False]]
