"""Generated cycles depend on their seed alone, are drivable, and look like the work they name."""

from itertools import pairwise

import numpy as np
import pytest

from tractor_msgs_py.errors import ConfigError, CycleError
from tractor_sim.duty_cycle.cycle import cycle_hash
from tractor_sim.duty_cycle.field_work import params
from tractor_sim.duty_cycle.field_work.limits import highest_window_mean_w
from tractor_sim.duty_cycle.field_work.params import FieldWork, operations
from tractor_sim.duty_cycle.field_work.statistics import pass_bounds
from tractor_sim.duty_cycle.generate import MEASURED_JOBS, OPERATIONS, generate, work_of
from tractor_sim.resources import resource_path

NAMES = OPERATIONS + MEASURED_JOBS
# What "field" delivers: about 249 kW of engine at the bus after auxiliaries, 150 kW of battery.
FIVE_MINUTES_MAX_W = 225e3
SAMPLE_MAX_W = 370e3
FIELD_WORK = [n for n, w in operations().operations.items() if isinstance(w, FieldWork)]


def test_the_names_of_the_library_are_all_there():
    assert set(NAMES) == set(operations().operations)
    assert {"chisel_plow", "rotary_hoe", "baler", "loader", "road_transport"} <= set(OPERATIONS)


@pytest.mark.parametrize("name", NAMES)
def test_a_cycle_is_a_function_of_operation_seed_and_duration(name):
    cycle = generate(name, 5)
    assert (cycle.name, cycle.seed, cycle.operation) == (f"{name}_5", 5, name)
    assert (len(cycle), cycle.dt_s, cycle.split) == (1800, 1.0, None)
    assert cycle_hash(cycle) == cycle_hash(generate(name, 5))
    assert cycle_hash(cycle) != cycle_hash(generate(name, 6))
    # Whole watts, so that the bytes do not depend on a processor's last bit.
    assert np.array_equal(cycle.power_demand_w, np.round(cycle.power_demand_w))


@pytest.mark.parametrize("name", NAMES)
def test_no_default_cycle_asks_more_than_the_field_vehicle_holds(name):
    for seed in range(1, 16):
        power = generate(name, seed).power_demand_w
        assert highest_window_mean_w(power, 300) < FIVE_MINUTES_MAX_W
        assert power.max() < SAMPLE_MAX_W
        assert power.min() >= -operations().vehicle.regeneration_max_w


def test_too_deep_a_chisel_plow_is_driven_slower_not_above_the_limit():
    slower = []
    for seed in range(1, 11):
        shallow, deep = (work_of("chisel_plow", seed, depth_cm=cm) for cm in (10, 40))
        assert highest_window_mean_w(deep.power_w, 300) < FIVE_MINUTES_MAX_W
        assert deep.power_w.max() < SAMPLE_MAX_W
        slower.append(deep.area_m2 / shallow.area_m2)
    assert max(slower) <= 1.0
    assert min(slower) < 0.85


def test_deeper_is_heavier_in_the_same_field():
    means = [generate("chisel_plow", 8, depth_cm=cm).power_demand_w.mean() for cm in (10, 15, 20)]
    assert means == sorted(means)
    assert means[2] > 1.3 * means[0]


@pytest.mark.parametrize("name", FIELD_WORK)
def test_area_is_width_times_way_worked(name):
    work, cycle = work_of(name, 4), generate(name, 4)
    item = operations().operations[name]
    widest = max(item.units) * item.unit_width_m / np.sqrt(0.45)
    fastest = 1.2 * item.speed_km_h[1] / 3.6
    assert cycle.area_ha == pytest.approx(work.area_m2 / 1e4)
    assert 0 < work.area_m2 < widest * fastest * 1800
    slowest = min(item.units) * item.unit_width_m * (1 - item.overlap) * 0.25 * item.speed_km_h[0]
    assert work.area_m2 > slowest / 3.6 * work.working.sum()


@pytest.mark.parametrize("name", ["loader", "road_transport", "mixed_day", *MEASURED_JOBS])
def test_work_without_a_width_has_no_area(name):
    assert generate(name, 1).area_ha is None


@pytest.mark.parametrize("name", ["chisel_plow", "moldboard_plow", "field_cultivator"])
def test_headland_turns_last_as_measured_and_take_little_power(name):
    lengths, levels = [], []
    for seed in range(1, 9):
        work = work_of(name, seed)
        turning = (work.working < 0.5) & (work.standing < 0.5)
        edges = np.flatnonzero(np.diff(np.concatenate([[0], turning.astype(int), [0]])))
        whole = edges.reshape(-1, 2)[1:-1]
        lengths += (whole[:, 1] - whole[:, 0]).tolist()
        levels.append(work.power_w[turning].mean())
    assert 31 <= np.median(lengths) <= 40
    share = np.mean(levels) / operations().vehicle.rated_power_w
    assert 0.06 <= share <= 0.2


def test_light_work_is_light_and_heavy_work_heavy():
    mean_kw = {
        name: np.mean([generate(name, s).power_demand_w.mean() for s in range(1, 9)]) / 1e3
        for name in ("rotary_hoe", "row_crop_planter", "field_cultivator", "forage_harvest")
    }
    assert list(mean_kw.values()) == sorted(mean_kw.values())
    assert mean_kw["rotary_hoe"] < 45
    assert mean_kw["forage_harvest"] > 130


def test_hills_and_stops_of_the_road_give_power_back():
    powers = [generate("road_transport", seed).power_demand_w for seed in range(1, 9)]
    assert all(power.min() < -20e3 for power in powers)
    assert all(power.mean() > 0 for power in powers)


def test_the_plunger_shows_at_its_alias_not_at_its_frequency():
    # 1.42-1.58 strokes per second are above what 1 s steps hold; they fold to 0.42-0.5 Hz.
    power = np.concatenate([work_of("baler", s).power_w for s in range(1, 9)])
    density = np.abs(np.fft.rfft(power - power.mean())) ** 2
    frequency = np.fft.rfftfreq(len(power))
    fast = density[(frequency > 0.41) & (frequency < 0.5)].mean()
    assert fast > 2 * density[(frequency > 0.25) & (frequency < 0.35)].mean()


def test_a_mixed_day_misleads_by_its_mean():
    for seed in range(1, 6):
        power = generate("mixed_day", seed).power_demand_w
        minutes = power.reshape(30, 60).mean(axis=1)
        assert minutes.std() > 0.4 * power.mean()


def test_soil_returns_at_the_same_place_on_the_way_back():
    mirrored, straight = [], []
    for seed in range(1, 40):
        work = work_of("moldboard_plow", seed, duration_s=2400)
        # Skip the flanks; passes one after another run in opposite directions.
        passes = [work.power_w[a + 12 : b - 6] for a, b in pass_bounds(work.working)[:-1].tolist()]
        for there, back in pairwise(passes):
            n = min(len(there), len(back))
            mirrored.append(np.corrcoef(there[:n], back[::-1][:n])[0, 1])
            straight.append(np.corrcoef(there[:n], back[:n])[0, 1])
    assert len(mirrored) > 50
    assert np.mean(mirrored) > np.mean(straight) + 0.1


@pytest.mark.parametrize("duration_s", [1, 37, pytest.param(43_200, marks=pytest.mark.slow)])
def test_any_duration_from_one_second_to_half_a_day(duration_s):
    for name in ("chisel_plow", "loader", "road_transport", "mixed_day", "measured_job_a"):
        power = generate(name, 2, duration_s=duration_s).power_demand_w
        assert len(power) == duration_s
        assert np.all(np.isfinite(power))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"operation": "ploughing"}, "ploughing.*chisel_plow.*measured_job_b"),
        ({"seed": -1}, "seed -1.*0 to"),
        ({"seed": 1.5}, "seed 1.5.*whole"),
        ({"seed": True}, "seed True"),
        ({"duration_s": 0}, "duration_s 0.*1 to 172800"),
        ({"duration_s": 200_000}, "200000"),
        ({"depth_cm": 60.0}, "depth_cm 60.0.*chisel_plow 5 to 40"),
        ({"depth_cm": float("nan")}, "depth_cm nan"),
        ({"operation": "loader", "depth_cm": 10.0}, "loader has no depth.*chisel_plow"),
    ],
)
def test_bad_arguments_name_what_is_allowed(arguments, message):
    given = {"operation": "chisel_plow", "seed": 1, **arguments}
    with pytest.raises(CycleError, match=message):
        generate(given.pop("operation"), given.pop("seed"), **given)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("    d497: rotary_hoe\n", "    d497: spade\n", r"rotary_hoe.d497: 'spade'.*tandem"),
        ("  rated_power_w: 275.0e+3", "  rated_power_w: -1.0", r"rated_power_w.*-1"),
        ("    grade_max: 0.05\n", "    grade_maximum: 0.05\n", r"grade_max"),
        ("operations: [loader]", "operations: [mixed_day]", r"mixed_day.parts: 'mixed_day'"),
        ("motor_load_fraction: [0.0,", "motor_load_fraction: [", r"motor curve"),
    ],
)
def test_a_wrong_setting_is_refused_by_name(tmp_path, monkeypatch, old, new, message):
    text = resource_path("config", "cycle", "operations.yaml").read_text()
    assert old in text
    path = tmp_path / "operations.yaml"
    path.write_text(text.replace(old, new))
    monkeypatch.setattr(params, "resource_path", lambda *parts: path)
    with pytest.raises(ConfigError, match=message):
        operations.__wrapped__()
