"""Outside what a policy was trained on: told, counted, and where asked for left to the fallback
law, with hysteresis both ways."""

import math
from dataclasses import dataclass, replace

import numpy as np
import pytest

from tractor_ems.answer import Answerer
from tractor_ems.decide import DecideConfig, Decider
from tractor_ems.drive_report import state_of, values_of, warns
from tractor_ems.envelope_watch import EnvelopeState, watched
from tractor_ems.latency import Latencies
from tractor_ems.policies.protocol import ANY_RUN
from tractor_msgs_py import supervisor
from tractor_msgs_py.codec import decode_command, encode_command
from tractor_msgs_py.errors import PolicyError
from tractor_msgs_py.observation import Observation, ObservationSpec
from tractor_msgs_py.types import BatteryPowerCommand, CommandMode, Reason
from tractor_sim.powertrain import Command

ENVELOPE = {"power_demand_w": (0.0, 2e5), "soc": (0.3, 0.8)}
INSIDE_W, OUTSIDE_W = 1e5, 2.5e5


@dataclass(frozen=True)
class Half:
    """Wishes half of the demand; remembers how often it was asked."""

    name: str = "half"
    spec: ObservationSpec = ANY_RUN

    def init(self, batch):
        return 0

    def act(self, observation, state):
        return Command(0.5 * observation.power_demand_w, np.full(1, math.nan)), state + 1


def seen(k, demand_w=INSIDE_W, soc=0.5):
    """The observation of second ``k``."""
    one = np.ones(1)
    return Observation(
        stamp_ns=(k + 1) * 1_000_000_000,
        power_demand_w=demand_w * one,
        soc=soc * one,
        soc_target=0.5 * one,
        engine_on=np.array([True]),
        time_in_state_s=9 * one,
        engine_power_w=demand_w * one,
        charge_limit_w=2e5 * one,
        discharge_limit_w=2e5 * one,
        engine_limit_w=3e5 * one,
        features=np.zeros((1, 0)),
    )


def decider(fallback=True, outside_s=3.0, envelope=ENVELOPE, shadow=False):
    made = Decider(Half(), DecideConfig(shadow=shadow, envelope=envelope))
    made.config = replace(made.config, outside_fallback=fallback, outside_s=outside_s)
    made.rehearse()
    made.start(1.0, supervised=True)
    return made


def drive(made, demands_w, first=0):
    """The commands of a tick per second."""
    return [made.decide(seen(first + k, w), first + k).command for k, w in enumerate(demands_w)]


def reasons(commands):
    return [command.reason for command in commands]


NONE, OUTSIDE = Reason.NONE, Reason.OUTSIDE_ENVELOPE


def test_the_fallback_law_holds_once_it_is_outside_for_long_and_the_policy_once_long_inside():
    made = decider(outside_s=3.0)
    commands = drive(made, [INSIDE_W] * 2 + [OUTSIDE_W] * 5 + [INSIDE_W] * 5)
    assert reasons(commands) == [NONE] * 4 + [OUTSIDE] * 5 + [NONE] * 3
    for command in commands:
        away = command.reason is OUTSIDE
        assert command.mode is (CommandMode.FALLBACK if away else CommandMode.NOMINAL)
        assert away == (command.battery_power_w == 0.0)
    assert made.fallbacks == 5
    assert made.trust.nominal, "observations are good, the policy just does not know them"


def test_short_excursions_never_lead_there_and_long_ones_with_short_breaks_do():
    assert OUTSIDE not in reasons(drive(decider(), [OUTSIDE_W, OUTSIDE_W, INSIDE_W, INSIDE_W] * 9))
    assert OUTSIDE in reasons(drive(decider(), [OUTSIDE_W, OUTSIDE_W, INSIDE_W] * 9))


def test_only_warning_is_the_default_and_changes_no_command():
    assert not DecideConfig().outside_fallback
    commands = drive(decider(fallback=False), [OUTSIDE_W] * 20)
    assert set(reasons(commands)) == {NONE}
    assert {command.battery_power_w for command in commands} == {0.5 * OUTSIDE_W}


def test_without_an_envelope_nothing_is_outside():
    made = decider(envelope=None)
    assert set(reasons(drive(made, [OUTSIDE_W] * 20))) == {NONE}
    assert not made.envelope.suspect and not made.outside_ticks


def test_zero_seconds_is_at_once_both_ways():
    commands = drive(decider(outside_s=0.0), [INSIDE_W, OUTSIDE_W, INSIDE_W])
    assert reasons(commands) == [NONE, OUTSIDE, NONE]


def test_the_bucket_is_bounded_so_that_recovery_never_takes_longer():
    state, far = EnvelopeState(), seen(0, OUTSIDE_W)
    for _ in range(1000):
        state = watched(ENVELOPE, 10.0, state, far, 1.0)
    assert state.outside_s == 10.0 and state.away
    for k in range(10):
        assert state.away, k
        state = watched(ENVELOPE, 10.0, state, seen(0), 1.0)
    assert not state.away and not state.suspect


def test_a_limit_that_is_made_shorter_holds_at_once():
    state = EnvelopeState(outside_s=9.0)
    assert watched(ENVELOPE, 2.0, state, seen(0), 1.0).outside_s == 1.0


def test_a_new_run_begins_inside_and_keeps_the_count():
    made = decider()
    drive(made, [OUTSIDE_W] * 5)
    made.start(1.0, supervised=True)
    assert reasons(drive(made, [INSIDE_W])) == [NONE]
    assert made.outside_ticks == {"power_demand_w": 5}


def test_the_policys_memory_goes_on_while_it_is_away():
    made = decider()
    drive(made, [OUTSIDE_W] * 6)
    assert made._memory == 6


def test_lost_trust_is_the_stronger_reason():
    made = decider(outside_s=0.0)
    drive(made, [OUTSIDE_W])
    made.lost()
    assert reasons(drive(made, [OUTSIDE_W], first=1)) == [Reason.RECOVERING]


def test_a_policy_is_not_engaged_outside_what_it_knows():
    made = decider(shadow=True, outside_s=1.0)
    assert drive(made, [OUTSIDE_W] * 2) == [None, None]
    with pytest.raises(PolicyError, match=r"power_demand_w: 250000, training saw 0\.\.2"):
        made.engage()
    made.decide(seen(2), 2.0)
    assert made.engage().startswith("engaging")


def test_in_lockstep_it_warns_but_the_policy_answers(make_run):
    run = make_run()
    config = DecideConfig(envelope={"power_demand_w": (0.0, 1e5)}, outside_fallback=True)
    config = replace(config, outside_s=0.0)
    answerer = Answerer(Half(), config=config)
    answerer.start_run(run.info)
    warned = []
    while not run.done:
        command = None
        for sample in run.samples():
            command = answerer.observe(sample, lambda: 1, 0.0) or command
        assert command.mode is CommandMode.NOMINAL and command.reason is NONE
        warned.append(warns(answerer, {}, None, 0))
        run.apply(command)
    values = values_of(answerer, Latencies(), {}, None, 0)
    outside = [float(w) > 1.01e5 for w in run.power_demand_w]
    assert warned == outside and any(outside) and not all(outside)
    assert values["outside_power_demand_w"] == sum(outside)


def test_people_see_signal_value_range_and_count(make_run):
    answerer = Answerer(Half(), config=DecideConfig(envelope=ENVELOPE))
    made = answerer.decider
    made.config = replace(made.config, outside_fallback=True, outside_s=2.0)
    answerer.start_run(replace(make_run().info, lockstep=False))

    def told(k, demand_w, soc):
        answerer.decision = made.decide(seen(k, demand_w, soc), k)
        return values_of(answerer, Latencies(), {}, None, 0)

    values = told(0, INSIDE_W, 0.5)
    assert values["envelope"] == "inside" and "outside_envelope" not in values
    assert not warns(answerer, {}, None, 0)
    values = told(1, OUTSIDE_W, 0.9)
    assert values["envelope"] == "outside"
    assert values["outside_envelope"] == (
        "power_demand_w: 250000, training saw 0..200000; soc: 0.9, training saw 0.3..0.8"
    )
    assert warns(answerer, {}, None, 0) and "outside" not in state_of(answerer)
    values = told(2, INSIDE_W, 0.9)
    assert values["envelope"] == "away" and "outside what the policy" in state_of(answerer)
    assert (values["outside_power_demand_w"], values["outside_soc"]) == (1, 2)


def test_its_reason_travels_and_has_words():
    said = BatteryPowerCommand(5, 0.0, mode=CommandMode.FALLBACK, reason=OUTSIDE)

    class Factory:
        @staticmethod
        def joint_state(stamp_ns, names, efforts):
            stamp = type("Stamp", (), {"sec": 0, "nanosec": stamp_ns})
            header = type("Header", (), {"stamp": stamp})
            return type("Message", (), {"header": header, "name": names, "effort": efforts})

    heard = decode_command(encode_command(said, Factory))
    assert (heard.reason, heard.mode) == (OUTSIDE, CommandMode.FALLBACK)
    assert supervisor.REASON_TEXT.keys() == set(Reason)
