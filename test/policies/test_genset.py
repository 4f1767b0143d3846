"""The best point is the one at the bus, and idling costs what it costs."""

import numpy as np
import pytest

from tractor_ems.policies.genset import best_power_w, power_max_w, running_fuel_kg_per_s
from tractor_sim.config import load_powertrain
from tractor_sim.engine import best_power_w as best_crank_w
from tractor_sim.engine import fuel_rate_kg_per_s
from tractor_sim.generator import to_bus_w


@pytest.mark.parametrize("name", ["paper", "field", "field:engine.curve=fixed_1800_rpm"])
def test_no_bus_power_gives_more_energy_per_fuel_than_the_best_point(name):
    params = load_powertrain(name)
    bus_w = np.linspace(1e3, power_max_w(params), 20_001)
    best_w = np.array(best_power_w(params))
    best = running_fuel_kg_per_s(params, best_w) / best_w
    assert best <= np.min(running_fuel_kg_per_s(params, bus_w) / bus_w) * (1 + 1e-12)


def test_with_an_ideal_generator_it_is_the_engines_own():
    paper = load_powertrain("paper")
    assert best_power_w(paper) == best_crank_w(paper.engine) == 150e3


def test_generator_losses_move_it_below_the_engines_own():
    field = load_powertrain("field")
    engine = field.engine
    crank_best_w = np.array(best_crank_w(engine))
    assert best_power_w(field) < to_bus_w(field.generator, crank_best_w, engine.power_max_w)


def test_an_idling_engine_burns_and_full_power_is_the_engines_less_losses():
    field = load_powertrain("field")
    assert running_fuel_kg_per_s(field, np.zeros(1))[0] == field.engine.curve_fuel_kg_per_s[0] > 0
    peak_w = field.engine.power_max_w
    assert power_max_w(field) == pytest.approx(peak_w * field.generator.curve_efficiency[-1])
    assert running_fuel_kg_per_s(field, np.array(power_max_w(field))) == pytest.approx(
        float(fuel_rate_kg_per_s(field.engine, np.array(peak_w)))
    )
