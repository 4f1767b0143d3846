"""The learner of running and standing, and that what it learns drives as it was scored."""

import numpy as np
import pytest

from tractor_ems.drive import drive
from tractor_ems.learning.run_or_stand import Learner, Settings
from tractor_ems.optimal.one_step_kernel import Cell
from tractor_ems.policies.genset import power_max_w, running_fuel_kg_per_s
from tractor_ems.policies.mlp import Mlp
from tractor_ems.policies.q_policy import Normalisation
from tractor_ems.policies.run_or_stand import SLOPE_STEP, RunOrStand
from tractor_ems.tuning import closed_loop
from tractor_msgs_py.observation import DemandFilter, ObservationSpec, filter_trace
from tractor_sim.batch import batch_plant
from tractor_sim.config import load_powertrain

FIELD = load_powertrain("field")
BATTERY = FIELD.battery
CELL = Cell(BATTERY.resistance_ohm, BATTERY.charge_c / FIELD.dt_s, BATTERY.power_max_w)
MOST_W = power_max_w(FIELD)
FUEL_KG = running_fuel_kg_per_s(FIELD, np.linspace(0.0, MOST_W, 4097)) * FIELD.dt_s
SPEC = ObservationSpec(dt_s=1.0, filters=(DemandFilter("low_pass", 8.0),))
SCALING = Normalisation(80e3, 50e3)


def work(steps):
    """Two minutes of light work and one of passes, in turn."""
    k = np.arange(steps)
    return np.where(k % 180 < 120, 25e3, 130e3) + 5e3 * np.sin(k / 7.0)


def inputs_of(demand_w):
    signals = np.column_stack((demand_w, filter_trace(SPEC, demand_w, 1.0)))
    return ((signals - SCALING.demand_offset_w) / SCALING.demand_scale_w).astype(np.float32)


def learner(seed=0, **settings):
    demand_w = work(900)
    given = Settings(updates=40, batch=32, commit=6, hidden=(16, 16), **settings)
    return Learner(
        given, CELL, FUEL_KG, MOST_W, BATTERY.power_max_w, 659.0, [demand_w],
        [inputs_of(demand_w)], seed,
    )  # fmt: skip


@pytest.mark.slow
def test_the_policy_drives_as_the_compiled_loop_does():
    made = learner()
    for _ in range(40):
        made.update()
    weights = made.weights()
    nets = Mlp(
        tuple(w.astype(np.float32) for w in weights[0::2]),
        tuple(b.astype(np.float32) for b in weights[1::2]),
        "tanh",
    )
    s, demand_w = made.s, work(600)
    policy = RunOrStand(FIELD, SPEC, (nets,), SCALING, s.price_kg, s.start_kg, s.unit_kg)
    run = drive(policy, FIELD, demand_w[None, :], 0.55, 0.55)[0]
    totals = np.zeros(9)
    closed_loop.drive_choice(
        *batch_plant(FIELD), CELL, FUEL_KG, MOST_W, demand_w,
        inputs_of(demand_w).astype(float), 0.55, 0.55, s.price_kg, s.start_kg, s.unit_kg,
        s.soc_scale, SLOPE_STEP, *(w[None] for w in weights), totals, np.zeros((0, 3)),
    )  # fmt: skip
    assert totals[closed_loop.FUEL] == pytest.approx(run.fuel_kg.sum(), rel=2e-4)
    assert totals[closed_loop.SOC_FINAL] == pytest.approx(run.soc_final, abs=2e-4)


def test_equal_seeds_learn_equal_weights_and_others_do_not():
    first, again, other = learner(1), learner(1), learner(2)
    for made in (first, again, other):
        for _ in range(5):
            made.update()
    assert all(np.array_equal(a, b) for a, b in zip(first.weights(), again.weights(), strict=True))
    assert not np.array_equal(first.weights()[0], other.weights()[0])


def test_standing_saves_the_fuel_of_idling_and_costs_no_start_while_it_lasts():
    """With equal values afterwards, 25 kW carried by the battery at the price of running is
    cheaper than running by about the idling fuel of the stretch."""
    made = learner(price_kg=144e6 * 197e-3 / 3.6e6)
    for net in (made.online, made.target):
        net.weights[-1].data.zero_()
        net.biases[-1].data.zero_()
    _, gain = made.backup(np.arange(20, 60), np.zeros(40))
    idling_kg = made.s.commit * FIELD.engine.idle_fuel_kg_per_s
    assert np.median(gain) * made.s.unit_kg == pytest.approx(idling_kg, rel=0.25)


def test_what_the_battery_cannot_carry_alone_is_no_choice():
    made = learner()
    made.demand_w[:] = 140e3
    _, gain = made.backup(np.arange(20, 30), np.zeros(10))
    assert np.all(gain == -3.0 * made.s.start_kg / made.s.unit_kg)
