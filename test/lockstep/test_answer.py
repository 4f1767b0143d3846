"""The policy's side: join, decide once, answer when everybody listens, fall back in real time."""

import math
from dataclasses import dataclass, replace

import numpy as np
import pytest

from tractor_ems.answer import Answerer
from tractor_ems.decide import DecideConfig
from tractor_ems.latency import Latencies
from tractor_ems.policies.protocol import ANY_RUN
from tractor_ems.policies.rules import RuleBased
from tractor_msgs_py.errors import CycleError, PolicyError, RunAborted
from tractor_msgs_py.observation import ObservationSpec
from tractor_msgs_py.supervisor import Condition
from tractor_msgs_py.types import BatteryPowerCommand, CommandMode, PowerDemand, Reason
from tractor_sim.plant_run import prepare_run
from tractor_sim.powertrain import Command


@dataclass(frozen=True)
class Counting:
    """Sends how often it was asked, in watts; remembers nothing across runs."""

    name: str = "counting"
    spec: ObservationSpec = ANY_RUN

    def init(self, batch):
        return 0

    def act(self, observation, state):
        return Command(np.array([float(state)]), np.array([math.nan])), state + 1


def observe(answerer, samples, subscribers=1, now_s=0.0):
    """The commands that ``samples`` lead to."""
    answers = [answerer.observe(sample, lambda: subscribers, now_s) for sample in samples]
    return [command for command in answers if command is not None]


@pytest.fixture
def run(make_run):
    return make_run()


@pytest.fixture
def answerer(run):
    answerer = Answerer(Counting())
    answerer.start_run(run.info)
    return answerer


def test_an_observation_is_answered_once_complete_with_its_stamp(run, answerer):
    demand, battery, powertrain = run.samples()
    assert observe(answerer, [battery, demand]) == []
    (command,) = observe(answerer, [powertrain])
    assert command == BatteryPowerCommand(run.stamp_ns, 0.0, pytest.approx(math.nan, nan_ok=True))


def test_a_repeated_tick_is_answered_from_the_cache(run, answerer):
    (first,) = observe(answerer, run.samples())
    (again,) = observe(answerer, run.samples())
    assert again is first
    run.apply(first)
    (second,) = observe(answerer, run.samples())
    assert second.battery_power_w == 1.0


@pytest.mark.parametrize("recorders", [0, 2])
def test_the_first_tick_waits_until_everyone_hears_the_answer(make_run, recorders):
    run, answerer = make_run(expected_recorders=recorders), Answerer(Counting())
    answerer.start_run(run.info)
    assert observe(answerer, run.samples(), subscribers=recorders) == []
    (first,) = observe(answerer, run.samples(), subscribers=1 + recorders)
    assert first.battery_power_w == 0.0
    run.apply(first)
    assert observe(answerer, run.samples(), subscribers=0), "only the first tick waits"


def test_a_new_run_resets_policy_and_cache(make_run, answerer, run):
    (first,) = observe(answerer, run.samples())
    run.apply(first)
    observe(answerer, run.samples())
    other = make_run()
    answerer.start_run(other.info)
    assert not answerer.active
    (command,) = observe(answerer, other.samples())
    assert command.battery_power_w == 0.0


def test_the_same_run_info_again_changes_nothing(run, answerer):
    (first,) = observe(answerer, run.samples())
    answerer.start_run(run.info)
    run.apply(first)
    (second,) = observe(answerer, run.samples())
    assert second.battery_power_w == 1.0


def test_samples_before_a_run_are_refused_and_counted(run):
    answerer = Answerer(Counting())
    assert observe(answerer, run.samples()) == []
    assert answerer.refusals == {"no_run_info": 3}


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_demand_that_is_not_finite_is_refused_until_it_is(run, answerer, value):
    _, *state = run.samples()
    assert observe(answerer, [PowerDemand(run.stamp_ns, value), *state]) == []
    assert answerer.refusals == {"not_finite": 1}
    assert len(observe(answerer, run.samples())) == 1


def test_another_powertrain_is_refused_by_name_and_hash(run):
    answerer = Answerer(Counting(), powertrain_hash="0" * 64)
    with pytest.raises(PolicyError, match=r"counting was made for powertrain 0000.* paper"):
        answerer.start_run(run.info)


def test_the_right_powertrain_and_any_where_none_is_asked_are_driven(run):
    for made_for in (run.info.powertrain_hash, None):
        answerer = Answerer(Counting(), powertrain_hash=made_for)
        answerer.start_run(run.info)
        assert observe(answerer, run.samples())


def test_a_run_that_fails_its_check_is_not_driven(run):
    def check(info):
        raise CycleError(f"not {info.cycle}")

    with pytest.raises(CycleError, match="not short"):
        Answerer(Counting(), check_run=check).start_run(run.info)


def test_what_the_policy_raises_ends_the_run(run, answerer):
    class Stops(Counting):
        def act(self, observation, state):
            raise RunAborted("demand differs")

    answerer = Answerer(Stops())
    answerer.start_run(run.info)
    with pytest.raises(RunAborted, match="demand differs"):
        observe(answerer, run.samples())


@pytest.mark.parametrize(
    ("asked", "sent"), [(math.nan, 0.0), (math.inf, 0.0), (1e30, 60e3), (-1e30, -215e3)]
)
def test_what_a_policy_must_not_ask_is_corrected_and_counted(run, asked, sent):
    class Wild(Counting):
        def act(self, observation, state):
            return Command(np.array([asked]), np.array([math.inf])), state

    answerer = Answerer(Wild())
    answerer.start_run(run.info)
    (command,) = observe(answerer, run.samples())
    assert command.battery_power_w == pytest.approx(sent)
    assert math.isnan(command.engine_power_w) and command.mode is CommandMode.NOMINAL
    assert answerer.corrected == 1


def test_a_rules_own_command_is_not_touched(run):
    answerer = Answerer(RuleBased(run.params))
    answerer.start_run(run.info)
    while not run.done:
        (command,) = observe(answerer, run.samples())
        run.apply(command)
    assert answerer.corrected == 0
    assert not answerer.refusals


def test_silence_in_real_time_gives_the_fallback_law_once_per_timeout(make_run):
    run, answerer = make_run(mode="real_time"), Answerer(Counting(), observation_timeout_s=2.0)
    answerer.start_run(run.info)
    assert answerer.overdue(100.0) is None, "nothing was ever observed"
    observe(answerer, run.samples(), now_s=100.0)
    assert answerer.overdue(102.0) is None
    fallback = answerer.overdue(102.1)
    assert (fallback.mode, fallback.battery_power_w) == (CommandMode.FALLBACK, 0.0)
    assert answerer.overdue(102.2) is None
    assert answerer.overdue(104.2).mode is CommandMode.FALLBACK
    assert answerer.fallbacks == 2


def test_a_stamp_from_the_future_does_not_end_the_watch(make_run):
    run = make_run(mode="real_time")
    answerer = Answerer(RuleBased(run.params), observation_timeout_s=2.0)
    answerer.start_run(run.info)
    observe(answerer, run.samples(), now_s=10.0)
    future_ns = run.info.stamp_ns(run.info.steps) + 1
    observe(answerer, [replace(s, stamp_ns=future_ns) for s in run.samples()], now_s=11.0)
    assert answerer.overdue(12.1).mode is CommandMode.FALLBACK
    assert answerer.shutdown_command().mode is CommandMode.SHUTDOWN


def test_lockstep_is_never_answered_by_a_fallback(run, answerer):
    observe(answerer, run.samples(), now_s=0.0)
    assert answerer.overdue(1e9) is None


def test_a_run_under_way_is_left_with_a_safe_command_and_a_finished_one_with_none(run, answerer):
    assert answerer.shutdown_command() is None
    while not run.done:
        (command,) = observe(answerer, run.samples())
        assert answerer.shutdown_command().mode is CommandMode.SHUTDOWN
        run.apply(command)
    observe(answerer, run.samples())
    assert answerer.shutdown_command() is None
    assert not answerer.active


def test_a_policy_that_joins_late_goes_on_from_there(make_run):
    run = make_run()
    for _ in range(3):
        run.apply(BatteryPowerCommand(run.stamp_ns, 0.0))
    answerer = Answerer(Counting())
    answerer.start_run(replace(run.info))
    (command,) = observe(answerer, run.samples())
    assert command.stamp_ns == run.info.stamp_ns(3)


@pytest.fixture
def live(make_run):
    """A real-time run and a policy that has answered its first tick, at 100 s."""
    run, answerer = make_run(mode="real_time"), Answerer(Counting(), observation_timeout_s=2.0)
    answerer.start_run(run.info)
    observe(answerer, run.samples(), now_s=100.0)
    return run, answerer


def test_after_silence_it_takes_three_good_observations_until_the_policy_drives(live):
    run, answerer = live
    assert answerer.overdue(102.1).reason is Reason.OBSERVATION_STALE
    commands = []
    for second in range(3):
        run.apply(BatteryPowerCommand(run.stamp_ns, 0.0))
        commands += observe(answerer, run.samples(), now_s=103.0 + second)
    assert [command.mode for command in commands] == [1, 1, 0]
    assert [command.reason for command in commands] == [Reason.RECOVERING] * 2 + [Reason.NONE]
    assert commands[-1].battery_power_w == 3.0, "every tick went through the policy"


def test_what_the_policy_raises_in_real_time_latches_the_fallback_law(make_run):
    class Stops(Counting):
        def act(self, observation, state):
            raise RunAborted("demand differs")

    run, answerer = make_run(mode="real_time"), Answerer(Stops())
    answerer.start_run(run.info)
    (command,) = observe(answerer, run.samples())
    assert (command.mode, command.reason) == (CommandMode.FALLBACK, Reason.FAULT)
    assert answerer.decider.trust.reason is Reason.POLICY_ERROR
    assert answerer.decider.trouble == "RunAborted: demand differs"
    again = make_run(mode="real_time")
    answerer.start_run(again.info)
    assert not answerer.decider.trouble, "a new run forgives"


@pytest.mark.parametrize("shadow", [False, True])
def test_a_rehearsal_leaves_no_trace_whatever_the_policy_does(run, shadow):
    class Odd(Counting):
        def act(self, observation, state):
            if observation.stamp_ns == 1:
                raise RunAborted("not my run")
            return super().act(observation, state)

    for policy in (Counting(), Odd()):
        fresh = Answerer(policy, config=DecideConfig(shadow=shadow))
        rehearsed = Answerer(policy, config=DecideConfig(shadow=shadow))
        rehearsed.decider.rehearse()
        assert rehearsed.decider.trust == fresh.decider.trust
        assert rehearsed.decider.mode is fresh.decider.mode
        assert rehearsed.counters == fresh.counters and not rehearsed.decider.trouble
        for answerer in (fresh, rehearsed):
            answerer.start_run(run.info)
        said = [str(observe(a, run.samples())) for a in (fresh, rehearsed)]  # NaN equals NaN
        assert said[0] == said[1]
        wishes = [a.decision.wish.battery_power_w for a in (fresh, rehearsed)]
        assert wishes == [0.0, 0.0]


def test_a_policy_that_answers_with_no_number_for_long_is_not_trusted_any_more(tmp_path):
    class Lost(Counting):
        def act(self, observation, state):
            return Command(np.array([math.nan]), np.array([math.nan])), state

    cycle = tmp_path / "long.csv"
    cycle.write_text("time_s,power_demand_w\n" + "".join(f"{k},9e4\n" for k in range(40)))
    run, answerer = prepare_run("paper", str(cycle), mode="real_time"), Answerer(Lost())
    answerer.start_run(run.info)
    modes, reasons = [], set()
    while not run.done:
        (command,) = observe(answerer, run.samples(), now_s=float(run.k))
        modes.append(command.mode)
        reasons.add(command.reason)
        run.apply(BatteryPowerCommand(run.stamp_ns, 0.0))
    assert modes[0] is CommandMode.NOMINAL and modes[-1] is CommandMode.FALLBACK
    assert reasons == {Reason.POLICY_ERROR, Reason.FAULT}
    assert answerer.decider.trust.condition is Condition.FAULT


@pytest.mark.parametrize("broken", [False, True])
def test_a_clock_that_is_set_back_makes_no_fault_forgotten(make_run, broken):
    class Policy(Counting):
        def act(self, observation, state):
            if broken:
                raise ValueError("out of order")
            return super().act(observation, state)

    run, answerer = make_run(mode="real_time"), Answerer(Policy())
    answerer.start_run(run.info)
    observe(answerer, run.samples(), now_s=1.0)
    decider = answerer.decider
    decider.set_back()
    assert decider.trust.condition is (Condition.FAULT if broken else Condition.STALE)
    said = answerer.overdue(9.0)
    assert said.mode is CommandMode.FALLBACK, "it drives, so it goes on saying so"
    assert decider.reasons == ({"policy_error": 1} if broken else {})


def test_an_implausible_observation_is_not_answered(make_run):
    run = make_run(mode="real_time")
    answerer = Answerer(RuleBased(run.params), config=DecideConfig(params=run.params))
    answerer.start_run(run.info)
    assert observe(answerer, run.samples())
    run.apply(BatteryPowerCommand(run.stamp_ns, 0.0))
    demand, battery, state = run.samples()
    assert not observe(answerer, [demand, replace(battery, soc=0.2), state])
    assert "it jumped" in answerer.decider.complaint


def test_the_soc_target_can_be_moved_and_given_back_to_the_run(run, answerer):
    answerer.aim(0.75)
    assert answerer.run.soc_target == 0.75
    answerer.aim(None)
    assert answerer.run.soc_target == run.info.soc_target


def test_latencies_are_counted_to_within_two_percent():
    latencies = Latencies(1e-3 * k for k in range(1, 1001))
    assert latencies.quantile_s(0.5) == pytest.approx(0.5, rel=0.02)
    assert latencies.quantile_s(0.99) == pytest.approx(0.99, rel=0.02)
    assert (latencies.count, latencies.max_s) == (1000, 1.0)
    assert Latencies().quantile_s(0.5) == 0.0
