"""Sampled learning over off and knots of engine power: targets, restraint, repeatability."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from tractor_ems.bags.transitions import Trace
from tractor_ems.drive import drive
from tractor_ems.learning.config import TrainConfig, load_train_config
from tractor_ems.learning.knot_learner import (
    VALUE_SCALE,
    KnotLearner,
    MeasuredCost,
    best_value,
    conservative_gap,
    margin_excess,
    n_step_returns,
)
from tractor_ems.learning.knot_samples import KnotSamples, features_of, running_baseline_kg
from tractor_ems.learning.knots_config import KnotsConfig
from tractor_ems.learning.recorded import drive_of_trajectory
from tractor_ems.learning.recordings import Recordings
from tractor_ems.learning.rewards import RewardConfig, resolve
from tractor_ems.learning.train import train_on
from tractor_ems.policies.knot_q import OFF, KnotQ
from tractor_ems.policies.made import load_made
from tractor_ems.policies.q_policy import Normalisation
from tractor_ems.policies.rules import Conventional
from tractor_msgs_py.errors import ConfigError
from tractor_msgs_py.observation import DemandFilter, ObservationSpec, filter_trace
from tractor_sim.config import load_powertrain
from tractor_sim.powertrain import PowertrainParams
from tractor_sim.powertrain_json import powertrain_hash

NAN = float("nan")


@pytest.fixture(scope="module")
def field() -> PowertrainParams:
    return load_powertrain("field")


def costs(after: list[int], step_kg: float = 0.001) -> MeasuredCost:
    """A recording whose SOC rises by a point a step from 0.5."""
    soc = 0.5 + 0.01 * np.arange(len(after))
    return MeasuredCost(
        np.full(len(after), step_kg), np.zeros(len(after)), soc, soc + 0.01, np.array(after)
    )


def rows(*values: list[float]) -> torch.Tensor:
    return torch.tensor(values)


def test_a_return_inside_a_run_sums_its_rewards_and_bootstraps_where_it_stops():
    config = KnotsConfig(n_step=3, gamma=0.5, wall_kg=0.0)
    found = n_step_returns(
        costs([6, 5, 4, 3, 2, 1]), config, 0.01, 1.0, np.array([1]), np.array([0.5]), np.array([5])
    )
    assert found.reward[0] == pytest.approx(-0.1 * (1 + 0.5 + 0.25))
    assert (found.discount[0], found.tick[0], found.left_s[0]) == (0.125, 4, 2.0)
    assert found.error[0] == pytest.approx(0.04)


@pytest.mark.parametrize("left", [1, 2, 3])
def test_a_return_that_meets_the_planned_end_stops_there_and_pays_for_the_soc_error(left: int):
    config = KnotsConfig(n_step=3, end_kg_per_soc2=16.0, wall_kg=0.0)
    found = n_step_returns(
        costs([4, 3, 2, 1]), config, 0.01, 1.0, np.array([0]), np.array([0.45]), np.array([left])
    )
    error = 0.05 + 0.01 * left
    assert found.reward[0] == pytest.approx(-(0.001 * left + 16.0 * error**2) / 0.01)
    assert found.discount[0] == 0.0


def test_the_start_of_the_first_step_is_not_in_the_return_but_later_ones_are():
    config = KnotsConfig(n_step=2, wall_kg=0.0)
    cost = replace(costs([4, 3, 2, 1], 0.0), start_kg=np.array([0.015, 0.015, 0.0, 0.0]))
    cost = replace(cost, step_kg=cost.start_kg)
    found = n_step_returns(cost, config, 0.01, 1.0, *np.array([[0], [0.5], [4]]).astype(int))
    assert found.reward[0] == pytest.approx(-1.5)


def test_a_return_never_reaches_beyond_its_recording():
    with pytest.raises(ConfigError, match="beyond its recording"):
        n_step_returns(
            costs([3, 2, 1]), KnotsConfig(n_step=3), 0.01, 1.0, *np.array([[0], [0], [9]])
        )


def test_the_bootstrap_ignores_infeasible_actions_and_is_judged_by_the_other_net():
    chooser, judge = rows([9.0, 1.0, 2.0]), rows([100.0, 5.0, 7.0])
    mask = torch.tensor([[False, True, True]])
    assert best_value(chooser, judge, mask).item() == 7.0
    assert best_value(rows([9.0, 2.0, 1.0]), judge, mask).item() == 5.0


def test_the_conservative_gap_is_log_sum_exp_over_feasible_actions_less_the_datas_q():
    q, mask = rows([1.0, 3.0, 50.0]), torch.tensor([[True, True, False]])
    gap = conservative_gap(q, mask, torch.tensor([0]), temperature=2.0)
    assert gap.item() == pytest.approx(2.0 * np.log(np.exp(0.5) + np.exp(1.5)) - 1.0, abs=1e-6)


def test_the_conservative_gap_pushes_infeasible_actions_nowhere():
    q = rows([1.0, 3.0, 50.0]).requires_grad_()
    conservative_gap(
        q, torch.tensor([[True, True, False]]), torch.tensor([0]), 1.0
    ).sum().backward()
    assert q.grad is not None
    share = 1.0 / (1.0 + np.exp(-2.0))
    assert q.grad[0].tolist() == pytest.approx([-share, share, 0.0], abs=1e-6)


def test_the_margin_grows_with_the_distance_of_knots_and_is_whole_between_off_and_running():
    q, mask = torch.zeros(1, 5), torch.ones(1, 5, dtype=torch.bool)
    only = [torch.tensor([[k in (1, n) for k in range(5)]]) for n in range(5)]
    expert = torch.tensor([1])
    found = [margin_excess(q, here, expert, 2.0).item() for here in only]
    assert found == [2.0, 0.0, 0.5, 1.0, 1.5]
    assert margin_excess(rows([0.0, 2.0, 0.0, 0.0, 0.0]), mask, expert, 2.0).item() == 0.0


def test_the_baseline_is_the_mean_measured_cost_at_each_demand():
    demand_w = np.repeat([0.0, 50e3, 100e3], 200)
    noise = np.tile([-1e-4, 1e-4], 300)
    cost_kg = 1e-3 + demand_w * 5e-8 + noise
    found = running_baseline_kg(
        demand_w, cost_kg, np.linspace(0.0, 100e3, 3), np.ones(600, dtype=bool)
    )
    assert found == pytest.approx(cost_kg - noise, abs=1e-7)


def test_features_of_many_runs_are_those_of_each():
    spec = ObservationSpec(
        dt_s=1.0, filters=(DemandFilter("low_pass", 8.0), DemandFilter("running_mean", 60.0, 5e4))
    )
    rng = np.random.Generator(np.random.PCG64(0))
    demands_w = [rng.uniform(0.0, 1e5, n) for n in (30, 20, 30)]
    for demand_w, found in zip(demands_w, features_of(spec, demands_w, 1.0), strict=True):
        assert found == pytest.approx(filter_trace(spec, demand_w, 1.0), abs=1e-6)


STEP = 0.01


def tiny_samples(count: int = 400) -> KnotSamples:
    """Demand says nothing; off lowers SOC by STEP and costs nothing, running raises it by STEP and
    costs 3 g. Which of the two was done was drawn by lot, whoever drove."""
    rng = np.random.Generator(np.random.PCG64(1))
    run = rng.random(count) < 0.5
    change = np.where(run, STEP, -STEP)
    soc = 0.5 + np.cumsum(change) - change
    return KnotSamples(
        demand=np.zeros((count, 1), np.float32),
        engine_on=np.ones(count, dtype=bool),
        soc=soc,
        soc_next=soc + change,
        soc_target=np.full(count, 0.5),
        action=np.where(run, 1, OFF),
        cost_kg=np.where(run, 0.003, 0.0),
        battery_w=np.zeros(count),
        power_demand_w=np.zeros(count),
        off=np.ones(count, dtype=bool),
        first=np.zeros(count, dtype=np.int64),
        last=np.zeros(count, dtype=np.int64),  # the second knot is never feasible
        after=count - np.arange(count),
        planned=np.ones(count, dtype=bool),
        expert=np.ones(count, dtype=bool),
    )


TINY = KnotsConfig(
    knots=2, updates=600, batch=128, demo_share=0.0, conservative=0.0, n_step=1, hidden=(32,),
    horizon_s=3.0, soc_width=0.2, wall_kg=0.0, end_kg_per_soc2=16.0, learning_rate=1e-2,
    target_rate=0.1,
)  # fmt: skip


def tiny_learner(field: PowertrainParams, config: KnotsConfig = TINY) -> KnotLearner:
    reward = resolve(RewardConfig(kp=0.0), field)
    rngs = [np.random.Generator(np.random.PCG64(seed)) for seed in (2, 3)]
    learner = KnotLearner(
        tiny_samples(), field, reward, Normalisation(0.0, 1e5, 0.02), config, *rngs
    )
    # Costs as made, without price and start: what is checked is the learning.
    free_kg = np.where(learner.samples.action == OFF, 0.0, 0.003)
    learner.cost = replace(learner.cost, step_kg=free_kg)
    return learner


def tiny_q(error: float, left: int) -> list[float]:
    """Q* of off and run by hand [units of 10 g]."""
    found = []
    for cost_kg, change in ((0.0, -STEP), (0.003, STEP)):
        then = error + change
        later = -1600.0 * then**2 if left == 1 else max(tiny_q(then, left - 1))
        found.append(-100.0 * cost_kg + later)
    return found


def test_a_tiny_chain_is_learned_offline_to_its_optimal_values(field: PowertrainParams):
    learner = tiny_learner(field)
    for _ in range(TINY.updates):
        learner.update()
    error = np.tile([-0.02, 0.0, 0.02], 3)
    left = np.repeat([1, 2, 3], 3)
    with torch.no_grad():
        found = learner.q(
            learner.online, learner.inputs(np.zeros(9, np.int64), error, left.astype(float))
        ).numpy()[:, :2]
    best = np.array([tiny_q(e, n) for e, n in zip(error.tolist(), left.tolist(), strict=True)])
    assert np.abs(found - best).max() < 0.3, np.round(found - best, 2)
    clear = np.abs(best[:, 0] - best[:, 1]) > 0.4
    assert clear.sum() >= 3
    assert np.array_equal(found.argmax(1)[clear], best.argmax(1)[clear])


def test_a_demonstration_cut_short_is_one_for_where_it_led(field: PowertrainParams):
    learner = tiny_learner(field, replace(TINY, demo_share=1.0, hindsight=1.0))
    tick, target, left, demos = learner.draw()
    assert demos == len(tick)
    assert np.all((left >= 1) & (left <= learner.samples.after[tick]))
    assert target == pytest.approx(learner.samples.soc_next[tick + left - 1])


def test_relabelled_ends_stay_within_what_a_return_can_see(field: PowertrainParams):
    learner = tiny_learner(field, replace(TINY, n_step=30, horizon_s=300.0))
    for _ in range(20):
        tick, target, left, _ = learner.draw()
        n_step_returns(learner.cost, learner.config, 0.01, 1.0, tick, target, left)


def test_the_folded_network_of_a_policy_says_what_value_and_advantages_say(field):
    learner = tiny_learner(field)
    inputs = learner.inputs(np.arange(5), np.zeros(5), np.ones(5))
    with torch.no_grad():
        outputs = learner.target(torch.from_numpy(inputs))
        whole = outputs[:, :-1] + VALUE_SCALE * outputs[:, -1:]
    from tractor_ems.policies.mlp import forward

    assert forward(learner.network(), inputs) == pytest.approx(whole.numpy(), abs=1e-4)


@pytest.fixture(scope="module")
def recordings(field: PowertrainParams) -> Recordings:
    """Ninety seconds of a load following engine, as a bag of DP's would give them."""
    demand_w = 6e4 + 4e4 * np.sin(np.arange(90) / 8.0)
    run = drive(Conventional(), field, demand_w[None, :], 0.55, 0.55)[0]
    driven = drive_of_trajectory(run, field, 0.55)
    trace = Trace(
        stamp_ns=run.stamp_ns, power_demand_w=demand_w, dt_s=1.0, p_aux_w=0.0, soc=driven.soc,
        battery_power_w=driven.battery_power_w, engine_power_w=driven.engine_power_w,
        engine_on=driven.engine_on, time_in_state_s=driven.time_in_state_s,
        fuel_kg=driven.fuel_kg, shortfall_j=run.shortfall_j, dissipated_j=run.dissipated_j,
        soc_target=0.55, from_start=True, to_end=True, irregular=0, refusals=0, run_id="r",
        cycle="short", cycle_hash="c", powertrain="field", powertrain_hash=powertrain_hash(field),
        policy="dp", bag="", bag_hash="b",
    )  # fmt: skip
    return Recordings(dp=(trace,), rule=())


@pytest.fixture(scope="module")
def config() -> TrainConfig:
    return load_train_config(
        "sampled_field", {"updates": 40, "knots.batch": 32, "knots.hidden": [16]}
    )


def test_same_seed_same_bytes_and_an_interrupted_run_resumes_to_them(
    field: PowertrainParams, recordings: Recordings, config: TrainConfig, tmp_path: Path
):
    def run(name: str, **given: object) -> Path:
        out = tmp_path / f"{name}.safetensors"
        train_on(given.pop("config", config), field, recordings, out, command_line="t", **given)
        return out

    whole, again = run("whole"), run("again")
    assert whole.read_bytes() == again.read_bytes()
    assert run("other", config=replace(config, seed=1)).read_bytes() != whole.read_bytes()
    seen: list[int] = []
    run("cut", stop=lambda: seen.append(1) or len(seen) == 15)
    assert run("cut", resume=True).read_bytes() == whole.read_bytes()
    policy = load_made(whole)
    assert isinstance(policy, KnotQ) and policy.name == "ddqn_sampled"
    assert policy.metadata["training"]["dp_transitions"] == 90
    assert policy.metadata["envelope"]["power_demand_w"][0] >= 2e4


def test_runs_without_states_or_with_simulated_episodes_are_refused(
    field: PowertrainParams, recordings: Recordings, config: TrainConfig, tmp_path: Path
):
    out = tmp_path / "x.safetensors"
    bare = replace(recordings.dp[0], soc=None, engine_on=None)
    with pytest.raises(ConfigError, match="no driven run"):
        train_on(config, field, Recordings((bare,), ()), out)
    with pytest.raises(ConfigError, match="interact: 2"):
        train_on(replace(config, interact=2), field, recordings, out)
    with pytest.raises(ConfigError, match="no recording of DP"):
        train_on(config, field, Recordings((), recordings.dp), out)
