"""Replay: a FIFO, seeded from bags with distinct transitions in the promised shares."""

from dataclasses import replace

import numpy as np
import pytest

from tractor_ems.learning.config import load_train_config
from tractor_ems.learning.experiment import SampledRun, make_generators, prepare, seed_transitions
from tractor_ems.learning.recorded import drive_of_trace, replay_transitions
from tractor_ems.learning.recordings import Recordings
from tractor_ems.learning.replay import (
    Replay,
    Transitions,
    columns,
    concatenate,
    distinct_rows,
    draw_seeds,
)
from tractor_ems.policies.q_policy import state_inputs
from tractor_ems.policies.rules import BestPoint, Conventional, RuleBased
from tractor_msgs_py.errors import ConfigError
from tractor_msgs_py.observation import filter_trace
from tractor_sim.powertrain import battery_power_grid_w


def numbered(count: int, begin: int = 0) -> Transitions:
    number = np.arange(begin, begin + count)
    return Transitions(
        inputs=np.repeat(number[:, None], 2, axis=1).astype(np.float32),
        action=number.astype(np.int64),
        reward=number.astype(np.float32),
        discount=np.full(count, 0.9, np.float32),
        next_inputs=np.zeros((count, 2), np.float32),
        first=np.zeros(count, np.int16),
        last=np.full(count, 5, np.int16),
        next_first=np.zeros(count, np.int16),
        next_last=np.full(count, 5, np.int16),
    )


def test_the_oldest_transitions_are_overwritten_first():
    replay = Replay(10, 2)
    for begin in range(0, 21, 3):
        replay.add(numbered(3, begin))
    assert len(replay) == 10
    assert sorted(replay.columns["action"]) == list(range(11, 21))


def test_more_than_the_capacity_at_once_keeps_the_last():
    replay = Replay(10, 2)
    replay.add(numbered(4))
    replay.add(numbered(25, 4))
    assert sorted(replay.columns["action"]) == list(range(19, 29))


def test_an_empty_replay_says_what_it_needs():
    with pytest.raises(ConfigError, match="replay: empty"):
        Replay(10, 2).sample(np.random.default_rng(0), 4)


def test_samples_keep_their_columns_together():
    replay = Replay(50, 2)
    replay.add(numbered(30))
    batch = replay.sample(np.random.default_rng(0), 200)
    assert set(batch.action) == set(range(30))
    assert np.array_equal(batch.action, batch.reward.astype(int))
    assert np.array_equal(batch.action, batch.inputs[:, 1].astype(int))


def test_seeds_are_distinct_even_where_a_run_was_recorded_twice():
    twice = concatenate([numbered(40), numbered(40), numbered(10, 100)], 2)
    assert len(distinct_rows(twice)) == 50
    seeds, report = draw_seeds(twice, 0.5, 200, np.random.default_rng(0))
    assert sorted(seeds.action) == [*range(40), *range(100, 110)]
    assert (report.wanted, report.available, report.distinct, report.seeded) == (100, 90, 50, 50)
    assert report.share == 0.25


def test_seeds_are_drawn_without_replacement_and_shuffled():
    seeds, report = draw_seeds(numbered(1000), 0.25, 400, np.random.default_rng(0))
    assert report.seeded == len(set(seeds.action)) == 100
    assert not np.array_equal(seeds.action, np.sort(seeds.action))


def test_66_runs_seed_exactly_50_000_distinct_transitions_of_several_cycles(paper, make_traces):
    config = load_train_config("sampled")
    traces = make_traces(list(range(10, 76)))
    recordings = Recordings(dp=tuple(traces), rule=())
    generators = make_generators(0)
    experiment = prepare(config, paper, recordings, generators.episodes)
    run = SampledRun(experiment, generators)
    replay = run.learner.replay
    assert run.summary["seeding"]["dp"] == {
        "wanted": 50_000,
        "available": 66 * 765,
        "distinct": 66 * 765,
        "seeded": 50_000,
        "share": 0.25,
    }
    assert replay.capacity == 200_000 and len(replay) == 50_000
    stored = Transitions(**{name: column[:50_000] for name, column in replay.columns.items()})
    assert len(distinct_rows(stored)) == 50_000


def test_rule_based_runs_fill_their_own_share_and_count_once(paper, make_traces):
    config = load_train_config("sampled", {"sampled.replay_capacity": 4000})
    config = replace(config, sampled=replace(config.sampled, rule_share=0.25))
    dp = make_traces([11, 12], BestPoint(paper))
    rule = [*make_traces([11, 12], name="rule_based"), *make_traces([11], BestPoint(paper), "x")]
    recordings = Recordings(dp=tuple(dp), rule=tuple(rule))
    generators = make_generators(0)
    experiment = prepare(config, paper, recordings, generators.episodes)
    seeds, report = seed_transitions(experiment, generators.seeding)
    assert report["dp"].seeded == report["rule"].seeded == 1000
    assert len(distinct_rows(seeds)) == len(seeds) == 2000


def test_transitions_replay_what_was_applied(paper, make_traces):
    """Actions give back the applied power, inputs are what a live policy would have seen."""
    trace = make_traces([14], RuleBased(paper))[0]
    generators = make_generators(0)
    recordings = Recordings(dp=(trace,), rule=())
    experiment = prepare(load_train_config("sampled"), paper, recordings, generators.episodes)
    driven = drive_of_trace(trace)
    assert driven is not None
    rows = replay_transitions(
        driven, paper, experiment.reward, experiment.spec, experiment.scaling, 0.9, 1600
    )
    assert len(rows) == len(trace) - 1
    spacing = np.diff(battery_power_grid_w(paper))[0]
    off = ~driven.engine_on[1:-1]
    meant = battery_power_grid_w(paper)[rows.action]
    error = np.abs(meant - driven.battery_power_w[:-1])
    assert np.all(error[~off] <= 0.5 * spacing + 1e-6)
    assert off.any() and np.all(error[off] <= spacing)
    features = filter_trace(experiment.spec, trace.power_demand_w, 1.0)
    demand = np.concatenate((trace.power_demand_w[:, None], features), axis=1)
    scaling = experiment.scaling
    scaled = (demand - scaling.demand_offset_w) / scaling.demand_scale_w
    error_in = ((driven.soc[:-1] - 0.836) / scaling.soc_scale).astype(np.float32)
    inputs = state_inputs(scaling, scaled.astype(np.float32), error_in, driven.engine_on[:-1])
    assert np.allclose(rows.inputs, inputs[:-1], atol=1e-6)
    assert np.array_equal(rows.next_inputs[:-1], rows.inputs[1:])
    assert np.all(rows.discount == np.float32(0.9)), "the end of a cycle is no terminal state"


def test_conventional_runs_are_grid_point_zero_within_half_a_step(paper, make_traces):
    driven = drive_of_trace(make_traces([15], Conventional())[0])
    generators = make_generators(0)
    recordings = Recordings(dp=tuple(make_traces([15])), rule=())
    experiment = prepare(load_train_config("sampled"), paper, recordings, generators.episodes)
    assert driven is not None
    rows = replay_transitions(
        driven, paper, experiment.reward, experiment.spec, experiment.scaling, 0.9, 1600
    )
    assert set(rows.action) <= {799, 800}
    assert {len(column) for column in columns(rows).values()} == {765}
