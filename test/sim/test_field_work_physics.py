"""Draft, traction, driveline, terrain and time: the physics behind a generated cycle."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tractor_msgs_py.errors import ConfigError
from tractor_sim.duty_cycle.field_work.draft import draft_n, draft_params
from tractor_sim.duty_cycle.field_work.params import FieldWork, operations
from tractor_sim.duty_cycle.field_work.setup import driveline, make_setup
from tractor_sim.duty_cycle.field_work.terrain import flip_alternate, grades, patches
from tractor_sim.duty_cycle.field_work.timeline import autoregressive, speed_profile, to_steps
from tractor_sim.duty_cycle.field_work.traction import (
    gross_traction_ratio,
    motion_resistance_ratio,
    tractive_efficiency,
    wheels,
)

ZERO, ONE = np.zeros(1), np.ones(1)


def rng(seed: int = 1) -> np.random.Generator:
    return np.random.Generator(np.random.PCG64(seed))


def test_draft_of_a_21_tool_chisel_plow_by_hand():
    # 1 x (91 + 5.4 x 8) N x 21 tools x 20 cm
    draft = draft_n(draft_params("chisel_plow_straight_point"), "fine", 21, 20, 8 / 3.6 * ONE)
    assert draft[0] == pytest.approx((91 + 5.4 * 8) * 21 * 20)


def test_draft_of_a_rotary_hoe_knows_no_depth():
    hoe = draft_params("rotary_hoe")
    assert draft_n(hoe, "fine", 3, 7, ONE)[0] == draft_n(hoe, "fine", 3, 1, ONE)[0] == 1800


def test_moldboard_draft_grows_with_the_square_of_speed_and_falls_in_light_soil():
    plow = draft_params("moldboard_plow")
    fine = draft_n(plow, "fine", 1, 1, np.array([0.0, 10 / 3.6]))
    assert fine == pytest.approx([652, 652 + 5.1 * 100])
    assert draft_n(plow, "coarse", 1, 1, ZERO)[0] == pytest.approx(0.45 * 652)


def test_an_unknown_implement_is_refused_by_name():
    with pytest.raises(ConfigError, match=r"spade.*chisel_plow"):
        draft_params("spade")


def test_brixius_ratios_by_hand():
    slip, numeric = np.array([0.1]), 40.0
    gross = 0.88 * (1 - np.exp(-4.0)) * (1 - np.exp(-0.75)) + 0.04
    motion = 1 / 40 + 0.04 + 0.05 / np.sqrt(40)
    assert gross_traction_ratio(slip, numeric) == pytest.approx([gross])
    assert motion_resistance_ratio(slip, numeric) == pytest.approx([motion])
    assert tractive_efficiency(slip, numeric) == pytest.approx([0.9 * (gross - motion) / gross])


@settings(max_examples=40, deadline=None)
@given(st.floats(0.05, 0.55), st.floats(20, 80), st.floats(0.5, 10))
def test_axle_power_is_pull_times_speed_over_tractive_efficiency(ratio, numeric, speed):
    curve = wheels(150e3, numeric)
    pull = np.array([min(ratio * 150e3, curve.pull_limit_n(0.29))])
    efficiency = tractive_efficiency(curve.slip_of(pull), numeric)
    assert curve.axle_power_w(pull, np.array([speed])) == pytest.approx(
        pull * speed / efficiency, rel=1e-3
    )


def test_firmer_soil_needs_less_slip_and_no_pull_exceeds_the_wheels():
    pull = np.array([50e3])
    assert wheels(150e3, 60).slip_of(pull) < wheels(150e3, 25).slip_of(pull)
    assert wheels(150e3, 60).pull_limit_n(0.25) < 0.88 * 150e3


def test_wheels_give_power_back_when_pushed_downhill():
    assert wheels(150e3, 60).axle_power_w(np.array([-30e3]), np.array([5.0]))[0] < 0


def test_braking_gives_the_bus_less_than_the_axle_and_driving_takes_more():
    drive = driveline(operations().vehicle)
    axle = np.array([-80e3, -10e3, 10e3, 80e3])
    bus = drive.axle_to_bus_w(axle)
    assert np.all(np.abs(bus[:2]) < np.abs(axle[:2]))
    assert np.all(bus[:2] < 0)
    assert np.all(bus[2:] > axle[2:])
    assert drive.axle_to_bus_w(np.array([-1e6]))[0] == -drive.regeneration_max_w


def chisel_at_the_engine_w(depth_cm: float) -> float:
    """Crank power of 21 tools at 8 km/h on level, fine soil, before any slowing down [W]."""
    settings_ = operations()
    vehicle, work = settings_.vehicle, settings_.operations["chisel_plow"]
    assert isinstance(work, FieldWork)
    setup = make_setup(
        vehicle,
        work,
        units=21,
        depth_cm=depth_cm,
        texture="fine",
        speed_m_per_s=8 / 3.6,
        wheel_numeric=float(np.mean(work.wheel_numeric)),
    )
    bus = setup.demand_w(8 / 3.6 * ONE, ONE, ZERO, ZERO, ZERO)
    return float(bus[0]) / vehicle.generator_efficiency


@pytest.mark.parametrize(("depth_cm", "engine_kw"), [(11, 105), (20, 190), (33, 314)])
def test_a_chisel_plow_needs_the_published_power_at_the_engine(depth_cm, engine_kw):
    assert chisel_at_the_engine_w(depth_cm) == pytest.approx(engine_kw * 1e3, rel=0.1)


def test_a_rotary_hoe_needs_about_5_5_kw_of_implement_power():
    work = operations().operations["rotary_hoe"]
    assert isinstance(work, FieldWork)
    hoe = draft_params(work.d497)
    drawn = [
        draft_n(hoe, "medium", width, 1, speed / 3.6 * ONE)[0] * speed / 3.6
        for width in work.units
        for speed in np.linspace(*work.speed_km_h, 5)
    ]
    assert np.mean(drawn) == pytest.approx(5.5e3, rel=0.05)
    assert min(drawn) > 0.8 * 5.5e3 and max(drawn) < 1.2 * 5.5e3


def test_soil_patches_return_on_the_next_pass_and_fade_with_distance():
    ground = {"cell_m": 2.0, "length_m": 40.0, "spacing_m": 5.0}
    field = np.concatenate([patches(rng(k), 20, 300, **ground) for k in range(20)], axis=1)
    assert field.mean() == pytest.approx(0, abs=0.1)
    assert field.std() == pytest.approx(1, abs=0.1)
    assert np.corrcoef(field[3], field[4])[0, 1] == pytest.approx(np.exp(-5 / 40), abs=0.06)
    assert abs(np.corrcoef(field[0], field[19])[0, 1]) < 0.3


def test_every_second_pass_meets_the_field_from_the_other_end_and_the_hill_from_below():
    field = np.array([[1.0, 2, 3], [1, 2, 3]])
    assert flip_alternate(field).tolist() == [[1, 2, 3], [3, 2, 1]]
    assert flip_alternate(field, sign=-1.0).tolist() == [[1, 2, 3], [-3, -2, -1]]


def test_grades_stay_within_their_bound():
    grade = grades(rng(), np.arange(5000.0), 0.06, (200.0, 2000.0))
    assert np.abs(grade).max() <= 0.06
    assert grade.std() > 0.005


def test_energy_and_time_survive_the_cut_into_seconds():
    seconds, power = np.array([0.4, 2.3, 1.3]), np.array([100.0, -50.0, 30.0])
    steps = to_steps(4, seconds, power, np.ones(3), np.array([0.0, 1, 0]), np.array([0.0, 0, 1]))
    assert steps.power_w.sum() == pytest.approx((seconds * power).sum())
    assert steps.power_w[0] == pytest.approx(0.4 * 100 + 0.6 * -50)
    assert steps.working.sum() == pytest.approx(2.3)
    assert steps.distance_m == pytest.approx(3.0)


def test_speed_never_changes_faster_than_allowed_and_obeys_every_limit():
    limit = rng().uniform(1.0, 12.0, (3, 200))
    speed, acceleration = speed_profile(limit, 2.0, 1.0, 0.4, 0.6)
    assert np.all(speed <= np.maximum(limit, np.roll(limit, 1, axis=1)) + 1e-9)
    assert acceleration.max() <= 0.4 + 1e-9
    assert acceleration.min() >= -0.6 - 1e-9


@pytest.mark.parametrize("coefficient", [0.0, 0.3, 0.95])
def test_autoregressive_noise_has_unit_spread_and_its_coefficient(coefficient):
    noise = autoregressive(rng(), 100_000, coefficient)
    assert noise.std() == pytest.approx(1, abs=0.05)
    lag1 = np.corrcoef(noise[1:], noise[:-1])[0, 1]
    assert lag1 == pytest.approx(coefficient, abs=0.02)
