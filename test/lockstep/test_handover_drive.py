"""Hand-over of whole drives: a plant and a policy side by side, through every change of hands."""

import itertools
import math
from dataclasses import dataclass

import numpy as np
import pytest

from tractor_ems import handover as ho
from tractor_ems.answer import Answerer
from tractor_ems.decide import DecideConfig
from tractor_ems.handover import HandoverConfig, Mode
from tractor_ems.policies.protocol import ANY_RUN
from tractor_msgs_py.errors import PolicyError
from tractor_msgs_py.supervisor import Condition
from tractor_msgs_py.types import BatteryPowerCommand, CommandMode, Reason
from tractor_sim.pace import Peers
from tractor_sim.plant_run import prepare_run
from tractor_sim.powertrain import Command
from tractor_sim.real_time import RealTime

CALM = Peers(1, 1, True, 1)


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
