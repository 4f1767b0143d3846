"""The environment keeps Gymnasium's contract, its mask is true, its reward counts fuel."""

import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from hypothesis import given, settings
from hypothesis import strategies as st

import tractor_sim.gym
from tractor_msgs_py.errors import ConfigError, CycleError
from tractor_sim.config import load_powertrain
from tractor_sim.duty_cycle.library import cycle_names, load_cycle
from tractor_sim.gym import SeriesHybridEnv, SeriesHybridVectorEnv, Settings
from tractor_sim.gym.actions import action_mask, command_of, make_actions
from tractor_sim.gym.observation import ELEMENTS
from tractor_sim.gym.settings import best_specific_fuel_kg_per_j, episode_names
from tractor_sim.powertrain import initial_state, power_limits, step

FIELD = load_powertrain("field")
PARAMS = [FIELD, *map(load_powertrain, ["paper", "utility_150kw"])]
ENV_ID = tractor_sim.gym.ENV_ID


def make(**kwargs) -> SeriesHybridEnv:
    return SeriesHybridEnv(**{"cycles": "planter", **kwargs})


@pytest.mark.parametrize(
    "kwargs", [{}, {"powertrain": "paper", "actions": "battery", "soc_initial": (0.75, 0.9)}]
)
def test_the_checker_of_gymnasium_has_no_complaint(kwargs):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env = gymnasium.make(ENV_ID, cycles=["planter", "planter_1"], **kwargs)
        check_env(env.unwrapped)


def masked_drive(env: SeriesHybridEnv, seed: int, steps: int) -> list[tuple]:
    """Steps by actions drawn from the mask: what was seen before, action, reward, and after."""
    rng, rows = np.random.default_rng(seed), []
    seen, info = env.reset(seed=seed)
    for _ in range(steps):
        action = int(rng.choice(np.flatnonzero(info["action_mask"])))
        after, reward, terminated, truncated, told = env.step(action)
        assert not terminated
        rows.append((seen, info, action, reward, told))
        if truncated:
            break
        seen, info = after, told
    return rows


@pytest.mark.parametrize("actions", ["engine", "battery"])
@pytest.mark.parametrize("powertrain", ["field", "paper", "wheel_loader"])
def test_observations_stay_in_their_box_and_no_masked_action_is_called_infeasible(
    powertrain, actions
):
    env = make(powertrain=powertrain, actions=actions)
    for seen, info, _, _, told in masked_drive(env, 4, 120):
        assert env.observation_space.contains(seen)
        assert info["action_mask"].dtype == np.int8
        assert not told["infeasible"]


@pytest.mark.parametrize("powertrain", ["field", "paper"])
def test_masked_off_is_off_unless_the_engine_must_run_and_every_other_action_runs(powertrain):
    names = [name for name, _, _ in ELEMENTS]
    params, rows = load_powertrain(powertrain), masked_drive(make(powertrain=powertrain), 11, 200)
    for seen, _, action, _, told in rows:
        now = dict(zip(names, seen, strict=True))
        short = told["demand_w"] > now["discharge_limit"] * params.battery.power_max_w
        must_run = now["engine_limit"] > 0.0 and (short or now["may_be_off"] == 0.0)
        assert (told["fuel_kg"] > 0.0) == (action > 0 or must_run)
    assert {action == 0 for _, _, action, _, _ in rows} == {True, False}


@settings(max_examples=150, deadline=None)
@given(seed=st.integers(0, 2**31), kind=st.sampled_from(["engine", "battery"]))
def test_masked_actions_all_differ_and_whatever_the_others_do_one_of_them_does(seed, kind):
    rng = np.random.default_rng(seed)
    params = PARAMS[rng.integers(len(PARAMS))]
    actions = make_actions(Settings(actions=kind, action_count=40), params)
    soc = rng.uniform(params.battery.soc_min, params.battery.soc_max)
    state = initial_state(params, soc, 40)
    state.engine_on[:], state.time_in_state_s[:] = rng.random() < 0.5, rng.integers(1, 9)
    state.engine_power_w[:] = rng.uniform(0.0, actions.power_w[-1]) * state.engine_on
    demand_w = np.full(40, rng.uniform(-100e3, 400e3))

    mask = action_mask(actions, power_limits(params, state), demand_w)[0] == 1
    _, result = step(params, state, demand_w, command_of(actions, np.arange(40), demand_w))
    effect = list(zip(result.engine_power_w.round(3), result.fuel_kg > 0.0, strict=True))
    inside = [one for one, masked in zip(effect, mask, strict=True) if masked]
    assert inside
    assert len(set(inside)) == len(inside)
    assert set(effect) == set(inside)


def test_reward_is_fuel_and_what_the_battery_gave_at_the_price_of_the_potential():
    env = make(soc_initial=0.6, soc_target=0.55, soc_slope=2.0, start_price_kg=0.01)
    rows = masked_drive(env, 3, 2000)
    told = rows[-1][-1]
    start, end = 0.6 - 0.55, told["soc"] - 0.55
    price_kg = best_specific_fuel_kg_per_j(FIELD) * FIELD.battery.energy_j
    gave_kg = price_kg * ((start - start**2) - (end - end**2))  # kp / 2 = 1
    cost_kg = told["episode_fuel_kg"] + 0.01 * told["episode_starts"] + gave_kg
    cost_kg += 10.0 * best_specific_fuel_kg_per_j(FIELD) * told["episode_shortfall_j"]
    assert sum(reward for _, _, _, reward, _ in rows) * -0.010 == pytest.approx(cost_kg, rel=1e-9)
    assert told["episode_starts"] > 0


def test_an_episode_is_its_cycle_with_the_auxiliaries_and_ends_as_a_truncation():
    env, cycle = make(), load_cycle("planter")
    rows = masked_drive(env, 5, 10_000)
    assert len(rows) == len(cycle)
    driven_w = [told["demand_w"] for *_, told in rows]
    np.testing.assert_array_equal(driven_w, cycle.power_demand_w + FIELD.p_aux_w)


def test_undelivered_work_is_told_and_costs_more_than_delivering_it():
    env = make(powertrain="utility_150kw")  # too small for this work
    _, info = env.reset(seed=0)
    rewards, shortfalls = [], []
    for _ in range(400):
        _, reward, _, _, info = env.step(env.action_space.n - 1)
        rewards.append(reward)
        shortfalls.append(info["shortfall_j"])
    short = np.array(shortfalls) > 0.0
    assert short.any() and info["episode_shortfall_j"] == pytest.approx(sum(shortfalls))
    assert np.mean(np.array(rewards)[short]) < np.mean(np.array(rewards)[~short])


def test_a_seed_gives_the_same_episodes_and_another_gives_others():
    def episodes(seed: int) -> list[tuple[str, float]]:
        env = SeriesHybridEnv(soc_initial=(0.4, 0.7))
        return [
            (info["cycle"], info["soc"])
            for _, info in (env.reset(seed=seed if k == 0 else None) for k in range(4))
        ]

    assert episodes(1) == episodes(1)
    assert episodes(1) != episodes(2)
    assert len(set(episodes(1))) > 1


def test_training_cycles_are_the_default_and_held_out_ones_are_never_among_them():
    drawn = set()
    env = SeriesHybridEnv()
    for k in range(30):
        drawn.add(env.reset(seed=k)[1]["cycle"])
    assert drawn <= set(cycle_names("train"))
    names = {name for names in episode_names(Settings()).values() for name in names}
    assert names == set(cycle_names("train"))


def test_operations_draw_seeds_that_are_not_listed():
    env = SeriesHybridEnv(operations="planter")
    names = {env.reset(seed=k)[1]["cycle"] for k in range(5)}
    assert len(names) > 1 and not names & set(cycle_names())
    again = SeriesHybridEnv(operations=["planter"])
    assert {again.reset(seed=k)[1]["cycle"] for k in range(5)} == names


def test_options_of_reset_choose_cycle_and_soc():
    _, info = make().reset(seed=1, options={"cycle": "planter_3", "soc_initial": 0.7})
    assert (info["cycle"], info["soc"]) == ("planter_3", 0.7)
    with pytest.raises(ConfigError, match="'speed', allowed cycle, soc_initial"):
        make().reset(options={"speed": 3})
    with pytest.raises(ConfigError, match=r"soc_initial 0\.9, allowed 0\.3\.\.0\.8"):
        make().reset(options={"soc_initial": 0.9})


@pytest.mark.parametrize(
    ("kwargs", "says"),
    [
        ({"colour": 1}, "no setting 'colour', allowed powertrain"),
        ({"powertrain": "tank"}, "'tank': unknown"),
        ({"powertrain": 3}, "powertrain 3, allowed a name"),
        ({"cycles": []}, "cycles"),
        ({"cycles": "planter_x"}, "planter_x"),
        ({"cycles": "planter", "operations": "planter"}, "allowed one of them"),
        ({"cycles": None, "operations": "sailing"}, "'sailing', allowed planter"),
        ({"cycles": None, "operations": "baler"}, "'baler' is held out"),
        ({"actions": "pedal"}, "'pedal', allowed engine, battery"),
        ({"action_count": 1}, r"action_count 1, allowed 2\.\.10000"),
        ({"soc_initial": 0.1}, r"soc_initial 0\.1, allowed 0\.3\.\.0\.8"),
        ({"soc_initial": (0.7, 0.4)}, "soc_initial"),
        ({"soc_initial": "full"}, "soc_initial"),
        ({"soc_target": float("nan")}, "soc_target nan"),
        ({"equivalence_kg_per_j": 0.0}, "0 < value <= 1e-06"),
        ({"soc_slope": float("nan")}, "soc_slope nan"),
        ({"reward_unit_kg": True}, "reward_unit_kg True"),
    ],
)
def test_a_wrong_setting_is_named_with_what_is_allowed(kwargs, says):
    with pytest.raises((ConfigError, CycleError), match=says):
        make(**kwargs)


def test_a_cycle_of_another_step_length_is_refused():
    env = make(powertrain="field:dt_s=0.5")
    with pytest.raises(ConfigError, match=r"planter has dt_s 1\.0"):
        env.reset(seed=1)


def test_an_action_that_is_none_is_refused():
    env = make()
    env.reset(seed=1)
    with pytest.raises(ValueError, match="allowed Discrete"):
        env.step(21)


@pytest.mark.parametrize(("actions", "steps", "ends"), [("engine", 775, 2), ("battery", 40, 0)])
def test_the_vector_environment_is_as_many_single_ones(actions, steps, ends):
    kwargs = {
        "cycles": ["planter_1", "planter_2", "planter_3"],
        "soc_initial": (0.4, 0.7),
        "actions": actions,
        "action_count": 15,
    }
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        many = gymnasium.make_vec(
            ENV_ID, num_envs=2, vectorization_mode="vector_entry_point", **kwargs
        )
        singles = gymnasium.make_vec(ENV_ID, num_envs=2, vectorization_mode="sync", **kwargs)
        assert many.single_action_space == singles.single_action_space
        assert many.single_observation_space == singles.single_observation_space
        assert many.metadata["autoreset_mode"] == singles.metadata["autoreset_mode"]
        rng = np.random.default_rng(1)
        pairs = zip(many.reset(seed=7), singles.reset(seed=7), strict=True)
        ended = 0
        for _ in range(steps):  # 775: beyond an end of 766 steps and the reset after it
            for one, other in pairs:
                assert_same(one, other)
            action = rng.integers(0, 15, 2)
            left, right = many.step(action), singles.step(action)
            pairs = zip(left, right, strict=True)
            ended += int(left[3].sum())
        assert ended == ends


def assert_same(one: object, other: object) -> None:
    if isinstance(one, dict):
        assert one.keys() == other.keys()
        for key in one:
            np.testing.assert_array_equal(one[key], other[key], err_msg=key)
    else:
        np.testing.assert_array_equal(one, other)


def test_the_vector_environment_refuses_wrong_counts():
    for kwargs in ({"num_envs": 0}, {"num_envs": True}, {"threads": 0}):
        with pytest.raises(ConfigError, match="allowed 1"):
            SeriesHybridVectorEnv(cycles="planter", **kwargs)
    many = SeriesHybridVectorEnv(2, cycles="planter")
    many.reset(seed=1)
    with pytest.raises(ValueError, match="allowed MultiDiscrete"):
        many.step(np.array([0, 21]))
