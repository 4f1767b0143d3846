"""Hand-over: no step in generator power on the way in or out, whoever asks and whenever."""

import contextlib
import itertools
import math
from dataclasses import dataclass, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tractor_ems import handover as ho
from tractor_ems.answer import Answerer
from tractor_ems.decide import DecideConfig, Decider
from tractor_ems.handover import HandoverConfig, HandoverState, Mode
from tractor_ems.policies.protocol import ANY_RUN, limits_of
from tractor_ems.safety import vehicle_command
from tractor_msgs_py.errors import ConfigError, PolicyError
from tractor_msgs_py.observation import Observation
from tractor_msgs_py.supervisor import Condition
from tractor_msgs_py.types import BatteryPowerCommand, CommandMode, Reason
from tractor_sim.config import load_powertrain
from tractor_sim.pace import Peers
from tractor_sim.plant_run import prepare_run
from tractor_sim.powertrain import Command
from tractor_sim.real_time import RealTime
from tractor_sim.safe_command import bounds_w

RAMP = HandoverConfig(ramp_w_per_s=10e3)
CALM = Peers(1, 1, True, 1)
ROUNDING_W = 1e-3


def seen(demand_w=150e3, engine_w=150e3, stamp_ns=1, limit_w=215e3):
    """An observation whose battery and engine are far from their limits."""
    one = np.ones(1)
    return Observation(
        stamp_ns=stamp_ns,
        power_demand_w=demand_w * one,
        soc=0.8 * one,
        soc_target=0.8 * one,
        engine_on=np.array([engine_w > 0.0]),
        time_in_state_s=100.0 * one,
        engine_power_w=engine_w * one,
        charge_limit_w=limit_w * one,
        discharge_limit_w=limit_w * one,
        engine_limit_w=275e3 * one,
        features=np.zeros((1, 0)),
    )


def wish(observation, battery_w, engine_w=math.nan):
    asked = Command(np.array([battery_w]), np.array([engine_w]))
    return vehicle_command(observation, asked)[0]


def test_in_the_shadow_nothing_is_commanded():
    observation = seen()
    state, command = ho.hand_over(RAMP, HandoverState(), observation, wish(observation, 9e3), 1.0)
    assert (state.mode, command) == (Mode.SHADOW, None)


def test_a_negative_ramp_is_refused_and_a_powertrain_without_one_gets_the_default():
    with pytest.raises(ConfigError, match=r"ramp_w_per_s: -1.*allowed >= 0"):
        HandoverConfig(-1.0)
    assert ho.ramp_of(math.inf) == ho.DEFAULT_RAMP_W_PER_S
    assert ho.ramp_of(25e3) == 25e3


@pytest.mark.parametrize(
    ("mode", "engaged", "disengaged"),
    [
        (Mode.SHADOW, Mode.ENGAGING, Mode.SHADOW),
        (Mode.ENGAGING, Mode.ENGAGING, Mode.DISENGAGING),
        (Mode.ENGAGED, Mode.ENGAGED, Mode.DISENGAGING),
        (Mode.DISENGAGING, Mode.ENGAGING, Mode.SHADOW),
    ],
)
def test_what_enable_does_in_every_mode(mode, engaged, disengaged):
    state = HandoverState(mode, 5e3)
    assert ho.engage(state).mode is engaged
    assert ho.disengage(state).mode is disengaged


def test_it_begins_at_what_is_applied_and_holds_until_everybody_hears():
    state = ho.engage(HandoverState())
    for heard in (False, False, True, True, True):
        observation = seen(demand_w=150e3, engine_w=90e3)
        state, command = ho.hand_over(RAMP, state, observation, wish(observation, 0.0), 1.0, heard)
        assert ho.set_point_w(observation, command) == pytest.approx(90e3)
        assert (command.mode, command.reason) == (CommandMode.NOMINAL, Reason.HANDOVER)
    state, command = ho.hand_over(RAMP, state, observation, wish(observation, 0.0), 1.0)
    assert ho.set_point_w(observation, command) == pytest.approx(100e3)


def test_it_is_engaged_once_the_wish_is_reached_and_then_jumps_as_the_policy_wants():
    state, applied_w = replace(ho.engage(HandoverState()), held=ho.HOLD_TICKS), 120e3
    reasons = []
    for _ in range(4):
        observation = seen(engine_w=applied_w)
        state, command = ho.hand_over(RAMP, state, observation, wish(observation, 0.0), 1.0)
        reasons.append(command.reason)
        applied_w = ho.set_point_w(observation, command)
    assert state.mode is Mode.ENGAGED
    assert reasons == [Reason.HANDOVER, Reason.HANDOVER, Reason.NONE, Reason.NONE]
    state, command = ho.hand_over(RAMP, state, observation, wish(observation, 100e3), 1.0)
    assert ho.set_point_w(observation, command) == pytest.approx(50e3)


def test_ramp_always_holds_while_engaged_too():
    config, observation = replace(RAMP, always=True), seen()
    state = HandoverState(Mode.ENGAGED, 150e3)
    state, command = ho.hand_over(config, state, observation, wish(observation, 100e3), 1.0)
    assert ho.set_point_w(observation, command) == pytest.approx(140e3)
    assert state.mode is Mode.ENGAGED


def test_engine_off_waits_for_the_ramp():
    state, applied_w = replace(ho.engage(HandoverState()), held=ho.HOLD_TICKS), 25e3
    powers = []
    for _ in range(3):
        observation = seen(demand_w=30e3, engine_w=applied_w)
        off = wish(observation, 30e3, 0.0)
        state, command = ho.hand_over(RAMP, state, observation, off, 1.0)
        applied_w = ho.set_point_w(observation, command)
        powers.append((applied_w, command.engine_power_w == 0.0))
    assert powers == [(15e3, False), (5e3, False), (0.0, True)]


def test_it_leaves_with_the_fallback_law():
    observation, state = seen(engine_w=135e3), HandoverState(Mode.DISENGAGING, 135e3)
    state, command = ho.hand_over(RAMP, state, observation, wish(observation, 99e3), 1.0)
    assert (command.mode, command.reason) == (CommandMode.NOMINAL, Reason.HANDOVER)
    assert ho.set_point_w(observation, command) == pytest.approx(145e3)
    observation = seen(engine_w=145e3)
    state, command = ho.hand_over(RAMP, state, observation, wish(observation, 99e3), 1.0)
    assert (command.mode, command.reason) == (CommandMode.FALLBACK, Reason.HANDOVER)
    assert command.battery_power_w == 0.0 and state == HandoverState()


@settings(max_examples=60, deadline=None)
@given(
    st.lists(
        st.tuples(
            st.sampled_from(["tick", "tick", "tick", "engage", "disengage", "deaf"]),
            st.floats(-100e3, 400e3),
            st.floats(-300e3, 300e3),
            st.floats(0.0, 250e3),
        ),
        max_size=40,
    )
)
def test_no_step_beyond_the_ramp_but_for_what_is_infeasible(events):
    state, applied_w = HandoverState(), 0.0
    for what, demand_w, wished_w, limit_w in events:
        if what in ("engage", "disengage"):
            state = getattr(ho, what)(state)
        observation = seen(demand_w, applied_w, limit_w=limit_w)
        before, heard = state, what != "deaf"
        state, command = ho.hand_over(
            RAMP, state, observation, wish(observation, wished_w), 0.1, heard
        )
        if command is None:
            assert before.mode is Mode.SHADOW
            continue
        power_w = ho.set_point_w(observation, command)
        lowest = vehicle_command(observation, Command(np.array([1e9]), np.array([math.nan])))[0]
        highest = vehicle_command(observation, Command(np.array([-1e9]), np.array([math.nan])))[0]
        bounds = [ho.set_point_w(observation, bound) for bound in (lowest, highest)]
        assert bounds[0] - ROUNDING_W <= power_w <= bounds[1] + ROUNDING_W
        if before.mode in (Mode.ENGAGING, Mode.DISENGAGING):
            from_w = before.generator_w if math.isfinite(before.generator_w) else applied_w
            near = min(max(from_w, bounds[0]), bounds[1])
            most_w = max(abs(near - from_w), RAMP.ramp_w_per_s * 0.1) + ho.REACHED_W
            assert abs(power_w - from_w) <= most_w + ROUNDING_W
        applied_w = power_w


def test_a_command_that_came_too_late_does_not_make_the_next_step_twice_as_large():
    step_w, state = RAMP.ramp_w_per_s * 0.1, HandoverState(Mode.ENGAGING, 30e3, ho.HOLD_TICKS)
    said_w = []
    for applied_w in (30e3, 30e3, 30e3 + step_w, 30e3 + 2 * step_w):  # the first came too late
        observation = seen(100e3, applied_w)
        state, command = ho.hand_over(RAMP, state, observation, wish(observation, 0.0), 0.1)
        said_w.append(ho.set_point_w(observation, command) - 30e3)
    assert said_w == pytest.approx([step_w, step_w, 2 * step_w, 3 * step_w])


@pytest.mark.parametrize("mode", [Mode.ENGAGING, Mode.DISENGAGING])
def test_a_generator_that_never_follows_is_handed_over_all_the_same(mode):
    state, ticks = HandoverState(mode, 0.0, ho.HOLD_TICKS), 0
    while state.mode is mode:
        observation = seen(20e3, 0.0)
        state, _ = ho.hand_over(RAMP, state, observation, wish(observation, 0.0), 0.1)
        ticks += 1
        assert ticks < 100
    assert ticks <= 20 * (1 + ho.MOST_WAITS)


@dataclass(frozen=True)
class Aims:
    """Wishes a generator power that does not depend on demand."""

    engine_power_w: float = 60e3
    name: str = "aims"
    spec: object = ANY_RUN

    def init(self, batch):
        return None

    def act(self, observation, state):
        wished_w = observation.power_demand_w - self.engine_power_w
        return Command(wished_w, np.full(1, math.nan)), state


class Road:
    """A plant in real time on a virtual clock and a policy beside it, tick by tick."""

    def __init__(self, demand_w, path, dt_s=0.1, ramp_w_per_s=60e3, policy=None, **config):
        rows = "".join(f"{k * dt_s:.6g},{p!r}\n" for k, p in enumerate(map(float, demand_w)))
        path.write_text("time_s,power_demand_w\n" + rows)
        run = prepare_run(f"paper:dt_s={dt_s}", str(path), mode="real_time")
        self.plant, self.dt_s, self.now_s = RealTime(run, dt_s, 2.0), dt_s, 100.0
        self.answerer = Answerer(
            policy or Aims(),
            config=DecideConfig(
                handover=HandoverConfig(ramp_w_per_s), shadow=True, params=run.params, **config
            ),
        )
        self.answerer.start_run(run.info)
        self.modes, self.commands = [], []
        self._hear(self.plant.start(CALM, self.now_s))

    @property
    def decider(self):
        return self.answerer.decider

    def _hear(self, samples):
        for sample in samples:
            command = self.answerer.observe(sample, lambda: 1, self.now_s)
            if command is not None:
                self.commands.append(command)
                self.plant.offer(command, 1, self.now_s)
        self.modes.append(self.decider.mode)

    def tick(self, count=1):
        for _ in range(count):
            self.now_s += self.dt_s
            driving = int(self.decider.handover.commanding)
            self._hear(self.plant.poll(driving, self.now_s + 1e-6))

    def steps_w(self):
        """Change of applied engine power at every tick at which the drive changes hands."""
        powers_w = self.plant.run.trajectory().engine_power_w
        moving = (Mode.ENGAGING, Mode.DISENGAGING)
        modes = self.modes[: len(powers_w)]
        handed = [
            a in moving or b in moving or (a is not b)
            for a, b in itertools.pairwise([Mode.SHADOW, *modes])
        ]
        steps = np.abs(np.diff(powers_w))
        return [step for step, changing in zip(steps, handed[1:], strict=False) if changing]


def toggle(road, times, rng):
    """Engage and disengage at random moments."""
    for _ in range(times):
        road.decider.engage()
        road.tick(int(rng.integers(1, 40)))
        if road.decider.mode is not Mode.SHADOW:
            road.decider.disengage()
        while road.decider.mode is not Mode.SHADOW:
            road.tick()
        road.tick(int(rng.integers(2, 10)))


def demand_of(kind, steps, rng):
    if kind == "constant":
        return np.full(steps, 150e3)
    walk = np.cumsum(rng.normal(0.0, 3e3, steps))
    return 120e3 + 60e3 * np.sin(np.arange(steps) / 25.0) + np.clip(walk, -30e3, 30e3)


@pytest.mark.parametrize("times", [10, pytest.param(100, marks=pytest.mark.slow)])
@pytest.mark.parametrize("kind", ["constant", "varying"])
def test_no_power_step_beyond_the_ramp_however_often_it_changes_hands(
    kind, times, tmp_path, record_property
):
    rng = np.random.Generator(np.random.PCG64(5))
    road = Road(demand_of(kind, 300 * times, rng), tmp_path / "cycle.csv")
    road.tick(3)
    toggle(road, times, rng)
    steps = road.steps_w()
    engaged = sum(
        b is Mode.ENGAGING and a is Mode.SHADOW for a, b in itertools.pairwise(road.modes)
    )
    record_property("worst_step_w", float(max(steps)))
    print(f"{kind}: {engaged} engagements, worst step {max(steps):.1f} W of 6000 W")
    assert engaged == times
    assert max(steps) <= 60e3 * 0.1 + ho.REACHED_W
    if kind == "constant":
        powers_w = road.plant.run.trajectory().engine_power_w[1:]
        assert np.abs(np.diff(powers_w)).max() <= 60e3 * 0.1 + ho.REACHED_W


def road_of(tmp_path, **settings):
    road = Road(np.full(400, 150e3), tmp_path / "cycle.csv", **settings)
    road.tick(3)
    return road


def test_engaging_is_refused_before_there_is_an_observation(tmp_path):
    decider = Answerer(Aims(), config=DecideConfig(shadow=True)).decider
    with pytest.raises(PolicyError, match="no observation of a run that can be used yet"):
        decider.engage()
    decider.start(0.1, supervised=True)
    with pytest.raises(PolicyError, match=r"INIT.*no observation of a run that can be used yet"):
        decider.engage()


def test_engaging_is_refused_while_observations_are_stale(tmp_path):
    road = road_of(tmp_path)
    assert road.answerer.overdue(road.now_s + 2.1) is None, "nothing is said in the shadow"
    with pytest.raises(PolicyError, match=r"STALE.*observations stopped"):
        road.decider.engage()


def test_a_policy_that_fails_is_replaced_by_the_fallback_law_and_forgiven_by_disengaging(tmp_path):
    @dataclass(frozen=True)
    class Breaks(Aims):
        def act(self, observation, state):
            if state is True:
                raise ValueError("broken")
            return super().act(observation, state)

    road = road_of(tmp_path, policy=Breaks())
    road.decider.engage()
    road.tick(30)
    assert road.decider.mode is Mode.ENGAGED
    road.decider._memory = True
    road.tick(3)
    assert road.decider.trust.condition is Condition.FAULT
    assert road.decider.trouble == "ValueError: broken"
    last = road.commands[-1]
    assert (last.mode, last.reason) == (CommandMode.FALLBACK, Reason.FAULT)
    command, text = road.decider.disengage()
    assert command.reason is Reason.HANDOVER and text == "stopped at once"
    assert road.decider.trust.condition is Condition.INIT and not road.decider.trouble


def test_observations_that_stop_while_disengaging_end_the_drive(tmp_path):
    road = road_of(tmp_path)
    road.decider.engage()
    road.tick(30)
    road.decider.disengage()
    road.tick()
    assert road.decider.mode is Mode.DISENGAGING
    command = road.answerer.overdue(road.now_s + 2.1)
    assert (command.mode, command.reason) == (CommandMode.FALLBACK, Reason.HANDOVER)
    assert road.decider.mode is Mode.SHADOW


def test_shutting_down_while_engaged_leaves_the_safe_command_and_in_the_shadow_nothing(tmp_path):
    road = road_of(tmp_path)
    assert road.answerer.shutdown_command() is None
    road.decider.engage()
    road.tick(30)
    left = road.answerer.shutdown_command()
    assert (left.mode, left.reason) == (CommandMode.SHUTDOWN, Reason.SHUTDOWN)
    assert isinstance(left, BatteryPowerCommand) and left.battery_power_w == 0.0


def test_engaging_is_refused_once_the_run_is_over(tmp_path):
    road = Road(np.full(5, 150e3), tmp_path / "cycle.csv")
    road.tick(5)
    assert road.plant.run.done
    road._hear(road.plant.run.closing_samples())
    with pytest.raises(PolicyError, match="INIT"):
        road.decider.engage()


WILD = st.one_of(
    st.sampled_from([math.nan, math.inf, -math.inf, 1e308, -1e308, 0.0]), st.floats(-500e3, 500e3)
)


@dataclass
class Wild:
    """Answers what it is told to, however absurd; None raises."""

    battery_w: float | None = 0.0
    engine_power_w: float = 0.0
    name: str = "wild"
    spec: object = ANY_RUN

    def init(self, batch):
        return None

    def act(self, observation, state):
        if self.battery_w is None:
            raise ZeroDivisionError("told to")
        return Command(np.array([self.battery_w]), np.array([self.engine_power_w])), state


EVENTS = st.lists(
    st.tuples(
        st.sampled_from(["tick"] * 6 + ["engage", "disengage", "silence", "clear"]),
        WILD,
        st.one_of(st.none(), WILD),
        WILD,
        st.floats(0.0, 1.0),
    ),
    max_size=40,
)


def said(decider, what, observation, now_s):
    """The commands that one event leads to."""
    if what == "engage":
        with contextlib.suppress(PolicyError):
            decider.engage()
        return []
    if what == "disengage":
        return [decider.disengage()[0]]
    if what == "silence":
        return [decider.overdue(now_s)]
    if what == "clear":
        decider.clear()
        return []
    decision = decider.decide(observation, now_s)
    return [None if decision is None else decision.command]


@settings(max_examples=50, deadline=None)
@given(EVENTS, st.booleans())
def test_whatever_is_seen_wished_or_asked_for_what_leaves_is_finite_and_feasible(events, always):
    ramp = replace(RAMP, always=always)
    config = DecideConfig(handover=ramp, params=load_powertrain("field"), vehicle=True)
    policy, now_s = Wild(), 0.0
    decider = Decider(policy, config)
    decider.start(0.1, supervised=True)
    for k, (what, demand_w, wished_w, other_w, soc) in enumerate(events, 1):
        now_s += 3.0 if what == "silence" else 0.1
        policy.battery_w, policy.engine_power_w = wished_w, other_w
        observation = seen(demand_w, abs(other_w), k * 10**8, limit_w=abs(other_w))
        observation = replace(observation, soc=np.array([soc]))
        for command in (*said(decider, what, observation, now_s), decider.shutdown_command()):
            if command is None:
                continue
            known = decider.observation
            lb, ub = bounds_w(limits_of(known), known.power_demand_w)
            assert math.isfinite(command.battery_power_w)
            assert not math.isinf(command.engine_power_w)
            assert lb[0] - 1e-6 <= command.battery_power_w <= ub[0] + 1e-6
