"""Disturbances do what they are called, and nothing where they are none."""

import numpy as np
import pytest

from tractor_ems.drive import Interference, drive
from tractor_ems.policies.registry import make_rule
from tractor_ems.result import count_violations
from tractor_ems.study.disturbances import NONE, Disturbance, disturbed, interference_of, noise
from tractor_msgs_py.errors import ConfigError
from tractor_msgs_py.trajectory import trajectory_hash
from tractor_sim.config import load_powertrain
from tractor_sim.engine import fuel_rate_kg_per_s
from tractor_sim.powertrain import Command

STEPS = 60


@pytest.fixture(scope="module")
def field():
    return load_powertrain("field")


def demand_w():
    return 60e3 + 50e3 * np.sin(np.arange(STEPS) / 5.0)[None, :]


class Watching:
    """Runs the engine at the demand it sees, and remembers what it saw."""

    name = "watching"

    def __init__(self, params):
        self.inner = make_rule("conventional", params)
        self.spec = self.inner.spec
        self.seen = []

    def init(self, batch):
        return self.inner.init(batch)

    def act(self, observation, state):
        self.seen.append(observation)
        return self.inner.act(observation, state)


class Counting(Watching):
    """Asks for one more watt of battery power every step."""

    def act(self, observation, state):
        number = float(len(self.seen))
        self.seen.append(observation)
        batch = len(observation.soc)
        return Command(np.full(batch, number), np.full(batch, np.nan)), state


def seen_under(disturbance, field, kind=Watching):
    policy = kind(field)
    interference = interference_of([disturbance], STEPS, field.dt_s, [7])
    (run,) = drive(policy, field, demand_w(), 0.55, 0.55, interference=interference)
    return policy.seen, run


def test_no_interference_and_none_of_it_are_the_same_run(field):
    policy = make_rule("load_levelling", field)
    (plain,) = drive(policy, field, demand_w(), 0.55, 0.55)
    _, run = seen_under(NONE, field)
    (again,) = drive(
        policy,
        field,
        demand_w(),
        0.55,
        0.55,
        interference=interference_of([NONE], STEPS, field.dt_s, [7]),
    )
    assert trajectory_hash(plain) == trajectory_hash(again)
    assert count_violations(run, field) == 0


def test_a_soc_sensor_lies_to_the_policy_only(field):
    seen, run = seen_under(Disturbance("bias", soc_bias=0.03), field)
    told = np.array([observation.soc[0] for observation in seen])
    np.testing.assert_allclose(told - run.soc, 0.03, atol=1e-6)
    assert count_violations(run, field) == 0


def test_noise_is_on_what_is_seen_not_on_what_is_driven(field):
    seen, run = seen_under(Disturbance("noise", noise_w=5e3, noise_s=3.0), field)
    told = np.array([observation.power_demand_w[0] for observation in seen])
    np.testing.assert_array_equal(run.power_demand_w, demand_w()[0])
    assert 1e3 < np.std(told - run.power_demand_w) < 15e3
    assert count_violations(run, field) == 0


def test_noise_has_the_declared_spread_and_colour():
    values = noise(
        Disturbance("n", noise_w=5e3, noise_s=3.0),
        200_000,
        1.0,
        np.random.Generator(np.random.PCG64(1)),
    )
    assert np.std(values) == pytest.approx(5e3, rel=0.03)
    correlation = np.corrcoef(values[:-1], values[1:])[0, 1]
    assert correlation == pytest.approx(np.exp(-1.0 / 3.0), abs=0.01)


@pytest.mark.parametrize("delay", [1, 3])
def test_a_command_arrives_so_many_steps_later(field, delay):
    _, run = seen_under(Disturbance("delay", delay_steps=delay), field, Counting)
    asked = run.command_battery_power_w
    np.testing.assert_array_equal(asked[:delay], 0.0)
    # The engine cannot carry all of the first step's demand; later watts are within every limit.
    np.testing.assert_allclose(asked[delay + 1 : delay + 5], np.arange(1.0, 5.0))
    assert count_violations(run, field) == 0


def test_a_wrong_end_counts_down_to_zero_and_stays_there(field):
    early, _ = seen_under(Disturbance("end", end_factor=0.75), field)
    left = np.array([observation.time_left_s[0] for observation in early])
    assert left[0] == 0.75 * STEPS and np.all(left[int(0.75 * STEPS) :] == 0.0)
    late, _ = seen_under(Disturbance("end", end_factor=1.25), field)
    assert late[-1].time_left_s[0] == 1.25 * STEPS - (STEPS - 1)


def test_a_plant_is_changed_in_what_is_named_only(field):
    plant = disturbed(field, Disturbance("p", fuel=1.05, capacity=0.8, resistance=2.0))
    power_w, on = np.array([0.0, 80e3, 275e3]), np.ones(3, dtype=bool)
    np.testing.assert_allclose(
        fuel_rate_kg_per_s(plant.engine, power_w, on),
        1.05 * fuel_rate_kg_per_s(field.engine, power_w, on),
    )
    assert plant.engine.start_fuel_kg == field.engine.start_fuel_kg
    assert plant.battery.energy_j == 0.8 * field.battery.energy_j
    assert plant.battery.resistance_ohm == 2.0 * field.battery.resistance_ohm
    assert disturbed(field, NONE) == field


@pytest.mark.parametrize(
    "wrong",
    [
        {"soc_bias": np.zeros(2)},
        {"delay_steps": np.array([-1])},
        {"end_factor": np.array([0.0])},
        {"demand_noise_w": np.full((1, STEPS), np.nan)},
    ],
)
def test_impossible_interference_is_refused(wrong):
    good = {
        "demand_noise_w": np.zeros((1, STEPS)),
        "soc_bias": np.zeros(1),
        "delay_steps": np.zeros(1, dtype=np.int64),
        "end_factor": np.ones(1),
    }
    with pytest.raises(ConfigError, match="interference"):
        Interference(**{**good, **wrong})
