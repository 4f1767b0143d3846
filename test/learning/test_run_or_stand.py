"""The learner of running and standing, and that what it learns drives as it was scored."""

from dataclasses import replace

import numpy as np
import pytest

from tractor_ems.drive import drive
from tractor_ems.learning.augment import augmented, squeezed
from tractor_ems.learning.config import (
    Augmentation,
    RunOrStandConfig,
    TrainConfig,
    load_train_config,
    preset_of,
)
from tractor_ems.learning.counterfactual import make_problem as make_counterfactual
from tractor_ems.learning.run_or_stand import MOST_STARTS, RunOrStandLearner, make_problem
from tractor_ems.learning.stretches import reserve
from tractor_ems.learning.train import train
from tractor_ems.policies.made import load_made
from tractor_ems.policies.one_step import hold, not_held
from tractor_ems.policies.q_policy import Normalisation
from tractor_ems.policies.run_or_stand import (
    SLOPE_STEP,
    RunOrStand,
    prices_of,
    stiffness_kg,
    time_inputs,
)
from tractor_ems.policies.run_or_stand_file import save_run_or_stand
from tractor_ems.tuning import closed_loop
from tractor_msgs_py.errors import ConfigError, PolicyError
from tractor_msgs_py.observation import (
    DemandFilter,
    Observation,
    ObservationSpec,
    filter_trace,
)
from tractor_sim.batch import batch_plant
from tractor_sim.config import load_powertrain

FIELD = load_powertrain("field")
BATTERY_W = FIELD.battery.power_max_w
SPEC = ObservationSpec(dt_s=1.0, filters=(DemandFilter("low_pass", 8.0),))
SCALING = Normalisation(80e3, 50e3, soc_scale=0.1)
SMALL = RunOrStandConfig(
    updates=40, batch=16, errors=2, commit_s=6.0, soc_scale=0.1, hidden=(16, 16)
)
UNPLANNED = replace(SMALL, planned=False, holding_kg_per_s=0.008, gamma=0.998)
PLANS = pytest.mark.parametrize("config", [SMALL, UNPLANNED], ids=["planned", "unplanned"])


def work(steps):
    """Two minutes of light work and one of passes, in turn."""
    k = np.arange(steps)
    return np.where(k % 180 < 120, 25e3, 130e3) + 5e3 * np.sin(k / 7.0)


def inputs_of(demand_w):
    signals = np.column_stack((demand_w, filter_trace(SPEC, demand_w, 1.0)))
    return ((signals - SCALING.demand_offset_w) / SCALING.demand_scale_w).astype(np.float32)


def learner(config=SMALL, seed=0):
    demand_w = work(900)
    problem = make_problem(FIELD, config, [demand_w], inputs_of(demand_w), 1)
    rngs = (np.random.Generator(np.random.PCG64(seed + n)) for n in (0, 100))
    return RunOrStandLearner(problem, config, *rngs)


def policy_of(made, *others):
    config = made.config
    return RunOrStand(
        FIELD, SPEC, tuple(m.network() for m in (made, *others)), SCALING, made.problem.prices,
        horizon_s=config.horizon_s if config.planned else 0.0,
    )  # fmt: skip


def known_only(made):
    """Networks that say nothing: what is left of V is its known part."""
    for net in (made.online, made.target):
        net.weights[-1].data.zero_()
        net.biases[-1].data.zero_()
    return made


@pytest.mark.slow
@PLANS
def test_the_policy_drives_as_the_compiled_loop_does(config):
    made, other = learner(config), learner(config, 1)
    for _ in range(40):
        made.update()
        other.update()
    p, demand_w = made.problem, work(600)
    policy = policy_of(made, other)
    run = drive(policy, FIELD, demand_w[None, :], 0.55, 0.55)[0]
    inputs, left_s = inputs_of(demand_w), 600.0 - np.arange(600)
    at = inputs.shape[1]
    inputs = np.concatenate((inputs, np.zeros((600, 2))), axis=1)
    if config.planned:
        inputs = np.concatenate((inputs, time_inputs(left_s, config.horizon_s)), axis=1)
    totals = np.zeros(9)
    layers = [(net.weights[k], net.biases[k]) for k in range(3) for net in policy.nets]
    stacked = [
        np.stack([layers[2 * k + n][part].astype(float) for n in range(2)])
        for k in range(3)
        for part in range(2)
    ]
    closed_loop.drive_choice(
        *batch_plant(FIELD), p.cell, p.fuel_kg, p.engine_max_w, demand_w, inputs.astype(float),
        at, stiffness_kg(p.prices, left_s), 0.55, 0.55, p.prices.soc_kg, p.prices.start_kg,
        p.prices.unit_kg, config.soc_scale if config.planned else 0.1, SLOPE_STEP, *stacked,
        totals, np.zeros((0, 3)),
    )  # fmt: skip
    assert totals[closed_loop.FUEL] == pytest.approx(run.fuel_kg.sum(), rel=2e-4)
    assert totals[closed_loop.SOC_FINAL] == pytest.approx(run.soc_final, abs=2e-4)


def test_equal_seeds_learn_equal_weights_and_others_do_not():
    first, again, other = learner(seed=1), learner(seed=1), learner(seed=2)
    for made in (first, again, other):
        for _ in range(5):
            made.update()
    a, b, c = (np.concatenate([w.ravel() for w in m.network().weights]) for m in
               (first, again, other))  # fmt: skip
    assert np.array_equal(a, b)
    assert not np.array_equal(a, c)


@PLANS
def test_standing_saves_the_fuel_of_idling_and_costs_no_start_while_it_lasts(config):
    """With equal values afterwards, 25 kW carried by the battery at the price of running is
    cheaper than running by about the idling fuel of the stretch."""
    made = known_only(learner(replace(config, price=1.0, end_kg=0.0)))
    ticks = np.arange(20, 60)
    _, gain = made.backup(ticks, np.full(40, 1000), np.zeros((40, 1)))
    idling_kg = made.problem.commit * FIELD.engine.idle_fuel_kg_per_s
    assert np.median(gain) * made.problem.prices.unit_kg == pytest.approx(idling_kg, rel=0.1)


def test_where_starts_are_free_there_is_still_a_choice_to_learn():
    free = load_powertrain("field:engine.start_fuel_kg=0")
    demand_w = work(900)
    problem = make_problem(free, SMALL, [demand_w], inputs_of(demand_w), 1)
    rngs = (np.random.Generator(np.random.PCG64(n)) for n in (0, 100))
    made = known_only(RunOrStandLearner(problem, SMALL, *rngs))
    _, gain = made.backup(np.arange(20, 60), np.full(40, 1000), np.zeros((40, 1)))
    assert gain.any()


def test_steps_that_are_not_seconds_are_refused():
    """The reserve in training counts seconds."""
    with pytest.raises(ConfigError, match=r"dt_s: 0\.1 with targets run_or_stand, allowed 1"):
        make_problem(load_powertrain("field:dt_s=0.1"), SMALL, [work(900)], None, 1)


def test_targets_alone_name_their_preset():
    assert load_train_config(preset_of("run_or_stand")) == load_train_config("field")
    assert (preset_of("sampled"), preset_of(None), preset_of("")) == ("sampled", None, None)


def test_what_the_battery_cannot_carry_alone_is_no_choice():
    made = learner()
    made.problem.must_start[:] = True
    _, gain = made.backup(np.arange(20, 30), np.full(10, 1000), np.zeros((10, 1)))
    prices = made.problem.prices
    assert np.all(gain == -MOST_STARTS * prices.start_kg / prices.unit_kg)


def test_the_reserve_in_training_is_the_one_that_drives():
    """A running engine is forced or held at the same ticks, from the same memory."""
    demand_w = np.concatenate((work(900), np.full(120, 100e3), work(300)))
    found = reserve(demand_w, BATTERY_W, 60e3, slow=True)
    state = not_held(1)
    observed = Observation(
        0, *np.full((3, 1), 0.55), np.ones(1, dtype=bool), np.full(1, 1e3), np.full(1, 50e3),
        *np.full((3, 1), BATTERY_W), np.zeros((1, 0)),
    )  # fmt: skip
    for t, power_w in enumerate(demand_w):
        must, state = hold(FIELD, replace(observed, power_demand_w=np.full(1, power_w)), state)
        assert (must[0], state.since_s[0]) == (found.must_run[t], found.since_s[t])
        assert state.peak_w[0] == pytest.approx(found.peak_w[t])
    assert 0 < found.must_start.sum() < found.must_run.sum() < len(demand_w)


def test_a_stretch_that_reaches_the_end_pays_for_the_soc_it_ends_at():
    """Two steps before the end the cost of being 10 points off is the terminal one, and what
    the network says of later is not asked."""
    made = learner(replace(SMALL, end_kg=30.0))
    ticks, left = np.full(1, 20), np.full(1, 2)
    value, _ = made.backup(ticks, left, np.array([[-0.1, 0.0, 0.1]]))
    unit_kg, soc_kg = made.problem.prices.unit_kg, made.problem.prices.soc_kg
    off_kg = (value[0, [0, 2]] - value[0, 1]) * unit_kg
    assert off_kg == pytest.approx(0.3, abs=0.002 * soc_kg)
    made.target.biases[-1].data.fill_(1e3)
    again, _ = made.backup(ticks, left, np.array([[-0.1, 0.0, 0.1]]))
    assert again - again[0, 1] == pytest.approx(value - value[0, 1], abs=1e-2)


def test_without_a_plan_time_left_changes_nothing():
    policy = policy_of(learner(UNPLANNED))
    a, b = (drive(policy, FIELD, work(n)[None, :], 0.55, 0.55)[0] for n in (60, 90))
    assert np.array_equal(a.engine_power_w, b.engine_power_w[:60])
    assert policy.name == "ddqn_unplanned"
    assert policy_of(learner()).name == "ddqn_counterfactual"


def test_an_error_is_dearer_the_less_time_is_left_to_close_it():
    prices = prices_of(FIELD, 1.02, 20.0)
    stiff = stiffness_kg(prices, np.array([0.0, 60.0, 600.0, 3600.0]))
    assert stiff[0] == 20.0
    assert np.all(np.diff(stiff) < 0)
    assert stiff[-1] == pytest.approx(prices.ease_kg_s / 3600.0, rel=0.02)
    assert prices.soc_kg == pytest.approx(8.0, rel=0.05)  # 197 g/kWh over 40 kWh


def test_no_planned_end_looks_like_the_farthest_one():
    far = time_inputs(np.array([np.inf, 2400.0, 9e9]), 2400.0)
    assert np.all(far == far[0])


def test_a_file_gives_the_policy_back_and_refuses_what_does_not_fit(tmp_path):
    for config in (SMALL, UNPLANNED):
        policy, path = policy_of(learner(config)), tmp_path / "p.safetensors"
        save_run_or_stand(path, policy)
        again = load_made(path)
        assert (again.name, again.prices, again.spec) == (policy.name, policy.prices, SPEC)
        assert again.nets[0].weights[0].tobytes() == policy.nets[0].weights[0].tobytes()
        save_run_or_stand(tmp_path / "q.safetensors", replace(again, metadata={}))
        assert (tmp_path / "q.safetensors").read_bytes() == path.read_bytes()
    with pytest.raises(PolicyError, match="network maps 6 inputs to 2 outputs"):
        replace(policy, horizon_s=2400.0)


def test_squeezed_work_has_shorter_strokes_of_its_own_power():
    demand_w = work(900)
    short = squeezed(demand_w, 0.5, 0.8, 4e3)
    assert len(short) == 900
    crossings = [np.sum(np.diff((d > 60e3).astype(int)) != 0) for d in (demand_w, short)]
    assert crossings[1] >= 1.8 * crossings[0]
    assert short.max() - 4e3 == pytest.approx(0.8 * (demand_w.max() - 4e3), rel=0.02)


def test_demand_is_made_in_proportion_and_only_by_the_generator():
    given = [work(300), work(400)]
    config = Augmentation(scaled=100, squeezed=50)
    made, again = (
        augmented(given, config, 4e3, np.random.Generator(np.random.PCG64(3))) for _ in range(2)
    )
    assert len(made) == 3
    assert all(np.array_equal(a, b) for a, b in zip(made, again, strict=True))
    assert augmented(given, Augmentation(scaled=0, squeezed=0), 4e3, None) == []


TRAINING = load_train_config(
    "field",
    {
        "powertrain": "paper",
        "updates": 24,
        "run_or_stand.batch": 8,
        "run_or_stand.table_updates": 0,
        "run_or_stand.hidden": [8, 8],
        "checkpoint_every": 10,
    },
)


def test_training_from_bags_is_repeatable_and_resumable_to_the_byte(bags, tmp_path):
    whole, broken = tmp_path / "whole.safetensors", tmp_path / "broken.safetensors"

    def run(out, **options):
        return train(TRAINING, [bags / "best"], [bags / "rule"], out, command_line="x", **options)

    report = run(whole)
    asked = iter(range(1, 100))
    assert run(broken, stop=lambda: next(asked) == 13).policy is None
    run(broken, resume=True)
    assert broken.read_bytes() == whole.read_bytes()
    policy = load_made(whole)
    assert policy.name == "ddqn_counterfactual"
    assert policy.metadata["bag_hashes"] == report.bags
    assert policy.metadata["config"]["run_or_stand"]["planned"] is True
    assert policy.metadata["envelope"]["power_demand_w"][1] > 0.0
    prior_w = policy.spec.filters[0].prior_w
    assert prior_w == pytest.approx(policy.scaling.demand_offset_w)


def test_learning_every_battery_power_says_which_preset_knows_slow_engines():
    with pytest.raises(ConfigError, match="preset field"):
        make_counterfactual(FIELD, None, SCALING, TrainConfig().counterfactual, None, 100)
