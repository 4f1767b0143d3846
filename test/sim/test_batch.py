"""The compiled batch plant is the numpy plant: same state, same step, whatever it is told."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tractor_msgs_py.errors import ConfigError
from tractor_sim.batch import batch_plant, drive_batch, empty_result, limits_batch, step_batch
from tractor_sim.config import load_powertrain
from tractor_sim.generator import GeneratorParams
from tractor_sim.powertrain import (
    Command,
    PlantState,
    PowertrainParams,
    power_limits,
    step,
)

SHIPPED = [
    "paper",
    "paper_table1",
    "field",
    "field:engine.curve=fixed_1800_rpm,engine.start_fuel_kg=0.06,dt_s=0.5",
    "utility_150kw",
    "wheel_loader",
]
LOSSY_PAPER = dataclasses.replace(
    load_powertrain("paper"),
    name="efficiency curve behind a generator, idle rate",
    generator=GeneratorParams((0.0, 0.1, 0.4, 1.0), (0.83, 0.91, 0.94, 0.92)),
    engine=dataclasses.replace(load_powertrain("paper").engine, idle_fuel_kg_per_s=0.25e-3),
)
POWERTRAINS = [*map(load_powertrain, SHIPPED), LOSSY_PAPER]
BATCH = 400


def drawn(
    params: PowertrainParams, seed: int, batch: int = BATCH
) -> tuple[PlantState, np.ndarray, Command]:
    """States of every kind, the ends of their ranges among them; any demand; any command."""
    rng = np.random.default_rng(seed)
    battery, engine = params.battery, params.engine

    def some(low: float, high: float, special: list[float]) -> np.ndarray:
        plain, chosen = rng.uniform(low, high, batch), rng.choice([low, high, *special], batch)
        return np.where(rng.random(batch) < 0.7, plain, chosen)

    top_w = params.generator.curve_efficiency[-1] * engine.power_max_w
    on = rng.random(batch) < 0.5
    state = PlantState(
        soc=np.clip(some(battery.soc_min, battery.soc_max, []), 0.0, 1.0),
        engine_on=on,
        time_in_state_s=params.dt_s * rng.integers(1, 12, batch).astype(float),
        engine_power_w=np.where(on, some(0.0, top_w, [top_w / 2]), 0.0),
    )
    odd = [np.nan, np.inf, -np.inf, 1e30, -1e30, 0.0]
    reach_w = battery.power_max_w + engine.power_max_w
    command = Command(some(-reach_w, reach_w, odd), some(0.0, top_w, [*odd, 0.0, 0.0, np.nan]))
    return state, some(-reach_w, 1.5 * reach_w, [0.0, top_w]), command


def copy_of(state: PlantState) -> PlantState:
    return PlantState(**{f.name: getattr(state, f.name).copy() for f in dataclasses.fields(state)})


def assert_equal(one: object, other: object) -> None:
    for field in dataclasses.fields(one):  # type: ignore[arg-type]
        expected, found = getattr(one, field.name), getattr(other, field.name)
        scale = np.max(np.abs(expected), initial=0.0) if expected.dtype != bool else 0.0
        np.testing.assert_allclose(
            found, expected, rtol=1e-9, atol=1e-12 * scale, err_msg=field.name
        )


@pytest.mark.parametrize("params", POWERTRAINS, ids=lambda p: p.name)
@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), threads=st.integers(1, 3))
def test_a_batch_step_is_the_numpy_step(params, seed, threads):
    state, demand_w, command = drawn(params, seed)
    plant, batch_state, result = batch_plant(params), copy_of(state), empty_result(BATCH)
    assert_equal(power_limits(params, state), limits_batch(plant, state))
    for _ in range(3):
        state, expected = step(params, state, demand_w, command)
        step_batch(plant, batch_state, demand_w, command, result, threads=threads)
        assert_equal(expected, result)
        assert_equal(state, batch_state)


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize("name", ["paper", "field"])
def test_a_drive_is_its_steps_summed_up(name, threads):
    params, batch, steps = load_powertrain(name), 1100, 40
    rng = np.random.default_rng(3)
    state, _, _ = drawn(params, 5, batch)
    driven = copy_of(state)
    demand_w = rng.uniform(-50e3, 300e3, (steps, batch))
    command = Command(
        rng.uniform(-100e3, 100e3, (steps, batch)),
        rng.choice([0.0, np.nan], (steps, batch)),
    )
    totals = drive_batch(batch_plant(params), driven, demand_w, command, threads=threads)
    fuel_kg, starts, shortfall_j = np.zeros(batch), np.zeros(batch), np.zeros(batch)
    for k in range(steps):
        now = Command(command.battery_power_w[k], command.engine_power_w[k])
        state, result = step(params, state, demand_w[k], now)
        fuel_kg += result.fuel_kg
        starts += result.engine_started
        shortfall_j += result.shortfall_j
    assert_equal(state, driven)
    np.testing.assert_allclose(totals.fuel_kg, fuel_kg, rtol=1e-9)
    np.testing.assert_array_equal(totals.starts, starts)
    np.testing.assert_allclose(totals.shortfall_j, shortfall_j, rtol=1e-9, atol=1e-6)
    assert totals.starts.sum() > 0


def test_a_lookup_is_exact_at_and_beside_every_knot():
    params = load_powertrain("field")
    knots_soc = np.array(params.battery.ocv_soc)
    soc = np.concatenate((knots_soc, np.nextafter(knots_soc, 0), np.nextafter(knots_soc, 1)))
    state = PlantState(soc, np.zeros(len(soc), bool), np.full(len(soc), 9.0), np.zeros(len(soc)))
    assert_equal(power_limits(params, state), limits_batch(batch_plant(params), state))


def test_arrays_of_another_length_are_refused_before_compiled_code_reads_them():
    params = load_powertrain("paper")
    state, demand_w, command = drawn(params, 1)
    with pytest.raises(ValueError, match=r"\(399,\), allowed \(400,\)"):
        step_batch(batch_plant(params), state, demand_w[:-1], command, empty_result(BATCH))
    with pytest.raises(ValueError, match=r"allowed \(3, 400\)"):
        drive_batch(batch_plant(params), state, np.zeros((3, BATCH)), command)


def test_knots_too_close_for_the_tables_are_refused():
    params = load_powertrain("paper")
    generator = GeneratorParams((0.0, 0.5, 0.5 + 1e-7, 1.0), (0.9,) * 4)
    with pytest.raises(ConfigError, match="knots of a curve"):
        batch_plant(dataclasses.replace(params, generator=generator))
