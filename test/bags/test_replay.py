"""What a player publishes, when, and how it accounts for it: without ROS and without waiting."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tractor_ems.bags.in_process import write_demand_bag, write_samples_bag
from tractor_ems.bags.replay import demand_of, mapped_demand_of, without_auxiliaries
from tractor_ems.bags.replay_demand import LEAD_S, RESEND_S, DemandReplay
from tractor_ems.bags.replay_schedule import Answered, Timed, lockstep_run
from tractor_ems.bags.replay_topics import Choice, RawMessage, messages_of, recorded_topics
from tractor_ems.bags.rosbags_messages import RosbagsMessages, serialize
from tractor_ems.signals.config import load_signal_map
from tractor_msgs_py import topics
from tractor_msgs_py.codec import encode
from tractor_msgs_py.errors import BagError, ConfigError, RunAborted
from tractor_msgs_py.types import (
    BatteryPowerCommand,
    CommandMode,
    DutyCycleInfo,
    PowerDemand,
    RunInfo,
)
from tractor_sim.duty_cycle.cycle import DutyCycle, cycle_hash
from tractor_sim.duty_cycle.library import load_cycle

POWER_W = np.array([60e3, 150e3, 200e3, 90e3, 20e3])
INFO = DutyCycleInfo("one", "short", "0" * 64, 10**12, 1.0, len(POWER_W))
AUX_W = 4000.0
RUN = RunInfo("r", "short", "0" * 64, "p", "1" * 64, 10**12, 1.0, 5, AUX_W, 0.8, 0.8)
SECOND_NS = 10**9


# --- which demand -----------------------------------------------------------------------------


def test_the_demand_of_a_recorded_run_is_its_cycle_to_the_last_bit(bag, driven):
    trace = demand_of(bag)
    assert cycle_hash(trace.cycle) == driven.info.cycle_hash
    assert trace.cycle.name == "part" and trace.aux_w == driven.info.p_aux_w


def test_the_demand_of_a_vehicle_is_read_through_its_map():
    bag = Path(__file__).parents[2] / "bags" / "vehicle_planter"
    trace = mapped_demand_of(bag, load_signal_map("example_vehicle"), 0.1)
    driven_w = load_cycle("planter_21").power_demand_w[100:160]
    assert trace.cycle.dt_s == 0.1 and abs(len(trace.cycle) - 600) < 10
    assert np.mean(trace.cycle.power_demand_w) == pytest.approx(np.mean(driven_w), rel=0.02)


@pytest.mark.parametrize("aux_w", [4000.0, 0.1, 1234.567])
def test_the_plant_adds_up_to_what_was_recorded_whatever_the_rounding(aux_w):
    rng = np.random.default_rng(np.random.PCG64(1))
    cycle_w = rng.normal(80e3, 60e3, 500)
    cycle = DutyCycle("unlisted", cycle_w, 1.0, "test")
    announced = replace(RUN, cycle="unlisted", cycle_hash=cycle_hash(cycle), p_aux_w=aux_w)
    recorded_w = cycle_w + aux_w
    assert np.array_equal(without_auxiliaries(recorded_w, announced) + aux_w, recorded_w)


def test_whole_watts_are_found_again_under_auxiliaries_that_are_none():
    cycle = DutyCycle("unlisted", np.arange(-50.0, 450.0), 1.0, "test")
    announced = replace(RUN, cycle="unlisted", cycle_hash=cycle_hash(cycle), p_aux_w=0.1)
    found_w = without_auxiliaries(cycle.power_demand_w + 0.1, announced)
    assert cycle_hash(replace(cycle, power_demand_w=found_w)) == announced.cycle_hash


def demand_bag(path, power_w, stamps=None):
    stamps = np.arange(1, len(power_w) + 1) if stamps is None else np.array(stamps)
    write_demand_bag(path, stamps * SECOND_NS, np.array(power_w))
    return path


def test_auxiliaries_are_given_for_a_bag_that_announces_none_and_refused_for_one_that_does(
    bag, tmp_path
):
    bare = demand_bag(tmp_path / "bare", [10e3, 20e3, 30e3])
    assert demand_of(bare).cycle.power_demand_w.tolist() == [10e3, 20e3, 30e3]
    assert demand_of(bare, aux_w=4e3).cycle.power_demand_w.tolist() == [6e3, 16e3, 26e3]
    with pytest.raises(ConfigError, match=r"aux_w: 4000, but .* announces auxiliaries of 0 W"):
        demand_of(bag, aux_w=4e3)
    with pytest.raises(ConfigError, match=r"aux_w: -0.5, allowed 0..2e\+06, or -1"):
        demand_of(bare, aux_w=-0.5)


@pytest.mark.parametrize(("bad", "position"), [(math.nan, 0), (-math.inf, 1), (2e9, 3)])
def test_demand_that_is_no_power_is_refused_wherever_it_stands(tmp_path, bad, position):
    power_w = [10e3] * 4
    power_w[position] = bad
    with pytest.raises(
        BagError, match=rf"power_demand is .* W in message {position + 1}, allowed"
    ):
        demand_of(demand_bag(tmp_path / "bad", power_w))


def test_a_gap_in_the_demand_is_refused(tmp_path):
    path = demand_bag(tmp_path / "gap", [10e3] * 5, [1, 2, 7, 8, 9])
    with pytest.raises(BagError, match="2 stretches of power_demand, a replay needs exactly one"):
        demand_of(path)


def test_of_several_runs_one_must_be_named(driven, tmp_path):
    second = [
        replace(sample, run_id="second") if isinstance(sample, RunInfo) else sample
        for sample in driven.samples
    ]
    write_samples_bag(tmp_path / "two", [*driven.samples, *second], {})
    with pytest.raises(BagError, match=r"2 runs, parameter run says which: 1..2"):
        demand_of(tmp_path / "two")
    with pytest.raises(BagError, match=r"no run 3, allowed 1..2"):
        demand_of(tmp_path / "two", run=3)
    assert cycle_hash(demand_of(tmp_path / "two", run=2).cycle) == driven.info.cycle_hash


def test_a_cut_keeps_the_steps_that_begin_in_it(tmp_path):
    trace = demand_of(demand_bag(tmp_path / "bag", POWER_W.tolist()))
    assert trace.cut(0.0, 0.0) is trace
    part = trace.cut(1.5, 2.0).cycle
    assert part.power_demand_w.tolist() == POWER_W[2:4].tolist() and part.name == "bag[2:4]"
    assert len(trace.cut(1.0, 100.0).cycle) == 4
    with pytest.raises(ConfigError, match=r"start_s, duration_s: 5, 0, no step begins there"):
        trace.cut(5.0, 0.0)


# --- demand on time ---------------------------------------------------------------------------


def replay(period_s=0.0, **settings) -> DemandReplay:
    found = DemandReplay(INFO, POWER_W, period_s, **settings)
    found.begin(RUN)
    return found


def tick(k, power_w=None) -> PowerDemand:
    return PowerDemand(INFO.stamp_ns(k), POWER_W[k] + AUX_W if power_w is None else power_w)


def steps(demands) -> list[int]:
    return [(demand.stamp_ns - INFO.t0_ns) // INFO.dt_ns for demand in demands]


def test_in_lockstep_each_step_follows_the_tick_before_and_is_repeated_until_it_is_driven():
    player = replay()
    assert player.poll(0, 0.0) == (), "nobody listens"
    assert steps(player.poll(1, 1.0)) == [0]
    assert player.poll(1, 1.1) == ()
    assert steps(player.poll(1, 1.01 + RESEND_S)) == [0]
    for k in range(len(POWER_W) - 1):
        now_s = 2.0 + k
        player.observe(tick(k), now_s)
        assert steps(player.poll(1, now_s)) == [k + 1]
        assert player.poll(1, now_s + 0.1) == ()
    assert steps(player.poll(1, now_s + 0.01 + RESEND_S)) == [4]
    assert not player.done
    player.observe(tick(4), 7.0)
    assert player.done and player.poll(1, 8.0) == ()
    counters = player.counters
    assert counters["published"] == counters["driven"] == 5 and counters["resent"] == 2
    assert counters["driven_old"] == counters["not_driven"] == counters["late"] == 0


def test_a_real_time_schedule_leads_its_ticks_and_never_drifts():
    steps_count = 20_000
    info = replace(INFO, steps=steps_count)
    player = DemandReplay(info, np.zeros(steps_count), period_s=0.1)
    player.begin(replace(RUN, steps=steps_count, lockstep=False))
    player.poll(1, 0.0)
    player.observe(PowerDemand(info.stamp_ns(0), AUX_W), 50.0)
    k = steps_count // 2
    due_s = 50.0 + k * 0.1 - LEAD_S
    assert len(player.poll(1, 50.0)) == 2, "steps 1 and 2 are within the lead"
    for j in range(3, k):  # each poll is late by most of a period; the schedule does not move
        assert len(player.poll(1, 50.0 + j * 0.1 - LEAD_S + 0.09)) == 1
        player.observe(PowerDemand(info.stamp_ns(j), AUX_W), 50.0 + j * 0.1)
    assert player.poll(1, due_s - 1e-3) == ()
    assert len(player.poll(1, due_s + 1e-3)) == 1
    assert player.late == 0 and player.worst_late_s == pytest.approx(0.09)


def test_what_is_published_behind_schedule_is_counted_with_the_worst():
    player = replay(1.0)
    player.poll(1, 0.0)
    player.observe(tick(0), 0.0)
    assert steps(player.poll(1, 3.0)) == [1, 2, 3]
    assert player.late == 2, "steps 1 and 2 were due at 0.5 and 1.5, step 3 half a period ago"
    assert player.worst_late_s == pytest.approx(2.5)


def test_ticks_with_an_old_demand_and_demands_without_a_tick_are_told_apart():
    player = replay(1.0)
    player.poll(1, 0.0)
    player.observe(tick(0), 0.0)
    player.observe(tick(1, POWER_W[0] + AUX_W), 1.0)
    player.observe(tick(1), 1.0)  # a repetition says nothing new
    player.poll(1, 4.6)
    player.observe(tick(4), 4.6)
    counters = player.counters
    assert player.done
    assert (counters["driven"], counters["driven_old"], counters["not_driven"]) == (2, 1, 2)


def test_a_plant_that_is_started_again_gets_the_cycle_from_its_beginning():
    player = replay()
    player.poll(1, 0.0)
    player.observe(tick(0), 0.0)
    player.observe(tick(1), 1.0)
    player.begin(replace(RUN, run_id="again"))
    assert steps(player.poll(1, 2.0)) == [0] and player.restarts == 1
    player.begin(replace(RUN, run_id="stranger", cycle_hash="f" * 64))
    player.observe(tick(0), 2.0)
    assert steps(player.poll(1, 2.0)) == [1] and player.restarts == 1


def test_a_plant_that_never_comes_or_falls_silent_ends_the_replay():
    alone = replay(match_timeout_s=3.0)
    alone.poll(0, 0.0)
    with pytest.raises(RunAborted, match=r"no subscriber of duty_cycle_demand within 3 s"):
        alone.poll(0, 3.1)
    player = replay(plant_timeout_s=5.0)
    player.poll(1, 0.0)
    player.poll(1, 100.0)  # it may wait for its policy
    player.observe(tick(0), 100.0)
    player.poll(1, 106.0)
    with pytest.raises(RunAborted, match=r"no tick 1 of 5 .* within 6 s, 0 subscribers of"):
        player.poll(0, 106.1)


# --- topics on time ---------------------------------------------------------------------------


def raw(topic, at_s, data=b"x") -> RawMessage:
    return RawMessage(at_s, topic, data)


def test_topics_keep_their_times_at_any_rate_and_late_ones_are_counted():
    messages = [raw("/a", 0.0), raw("/b", 1.0), raw("/a", 2.0), raw("/a", 4.0)]
    schedule = Timed(iter(messages), rate=2.0, interval_s={"/a": 2.0, "/b": 0.0})
    assert schedule.poll(10.0) == messages[:1]
    assert schedule.wait_s(10.1) == pytest.approx(0.4)
    assert schedule.poll(10.49) == []
    assert schedule.poll(10.5) == messages[1:2]
    assert schedule.poll(14.0) == messages[2:]
    assert schedule.done and schedule.published == {"/a": 3, "/b": 1}
    assert schedule.late == 2 and schedule.worst_late_s == pytest.approx(3.0)


def wire(sample, base="") -> RawMessage:
    topic, message = encode(sample, RosbagsMessages())
    return RawMessage(0.0, f"{base}/{topic.name}", serialize(message, topic.type))


def test_topics_in_lockstep_wait_for_the_answer_to_each_demand_and_repeat_the_tick():
    ticks = [[wire(PowerDemand((k + 1) * SECOND_NS, 1e3)), raw("/other", 0.0)] for k in range(3)]
    flat = [message for messages in ticks for message in messages]
    flat.append(ticks[2][0])  # a plant repeats its last demand
    schedule = Answered(iter(flat), "/", timeout_s=5.0)
    assert schedule.poll(0.0) == ticks[0]
    assert schedule.poll(0.1) == []
    assert schedule.poll(RESEND_S) == ticks[0][:1], "what is of no tick is not repeated"
    for mode, stamp_ns in ((CommandMode.FALLBACK, 1), (CommandMode.NOMINAL, 2)):
        schedule.answer(BatteryPowerCommand(stamp_ns * SECOND_NS, 0.0, mode=mode))
        assert schedule.poll(0.3) == []
    schedule.answer(BatteryPowerCommand(SECOND_NS, 0.0))
    assert schedule.poll(0.4) == ticks[1]
    schedule.answer(BatteryPowerCommand(2 * SECOND_NS, 0.0))
    assert schedule.poll(0.5) == [*ticks[2], ticks[2][0]]
    assert not schedule.done
    schedule.answer(BatteryPowerCommand(3 * SECOND_NS, 0.0))
    assert schedule.done and (schedule.answered, schedule.resent) == (3, 1)


def test_topics_in_lockstep_end_without_an_answer():
    schedule = Answered(iter([wire(PowerDemand(SECOND_NS, 1e3), "/t")]), "/t", timeout_s=5.0)
    assert schedule.poll(1.0)
    with pytest.raises(RunAborted, match=r"no answer to /t/power_demand stamped .* within 5 s"):
        schedule.poll(6.1)


def test_lockstep_is_refused_for_a_bag_without_runs(bag, tmp_path):
    assert lockstep_run(bag) == ("/", 0)
    with pytest.raises(BagError, match="demand alone; lockstep needs a recording of one tractor"):
        lockstep_run(demand_bag(tmp_path / "bare", [1e3, 2e3]))


# --- topics of a bag --------------------------------------------------------------------------


def test_a_bag_is_cut_and_what_was_latched_before_comes_first(bag, driven):
    found = recorded_topics(bag, Choice())
    assert {topic.name for topic in found} == {f"/{topic.name}" for topic in topics.RECORDED}
    by_name = {topic.name: topic for topic in found}
    assert by_name["/run_info"].qos == topics.RUN_INFO.qos
    assert by_name["/power_demand"].interval_s == pytest.approx(1.0, rel=0.05)
    choice = Choice(start_s=10.0, duration_s=5.0)
    messages = list(messages_of(bag, choice, list(by_name)))
    assert [m.topic for m in messages].count("/run_info") == 1
    assert messages[0].topic == "/run_info" and messages[0].at_s == 0.0
    demands = [m for m in messages if m.topic == "/power_demand"]
    assert [m.at_s for m in demands] == pytest.approx([0.0, 1.0, 2.0, 3.0, 4.0])
    expected = [s for s in driven.samples if isinstance(s, PowerDemand)][10:15]
    assert [m.data for m in demands] == [wire(sample).data for sample in expected]


@pytest.mark.parametrize(
    ("choice", "said"),
    [
        (Choice(topics=["/powre_demand"]), r"parameter topics: '/powre_demand' is not in"),
        (Choice(exclude=["none"]), r"parameter exclude: 'none' is not in"),
        (Choice(start_s=1e6), r"parameter start_s: 1e\+06, allowed 0..60 of"),
        (Choice(topics=["run_info"], exclude=["/run_info"]), "nothing of .* is left to publish"),
    ],
)
def test_a_choice_that_leaves_nothing_is_refused(bag, choice, said):
    with pytest.raises(ConfigError, match=said):
        recorded_topics(bag, choice)
