"""No order of events makes either side send or apply what is not finite and feasible."""

import math

import numpy as np
import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, precondition, rule
from lockstep.million_events import KINDS, run_events
from lockstep.safety_events import PlantSide, PolicySide

ANY_W = st.floats(-3e5, 3e5) | st.floats() | st.sampled_from([0.0, math.nan, math.inf, 1e308])
ENGINE_W = st.just(math.nan) | st.just(0.0) | st.floats()
POWERTRAIN = st.sampled_from(["paper", "field"])
RAMP = st.sampled_from([0.0, 2e4, 6e4, 2e5])


class PlantMachine(RuleBasedStateMachine):
    """The plant in real time; ``PlantSide`` asserts after every step."""

    @initialize(
        powertrain=POWERTRAIN,
        seed=st.integers(0, 2**32 - 1),
        timeout_s=st.floats(0.1, 3.0),
        recover=st.integers(1, 4),
        ramp=RAMP,
    )
    def start(self, powertrain, seed, timeout_s, recover, ramp):
        demand_w = np.random.Generator(np.random.PCG64(seed)).uniform(-2e5, 6e5, 12)
        self.side = PlantSide(powertrain, demand_w, 0.5, timeout_s, recover, ramp)

    @rule(battery_w=st.floats(-3e5, 3e5), off=st.booleans())
    def answer(self, battery_w, off):
        self.side.say("good", battery_w, 0.0 if off else math.nan)

    @rule(battery_w=st.floats(-3e5, 3e5), late_s=st.floats(0.0, 0.4))
    def answer_and_step(self, battery_w, late_s):
        self.side.say("good", battery_w)
        self.side.tick(late_s)

    @rule(
        kind=st.sampled_from(sorted(set(KINDS))),
        battery_w=ANY_W,
        engine_w=ENGINE_W,
        back=st.integers(0, 20),
    )
    def say_anything(self, kind, battery_w, engine_w, back):
        self.side.say("wild" if kind == "good" else kind, battery_w, engine_w, back)

    @rule(battery_w=st.floats(-3e5, 3e5), times=st.integers(21, 40))
    def flood(self, battery_w, times):
        for k in range(times):
            self.side.say("good", battery_w / (k + 1))

    @rule(late_s=st.floats(0.0, 5.0), publishers=st.sampled_from([0, 1, 1, 1, 2]))
    def step(self, late_s, publishers):
        self.side.tick(late_s, publishers)

    @rule(by_s=st.floats(-1e-6, 0.3))
    def wait(self, by_s):
        self.side.now_s += by_s

    @precondition(lambda self: self.side.run.k > 3)
    @rule()
    def restart(self):
        self.side.restart()


class PolicyMachine(RuleBasedStateMachine):
    """The policy's pure functions; ``PolicySide`` asserts after every observation."""

    @initialize(powertrain=POWERTRAIN, ramp=RAMP, dt_s=st.sampled_from([0.1, 1.0]))
    def start(self, powertrain, ramp, dt_s):
        self.side = PolicySide(powertrain, ramp, dt_s)

    @rule(
        power_demand_w=ANY_W,
        soc=st.floats(0.6, 0.62) | st.floats(),
        time_in_state_s=st.floats(),
        engine_power_w=ANY_W,
        charge_limit_w=ANY_W,
        discharge_limit_w=ANY_W,
        engine_limit_w=ANY_W,
        battery_w=ANY_W,
        engine_w=ENGINE_W,
    )
    def observe_anything(self, battery_w, engine_w, **values):
        self.side.observe(values, battery_w, engine_w)

    @rule(
        demand_w=st.floats(-2e5, 5e5),
        limit_w=st.sampled_from([0.0, 5e4, math.inf]),
        battery_w=ANY_W,
        engine_w=ENGINE_W,
    )
    def observe(self, demand_w, limit_w, battery_w, engine_w):
        values = {
            "power_demand_w": demand_w,
            "soc": 0.61,
            "time_in_state_s": 10.0,
            "engine_power_w": max(demand_w, 0.0),
            "charge_limit_w": limit_w,
            "discharge_limit_w": limit_w,
            "engine_limit_w": math.inf,
        }
        self.side.observe(values, battery_w, engine_w)

    @rule(periods=st.integers(1, 5))
    def silence(self, periods):
        self.side.silence(periods)

    @rule()
    def restart(self):
        self.side.restart()


FEW = settings(max_examples=30, stateful_step_count=20, deadline=None)
TestPlant = PlantMachine.TestCase
TestPlant.settings = FEW
TestPolicy = PolicyMachine.TestCase
TestPolicy.settings = FEW


def test_random_events_reach_every_kind_and_every_condition():
    counts = run_events(4000, seed=1)
    for kind in set(KINDS):
        assert counts[f"plant {kind}"] > 5
    ticks = counts["plant nominal"] + counts["plant fallback"]
    assert 0.2 < counts["plant nominal"] / ticks < 0.9
    for condition in ("init", "nominal", "stale", "recovering", "fault"):
        assert counts[f"policy fallback_{condition}"] > 5


@pytest.mark.slow
def test_fifty_thousand_events_break_nothing():
    assert run_events(50_000, seed=2)["events"] >= 50_000
