"""The optimum over (SOC, engine on): right where the answer is known, and driven as planned."""

import dataclasses
import itertools

import numpy as np
import pytest

from tractor_ems.drive import drive
from tractor_ems.optimal.dp import engine_knots_w, solve
from tractor_ems.optimal.engine_dp import (
    MAX_VALUES,
    REFINEMENT,
    EngineSolution,
    has_engine_state,
    nearest_end_soc,
    relaxed,
    solve_engine,
)
from tractor_ems.optimal.score import dp_ratio
from tractor_ems.policies.planned import PlannedPolicy
from tractor_msgs_py.errors import ConfigError, CycleError
from tractor_msgs_py.trajectory import FloatArray, Trajectory
from tractor_sim.battery import power_limits_w, soc_after
from tractor_sim.config import load_powertrain
from tractor_sim.engine import fuel_rate_kg_per_s
from tractor_sim.generator import to_crank_w
from tractor_sim.powertrain import PowertrainParams

FIELD = load_powertrain("field")
ENERGY_J = FIELD.battery.energy_j


def starting_for(start_fuel_kg: float) -> PowertrainParams:
    engine = dataclasses.replace(FIELD.engine, start_fuel_kg=start_fuel_kg)
    return dataclasses.replace(FIELD, engine=engine)


def burning_kg(params: PowertrainParams, bus_w: FloatArray) -> FloatArray:
    """Fuel of one step of a running engine."""
    crank_w = to_crank_w(params.generator, bus_w, params.engine.power_max_w)
    on = np.ones(np.shape(bus_w), dtype=bool)
    return fuel_rate_kg_per_s(params.engine, crank_w, on) * params.dt_s


def light_work_w(steps: int = 300) -> FloatArray:
    """Turns and light passes, 9..60 kW, as noise that one seed gives."""
    rng = np.random.default_rng(11)
    passes = np.arange(steps) % 60 < 35
    return np.where(passes, rng.normal(52e3, 4e3, steps), rng.normal(12e3, 1e3, steps))


def rolled_out(params: PowertrainParams, solution: EngineSolution) -> Trajectory:
    plan, demand_w = solution.plan, solution.power_demand_w
    policy = PlannedPolicy(params, demand_w, plan.engine_power_w, plan.engine_on)
    return drive(policy, params, demand_w[None, :], float(plan.soc[0]), float(plan.soc[-1]))[0]


def least_fuel_by_enumeration(
    params: PowertrainParams, demand_w: FloatArray, soc: float, target: float, powers: int
) -> float:
    """Every on/off schedule with every power of a fine grid; the last power that is free is the
    one that ends at the target, found by bisection."""
    most_w, steps, battery = float(engine_knots_w(params)[-1]), len(demand_w), params.battery
    grid_w = np.linspace(0.0, most_w, powers)
    best = np.inf
    for schedule in itertools.product((False, True), repeat=steps):
        running = [k for k in range(steps) if schedule[k]]
        chosen = np.meshgrid(*([grid_w] * max(len(running) - 1, 0)), indexing="ij")
        engine_w = np.zeros((steps, chosen[0].size if chosen else 1))
        for k, values in zip(running, chosen, strict=False):
            engine_w[k] = values.ravel()

        def end(engine_w: FloatArray) -> tuple[FloatArray, FloatArray]:
            now, feasible = np.full(engine_w.shape[1], soc), np.ones(engine_w.shape[1], bool)
            for k in range(steps):
                charge_w, discharge_w = power_limits_w(battery, now, params.dt_s)
                power_w = demand_w[k] - engine_w[k]
                feasible &= (power_w <= discharge_w + 1e-6) & (power_w >= -charge_w - 1e-6)
                now = soc_after(battery, now, np.clip(power_w, -charge_w, discharge_w), 1.0)
            return now, feasible

        if running:
            low, high = np.zeros(engine_w.shape[1]), np.full(engine_w.shape[1], most_w)
            for _ in range(34):
                engine_w[running[-1]] = 0.5 * (low + high)
                enough = end(engine_w)[0] >= target
                low, high = (
                    np.where(enough, low, engine_w[running[-1]]),
                    np.where(enough, engine_w[running[-1]], high),
                )
            engine_w[running[-1]] = high
        after, feasible = end(engine_w)
        on = np.array(schedule)
        starts = np.sum(on & ~np.append(False, on[:-1]))
        fuel_kg = np.where(on[:, None], burning_kg(params, engine_w), 0.0).sum(axis=0)
        fuel_kg += starts * params.engine.start_fuel_kg
        allowed = feasible & (after >= target - 1e-9)
        if allowed.any():
            best = min(best, float(fuel_kg[allowed].min()))
    return best


@pytest.mark.parametrize(
    ("demand_kw", "gained_j", "start_fuel_kg"),
    [
        ((60, 90, 40), 0.0, 0.015),
        ((130, 20, 140, 30), 0.0, 0.0),
        ((20, 15, 25, 10), -60e3, 0.002),
        ((170, -40, 60, 120), 50e3, 0.002),
        ((200, 10, 10, 210), -20e3, 0.0005),
        ((200, 10, 10, 210), -20e3, 0.015),
    ],
)
def test_dp_equals_enumeration_of_schedules_and_powers(demand_kw, gained_j, start_fuel_kg):
    params, demand_w = starting_for(start_fuel_kg), 1e3 * np.array(demand_kw, dtype=float)
    target = 0.55 + gained_j / ENERGY_J
    powers = 18 if len(demand_w) == 4 else 60
    expected = least_fuel_by_enumeration(params, demand_w, 0.55, target, powers)
    found = solve_engine(params, demand_w, 0.55, target)
    assert found.lower_bound_kg == pytest.approx(expected, rel=4e-4)
    assert found.lower_bound_kg <= expected * (1.0 + 1e-5)


def test_constant_demand_above_the_battery_is_met_by_constant_engine_power():
    """The battery cannot carry 200 kW, so the engine never stops, and fuel is convex: the mean
    is the optimum, and DP's power does not chatter around it."""
    demand_w = np.full(120, 200e3)
    found = solve_engine(FIELD, demand_w, 0.55, 0.55)
    expected = FIELD.engine.start_fuel_kg + 120 * float(burning_kg(FIELD, np.array(200e3)))
    assert found.lower_bound_kg == pytest.approx(expected, rel=2e-5)
    assert found.plan.engine_power_w == pytest.approx(demand_w, abs=2.0 * found.cell_j)


def test_engine_power_does_not_chatter_on_steady_light_demand():
    found = solve_engine(FIELD, np.full(300, 60e3), 0.55, 0.55)
    on = found.plan.engine_on
    assert found.plan.starts == 1
    both = on[:-1] & on[1:]
    changes_w = np.abs(np.diff(found.plan.engine_power_w))[both]
    # One step per run may round to the last node; none jumps by tens of kilowatts.
    assert np.sort(changes_w)[-3] <= 2.0 * found.cell_j
    assert changes_w.max() < 20e3


def test_a_dear_start_is_made_once_and_a_free_one_often():
    demand_w = light_work_w()
    dear = solve_engine(starting_for(0.5), demand_w, 0.55, 0.55).plan
    free = solve_engine(starting_for(0.0), demand_w, 0.55, 0.55).plan
    assert dear.starts == 1
    assert free.starts >= 4
    assert np.mean(free.engine_on) < 0.9


def test_fuel_grows_with_the_price_of_a_start_and_by_no_more_than_its_starts():
    demand_w = light_work_w()
    cheap, dear = (solve_engine(starting_for(kg), demand_w, 0.55, 0.55) for kg in (0.005, 0.02))
    grown_kg = dear.lower_bound_kg - cheap.lower_bound_kg
    assert 0.015 * dear.plan.starts - 1e-4 <= grown_kg <= 0.015 * cheap.plan.starts + 1e-4


def test_the_relaxed_plant_drives_the_plan_as_it_was_planned():
    found = solve_engine(FIELD, light_work_w(), 0.55, 0.552)
    run = rolled_out(relaxed(FIELD), found)
    assert run.fuel_kg.sum() == pytest.approx(found.plan.fuel_kg.sum(), rel=1e-6)
    assert run.soc_final == pytest.approx(0.552, abs=1e-8)
    assert found.cost_kg == pytest.approx(found.value_kg, rel=1e-4)
    np.testing.assert_array_equal(run.engine_on, found.plan.engine_on)


def test_the_co_state_is_what_a_joule_at_the_end_costs():
    demand_w, half = light_work_w(), 0.005
    below, at, above = (
        solve_engine(FIELD, demand_w, 0.55, 0.55 + change) for change in (-half, 0.0, half)
    )
    slope = (above.lower_bound_kg - below.lower_bound_kg) / (2.0 * half * ENERGY_J)
    assert np.median(at.co_state_kg_per_j) == pytest.approx(slope, rel=0.03)
    assert at.co_state_kg_per_j.shape == demand_w.shape
    assert np.all(at.co_state_kg_per_j >= 0.0)


@pytest.mark.slow
def test_a_price_at_the_end_finds_the_target_that_it_pays_for():
    """With price p the optimum ends where it would end if told to, and costs that less p E."""
    demand_w, price = light_work_w(), 60e-9
    priced = solve_engine(FIELD, demand_w, 0.55, None, end_price_kg_per_j=price)
    end = float(priced.plan.soc[-1])
    assert 0.55 < end < 0.8
    told = solve_engine(FIELD, demand_w, 0.55, end)
    worth_kg = price * (end - 0.55) * ENERGY_J
    assert priced.cost_kg == pytest.approx(told.cost_kg - worth_kg, abs=2e-4 * told.cost_kg)


def test_a_free_end_starts_no_engine_while_the_battery_lasts():
    found = solve_engine(FIELD, light_work_w(), 0.55, None)
    assert found.plan.starts == 0
    assert found.cost_kg == found.value_kg == 0.0


def test_braking_burns_nothing_and_fills_the_battery_to_its_window():
    found = solve_engine(FIELD, np.full(400, -120e3), 0.75, 0.75)
    assert found.cost_kg == 0.0
    assert found.plan.soc.max() == pytest.approx(FIELD.battery.soc_max, abs=1e-9)


def test_unmet_demand_has_a_finite_value_and_no_score():
    demand_w = np.append(np.full(20, 60e3), 700e3)
    found = solve_engine(FIELD, demand_w, 0.55, 0.55)
    assert np.isfinite(found.value_kg)
    assert found.plan.shortfall_j.sum() > 0.0
    assert dp_ratio(FIELD, demand_w, 0.55, 0.55, 1.0, shortfall_j=1.0) is None


def test_work_is_not_left_undone_to_spare_the_battery():
    """A peak that needs the battery comes at the end, and the battery begins nearly empty."""
    demand_w = np.append(np.full(60, 100e3), np.full(20, 370e3))
    found = solve_engine(FIELD, demand_w, 0.305, 0.302)
    assert found.plan.shortfall_j.sum() == 0.0
    assert found.plan.soc[60] > 0.31


def test_without_losses_and_starts_both_programmes_agree():
    """A plant that only has a ramp limit is, relaxed, the paper's."""
    paper = load_powertrain("paper")
    engine = dataclasses.replace(paper.engine, ramp_w_per_s=30e3)
    ramped = dataclasses.replace(paper, engine=engine)
    demand_w = np.random.default_rng(2).uniform(20e3, 250e3, 90)
    known = solve(paper, demand_w, 0.848, soc_initial=0.85)
    expected = float(np.interp(0.85, known.soc_grid[0], known.values[0]))
    assert has_engine_state(ramped)
    assert not has_engine_state(paper)
    found = solve_engine(ramped, demand_w, 0.85, 0.848)
    assert found.lower_bound_kg == pytest.approx(expected, rel=4e-4)


def test_one_step_is_solved_exactly():
    found = solve_engine(FIELD, np.array([80e3]), 0.55, 0.55)
    expected = FIELD.engine.start_fuel_kg + float(burning_kg(FIELD, np.array(80e3)))
    assert found.lower_bound_kg == pytest.approx(expected, rel=1e-6)


def test_the_nearest_reachable_end_is_the_most_that_an_engine_at_its_maximum_gives():
    demand_w, soc = np.full(10, 150e3), np.array([0.55])
    for _ in range(10):
        battery_w = 150e3 - engine_knots_w(FIELD)[-1:]
        soc = soc_after(FIELD.battery, soc, battery_w, 1.0)
    assert nearest_end_soc(FIELD, demand_w, 0.55, 0.8) == pytest.approx(soc[0], abs=1e-12)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"soc_initial": 0.9}, r"soc_initial: 0.9, allowed 0.3..0.8"),
        ({"soc_target": 0.1}, r"soc_target: 0.1, allowed 0.3..0.8"),
        ({"end_price_kg_per_j": 1e-9}, "allowed only without soc_target"),
        ({"soc_target": None, "end_price_kg_per_j": -1.0}, "allowed finite and >= 0"),
        ({"cell_j": 0.0}, "cell_j: 0.0, allowed > 0"),
    ],
)
def test_out_of_range_input_is_named(arguments, message):
    question = {"soc_initial": 0.55, "soc_target": 0.55} | arguments
    with pytest.raises(ConfigError, match=message):
        solve_engine(FIELD, np.full(5, 50e3), **question)


@pytest.mark.parametrize("demand_w", [np.empty(0), np.array([1e3, np.nan]), np.ones((2, 3))])
def test_a_cycle_that_is_not_a_finite_column_is_refused(demand_w):
    with pytest.raises(CycleError, match="power_demand_w"):
        solve_engine(FIELD, demand_w, 0.55, 0.55)


def test_a_fuel_curve_has_a_knot_where_it_leaves_the_idle_rate():
    """There the power alone burns the idle rate."""
    paper = load_powertrain("paper")
    idling = load_powertrain("paper:engine.idle_fuel_kg_per_s=0.0003")
    added_w = np.setdiff1d(engine_knots_w(idling), engine_knots_w(paper))
    assert len(added_w) == 1
    assert fuel_rate_kg_per_s(paper.engine, added_w) == pytest.approx(0.0003, rel=1e-12)


def test_a_long_cycle_says_what_cells_it_got():
    """Tables that cannot hold the band take wider cells; those that can, what was asked for."""
    demand_w, asked_j, most = light_work_w(600), 2e3 / REFINEMENT, 40_000
    usual, small = (
        solve_engine(FIELD, demand_w, 0.55, 0.55, cell_j=2e3, max_values=values)
        for values in (MAX_VALUES, most)
    )
    assert usual.cell_j == pytest.approx(asked_j)
    width = float(np.max(small.band[1] - small.band[0]))
    assert small.cell_j > asked_j
    assert 2 * (len(demand_w) + 1) * width * ENERGY_J / small.cell_j <= most
