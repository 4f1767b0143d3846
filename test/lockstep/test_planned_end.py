"""The planned end: counted in stamps from when it is set, engaged or a run begins."""

import math
from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from tractor_ems.answer import Answerer
from tractor_ems.decide import DecideConfig, Decider
from tractor_ems.drive_report import values_of, warns
from tractor_ems.latency import Latencies
from tractor_ems.planned_end import HOLD_S, counted, paused, planned
from tractor_ems.policies.protocol import ANY_RUN
from tractor_msgs_py.observation import Observation, ObservationSpec
from tractor_sim.powertrain import Command

SECOND_NS = 1_000_000_000


@dataclass(frozen=True)
class Listening:
    """Notes the time left that it is told."""

    name: str = "listening"
    spec: ObservationSpec = ANY_RUN
    heard_s: list[float] = field(default_factory=list)

    def init(self, batch):
        return None

    def act(self, observation, state):
        self.heard_s.append(float(observation.time_left_s[0]))
        return Command(np.zeros(1), np.full(1, math.nan)), state


def seen(second):
    """An observation a number of seconds after the first, with no end of its own."""
    one = np.ones(1)
    return Observation(
        stamp_ns=SECOND_NS + round(second * SECOND_NS),
        power_demand_w=1e5 * one,
        soc=0.5 * one,
        soc_target=0.5 * one,
        engine_on=np.array([True]),
        time_in_state_s=9 * one,
        engine_power_w=1e5 * one,
        charge_limit_w=1e5 * one,
        discharge_limit_w=1e5 * one,
        engine_limit_w=2e5 * one,
        features=np.zeros((1, 0)),
    )


def decider(shadow=False, work_s=600.0):
    policy = Listening()
    made = Decider(policy, DecideConfig(shadow=shadow))
    made.plan_work(work_s)
    made.rehearse()
    made.start(1.0, supervised=True)
    policy.heard_s.clear()
    return made, policy.heard_s


def test_time_left_counts_down_from_the_first_observation():
    made, heard_s = decider()
    for second in (0, 1, 2, 10):
        made.decide(seen(second), second)
    assert heard_s == [600.0, 599.0, 598.0, 590.0]


def test_without_a_plan_the_observation_says_what_the_run_said():
    made, heard_s = decider(work_s=0.0)
    made.decide(seen(0), 0.0)
    made.decide(replace(seen(1), time_left_s=np.array([42.0])), 1.0)
    assert heard_s == [math.inf, 42.0]


def test_after_the_planned_end_the_policy_goes_on_as_shortly_before_one_for_ever():
    made, heard_s = decider(work_s=3.0)
    for second in range(8):
        made.decide(seen(second), second)
    assert heard_s == [3.0, 2.0, 1.0, *[HOLD_S] * 5]
    assert made.plan.passed


def test_set_while_it_drives_it_counts_from_then():
    made, heard_s = decider(work_s=0.0)
    made.decide(seen(0), 0.0)
    made.plan_work(100.0)
    made.decide(seen(5), 5.0)
    made.decide(seen(6), 6.0)
    made.plan_work(0.0)
    made.decide(seen(7), 7.0)
    assert heard_s == [math.inf, 100.0, 99.0, math.inf]


def test_engaging_begins_the_work_and_engaging_again_changes_nothing():
    made, heard_s = decider(shadow=True, work_s=60.0)
    for second in range(5):
        made.decide(seen(second), second)
    made.engage()
    made.decide(seen(5), 5.0)
    made.decide(seen(6), 6.0)
    made.engage()
    made.decide(seen(7), 7.0)
    assert heard_s == [60.0, 59.0, 58.0, 57.0, 56.0, 60.0, 59.0, 58.0]


def test_a_new_run_is_new_work():
    made, heard_s = decider(work_s=60.0)
    made.decide(seen(0), 0.0)
    made.decide(seen(9), 1.0)
    made.start(1.0, supervised=True)
    made.decide(seen(20), 2.0)
    assert heard_s == [60.0, 51.0, 60.0]


def test_a_clock_that_is_set_back_takes_nothing_off_and_adds_nothing():
    made, heard_s = decider(work_s=60.0)
    made.decide(seen(1000), 0.0)
    made.decide(seen(1010), 1.0)
    made.set_back()
    for second in range(4):
        made.decide(seen(second), 2.0 + second)
    assert heard_s[:2] == [60.0, 50.0] and set(heard_s[2:]) <= {50.0, 49.0, 48.0, 47.0}
    plan, _ = counted(paused(replace(planned(60.0), left_ns=SECOND_NS)), seen(3))
    assert plan.left_ns == SECOND_NS


@pytest.mark.parametrize("work_s", [0.0, -1.0, math.nan, math.inf])
def test_what_is_no_time_is_no_plan(work_s):
    plan, observation = counted(planned(work_s), seen(0))
    assert observation.time_left_s[0] == math.inf and not plan.passed


def test_in_lockstep_it_counts_from_the_first_tick_of_the_run_and_is_shown(make_run):
    run, policy = make_run(), Listening()
    answerer = Answerer(policy)
    answerer.decider.plan_work(4.0)
    answerer.start_run(run.info)
    shown = []
    while not run.done:
        command = None
        for sample in run.samples():
            command = answerer.observe(sample, lambda: 1, 0.0) or command
        shown.append(values_of(answerer, Latencies(), {}, None, 0))
        run.apply(command)
    steps = len(policy.heard_s)
    assert steps == run.info.steps > 5
    assert policy.heard_s == [4.0, 3.0, 2.0, 1.0, *[HOLD_S] * (steps - 4)]
    assert [values["time_left_s"] for values in shown] == [
        4.0,
        3.0,
        2.0,
        1.0,
        *[0.0] * (steps - 4),
    ]
    assert {values["planned_work_s"] for values in shown} == {4.0}
    assert "planned_end" in shown[-1] and "planned_end" not in shown[3]
    assert not warns(answerer, {}, None, 0)


def test_without_a_plan_a_run_says_its_own_end(make_run):
    run, policy = make_run(), Listening()
    answerer = Answerer(policy)
    answerer.start_run(run.info)
    for sample in run.samples():
        answerer.observe(sample, lambda: 1, 0.0)
    assert policy.heard_s == [run.info.steps * run.info.dt_s]
    values = values_of(answerer, Latencies(), {}, None, 0)
    assert values["time_left_s"] == policy.heard_s[0] and "planned_work_s" not in values
