"""A frame is made of what was stamped up to its tick, whoever was heard first."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tractor_msgs_py.errors import BagError, ConfigError, PolicyError
from tractor_msgs_py.observation import (
    SAMPLED_SIGNALS,
    DemandFilter,
    ObservationBuilder,
    ObservationSpec,
)
from tractor_msgs_py.sampling import MAX_BUFFERED, Sampler, Sampling
from tractor_msgs_py.signals import (
    MappedSignal,
    SignalMap,
    Source,
    parse_path,
    range_complaint,
    read_field,
)
from tractor_msgs_py.stamp_clock import CONVINCED_AFTER, StampClock
from tractor_msgs_py.types import RunInfo

MS = 1_000_000
DT_NS = 100 * MS
FLOAT64 = "std_msgs/msg/Float64"
VOLTAGE, CURRENT = Source("volt", FLOAT64, "data"), Source("amp", FLOAT64, "data")
SOC = Source("soc", FLOAT64, "data", scale=0.01)
ENGINE = Source("engine", FLOAT64, "data", scale=1000.0)
DEMAND = MappedSignal("power_demand_w", ((VOLTAGE, CURRENT),))
SIGNALS = SignalMap(
    "test", (DEMAND, MappedSignal("soc", ((SOC,),)), MappedSignal("engine_power_w", ((ENGINE,),)))
)
SPEC = ObservationSpec(
    SAMPLED_SIGNALS, 0.1, (DemandFilter("low_pass", 0.5),), "sampled", (), lag_s=0.02
)
RUN = RunInfo("r", "c", "h", "p", "h", DT_NS, 0.1, 1000, 0.0, 0.8, 0.7, lockstep=False)


def sampler(*signals, how="last", max_age_s=10.0, lag_ns=0):
    ways = [Sampling(signal.name, how, max_age_s) for signal in signals]
    return Sampler(signals, ways, DT_NS, lag_ns)


def feed(made, source, pairs):
    for stamp_ms, value in pairs:
        made.add(source, stamp_ms * MS, value, stamp_ms * MS)


def one(source):
    return MappedSignal("power_demand_w", ((source,),))


def test_last_is_the_newest_value_up_to_the_tick():
    made = sampler(one(VOLTAGE))
    feed(made, VOLTAGE, [(100, 1.0), (190, 2.0), (200, 3.0), (201, 4.0)])
    frames = made.due(301 * MS)
    assert [frame.stamp_ns for frame in frames] == [100 * MS, 200 * MS, 300 * MS]
    assert [frame.values["power_demand_w"] for frame in frames] == [1.0, 3.0, 4.0]


def test_mean_holds_each_value_until_the_next_and_so_keeps_the_energy():
    made = sampler(one(VOLTAGE), how="mean")
    feed(made, VOLTAGE, [(100, 1.0), (125, 5.0), (200, 7.0), (290, 9.0)])
    frames = made.due(301 * MS)
    means = [frame.values["power_demand_w"] for frame in frames]
    assert means == pytest.approx([1.0, (25 * 1 + 75 * 5) / 100, (90 * 7 + 10 * 9) / 100])


def test_a_product_takes_both_factors_as_they_were_at_each_moment():
    made = sampler(DEMAND, how="mean")
    feed(made, VOLTAGE, [(100, 600.0), (150, 500.0)])
    feed(made, CURRENT, [(100, 10.0), (175, 20.0)])
    frames = made.due(201 * MS)
    assert frames[-1].values["power_demand_w"] == pytest.approx(
        (50 * 6000 + 25 * 5000 + 25 * 10000) / 100
    )


def test_a_sum_adds_terms_with_scale_and_offset():
    both = MappedSignal(
        "power_demand_w", ((Source("a", FLOAT64, "data", -2.0, 1.0),), (VOLTAGE, CURRENT))
    )
    made = sampler(both)
    feed(made, both.sources[0], [(100, both.sources[0].value(type("M", (), {"data": 3.0})))])
    feed(made, VOLTAGE, [(100, 4.0)])
    feed(made, CURRENT, [(100, 5.0)])
    assert made.due(100 * MS)[0].values["power_demand_w"] == (-2.0 * 3.0 + 1.0) + 20.0


def test_a_value_older_than_its_own_limit_is_missing_and_comes_back():
    made = sampler(one(VOLTAGE), max_age_s=0.25)
    feed(made, VOLTAGE, [(100, 1.0)])
    assert [dict(frame.missing) for frame in made.due(401 * MS)] == [
        {},
        {},
        {},
        {"power_demand_w": "stale"},
    ]
    feed(made, VOLTAGE, [(450, 2.0)])
    assert made.due(501 * MS)[0].values == {"power_demand_w": 2.0}


def test_a_tick_waits_for_its_lag_unless_everything_is_there():
    made = sampler(one(VOLTAGE), one_more := MappedSignal("soc", ((SOC,),)), lag_ns=20 * MS)
    feed(made, VOLTAGE, [(100, 1.0)])
    assert made.due(110 * MS) == []
    made.add(SOC, 100 * MS, 0.5, 110 * MS)
    assert [frame.stamp_ns for frame in made.due(110 * MS)] == [100 * MS]
    assert made.due(219 * MS) == []
    frame = made.due(221 * MS)[0]
    assert frame.values["power_demand_w"] == 1.0 and one_more.name in frame.values


def test_hours_of_silence_cost_one_count_and_no_frames():
    made = sampler(one(VOLTAGE), max_age_s=0.5)
    feed(made, VOLTAGE, [(100, 1.0)])
    frames = made.due(100 * MS + 3600 * 10**9)
    assert len(frames) < 20
    assert made.refusals["silent_ticks"] > 35_000


def test_a_flood_is_bounded_and_the_newest_value_counts():
    made = sampler(one(VOLTAGE))
    for k in range(5 * MAX_BUFFERED):
        made.add(VOLTAGE, 10**9 + k * 1000, float(k), 10**9 + k * 1000)
        made.due(10**9 + k * 1000)
    assert made.due(2 * 10**9)[-1].values["power_demand_w"] == 5 * MAX_BUFFERED - 1
    assert max(len(track.values) for track in made._tracks.values()) <= 2 * MAX_BUFFERED


@pytest.mark.parametrize(
    ("stamp_ms", "value", "reason"),
    [
        (0, 1.0, "zero_stamp"),
        (100, 1.0, "repeated"),
        (50, 1.0, "out_of_order"),
        (150, math.nan, "not_finite"),
        (150, math.inf, "not_finite"),
        (100_000, 1.0, "future"),
    ],
)
def test_a_bad_sample_is_refused_by_reason_and_changes_nothing(stamp_ms, value, reason):
    made = sampler(one(VOLTAGE))
    feed(made, VOLTAGE, [(100, 7.0)])
    made.add(VOLTAGE, stamp_ms * MS, value, 110 * MS)
    assert made.refusals == {reason: 1}
    assert [frame.values["power_demand_w"] for frame in made.due(201 * MS)] == [7.0, 7.0]


THREE = {"power_demand_w": VOLTAGE, "battery_power_w": CURRENT, "soc": SOC}


def test_one_wrong_stamp_does_not_set_the_clock_and_a_clock_that_was_set_is_believed():
    clock = StampClock()
    assert clock.judge(10**12, 0) is None
    assert clock.judge(10**15, 1) == "future"
    assert clock.now_ns(10**9) == pytest.approx(10**12 + 10**9, abs=1e6)
    verdicts = [clock.judge(10**15 + k * MS, k * MS) for k in range(CONVINCED_AFTER - 1)]
    assert verdicts[-1] is None and set(verdicts[:-1]) == {"future"}
    assert clock.jumps == 1


def test_a_slow_topic_that_is_heard_first_does_not_blind_the_others():
    made = sampler(one(VOLTAGE), MappedSignal("soc", ((SOC,),)))
    frames = []
    for k in range(100):
        heard_ns = 10**12 + k * DT_NS
        if k % 10 == 0:
            made.add(SOC, heard_ns - 10**9, 0.5, heard_ns)
        made.add(VOLTAGE, heard_ns, 1.0, heard_ns)
        frames += made.due(heard_ns)
    assert made.refusals["future"] < CONVINCED_AFTER
    assert sum(len(frame.values) == 2 for frame in frames[-70:]) == 70


def test_one_topic_from_the_future_does_not_outvote_the_rest_by_flooding():
    made = sampler(*(MappedSignal(name, ((source,),)) for name, source in THREE.items()))
    frames = []
    for k in range(100):
        heard_ns = 10**12 + k * DT_NS
        made.add(VOLTAGE, heard_ns, 1.0, heard_ns)
        made.add(CURRENT, heard_ns, 1.0, heard_ns)
        for j in range(100):
            made.add(SOC, heard_ns + 3600 * 10**9 + j * MS, 0.5, heard_ns + j * MS)
        frames += made.due(heard_ns)
    assert made.clock.jumps == 0
    assert all(frame.missing == {"soc": "absent"} for frame in frames)


def test_the_clock_follows_the_least_delayed_sample():
    clock = StampClock()
    for k in range(100):
        delay_ns = (k * 37 % 50) * MS
        assert clock.judge(k * DT_NS + 5 * 10**12, k * DT_NS + delay_ns) is None
    assert clock.now_ns(100 * DT_NS) == pytest.approx(100 * DT_NS + 5 * 10**12, abs=MS)


arrivals = st.tuples(*[st.integers(0, 15 * MS)] * 4)


def observed(delays_ns, polls, seed):
    """What a builder sees of topics at 10, 5 and 1 Hz when each topic is late by its own delay,
    so that they overtake each other, and polls come whenever."""
    rng = np.random.default_rng(seed)
    events = []
    for source, every_ms, size in ((VOLTAGE, 100, 600.0), (CURRENT, 100, 90.0), (ENGINE, 200, 40)):
        for k in range(20 if every_ms == 100 else 10):
            stamp_ns = 10**9 + k * every_ms * MS + int(rng.integers(0, 30 * MS))
            events.append((stamp_ns, source, size * float(rng.uniform(0.9, 1.1))))
    events += [(10**9 + k * 1000 * MS, SOC, 55.0 - k) for k in range(3)]
    late = [
        (stamp_ns + delays_ns[SIGNALS.sources.index(source)], stamp_ns, source, value)
        for stamp_ns, source, value in events
    ]
    heard: dict[Source, int] = {}
    built = ObservationBuilder(SPEC, SIGNALS)
    built.start_run(RUN)
    ticks = []
    times = sorted(
        [(received, 0, event) for event in late for received in [event[0]]]
        + [(at, 1, None) for at in polls],
        key=lambda item: item[:2],
    )
    for received_ns, _, event in times:
        if event is None:
            ticks += built.poll(received_ns)
            continue
        _, stamp_ns, source, value = event
        if stamp_ns <= heard.get(source, 0):
            continue  # within a topic the transport keeps the order
        heard[source] = stamp_ns
        ticks += built.sense(source, stamp_ns, source.scale * value, received_ns)
    return ticks + built.poll(times[-1][0] + 20 * MS)


@settings(max_examples=25, deadline=None)
@given(delays_ns=arrivals, polls=st.lists(st.integers(10**9, 3 * 10**9), max_size=40))
def test_frames_do_not_depend_on_who_was_heard_first_nor_on_when_they_are_asked_for(
    delays_ns, polls
):
    plain = observed((0, 0, 0, 0), [], 1)
    disturbed = observed(delays_ns, polls, 1)
    both = {t.frame.stamp_ns: t for t in plain}
    shared = [t for t in disturbed if t.frame.stamp_ns in both]
    assert len(shared) >= 15
    for tick in shared:
        other = both[tick.frame.stamp_ns]
        assert tick.frame.missing == other.frame.missing
        assert tick.frame.values == other.frame.values


def test_observations_carry_units_filters_and_engine_state():
    ticks = observed((0, 0, 0, 0), [], 3)
    seen = [tick.observation for tick in ticks if tick.observation is not None]
    assert len(seen) >= 15
    assert all(0.529 < o.soc[0] < 0.551 for o in seen)
    assert all(45e3 < o.power_demand_w[0] < 65e3 for o in seen)
    assert all(o.engine_on[0] and 30e3 < o.engine_power_w[0] < 50e3 for o in seen)
    assert all(math.isinf(o.charge_limit_w[0]) for o in seen)
    assert seen[-1].time_in_state_s[0] == pytest.approx(
        (seen[-1].stamp_ns - seen[0].stamp_ns) * 1e-9
    )
    assert seen[0].features[0, 0] == seen[0].power_demand_w[0]


def test_soc_in_percent_is_no_observation_and_the_complaint_gives_the_hint():
    wrong = Source("soc", FLOAT64, "data")
    signals = SignalMap("v", (one(VOLTAGE), MappedSignal("soc", ((wrong,),)), SIGNALS.signals[2]))
    built = ObservationBuilder(SPEC, signals)
    built.start_run(RUN)
    ticks = []
    for source, value in ((VOLTAGE, 1.0), (wrong, 55.0), (ENGINE, 0.0)):
        ticks += built.sense(source, 100 * MS, value, 0)
    assert [tick.observation for tick in ticks] == [None]
    assert "scale: 0.01" in built.complaints["soc"]
    assert built.refusals["implausible_soc"] == 1


def test_a_new_run_forgets_samples_filters_and_engine_history():
    built = ObservationBuilder(SPEC, SIGNALS)
    built.start_run(RUN)
    for source, value in ((VOLTAGE, 1e3), (CURRENT, 1.0), (SOC, 0.5), (ENGINE, 5e3)):
        built.sense(source, 100 * MS, value, 0)
    built.start_run(RunInfo("other", "c", "h", "p", "h", 10**9, 0.1, 9, 0.0, 0.8, 0.8, False))
    tick = built.sense(VOLTAGE, 10**9, 1e3, 5)
    assert tick == []  # nothing else is known any more
    late = built.poll(10**9)
    assert all(t.observation is None for t in late)


def test_a_map_without_a_needed_signal_is_refused_by_name():
    with pytest.raises(PolicyError, match="needs signal soc"):
        ObservationBuilder(SPEC, SignalMap("v", (DEMAND, SIGNALS.signals[2])))


def test_engine_power_follows_from_the_bus_balance():
    battery = MappedSignal("battery_power_w", ((ENGINE,),))
    built = ObservationBuilder(SPEC, SignalMap("v", (one(VOLTAGE), SIGNALS.signals[1], battery)))
    built.start_run(RUN)
    ticks = []
    for source, value in ((VOLTAGE, 50e3), (SOC, 0.5), (ENGINE, 20e3)):
        ticks += built.sense(source, 100 * MS, value, 0)
    (observation,) = [tick.observation for tick in ticks]
    assert observation is not None and observation.engine_power_w[0] == 30e3


def test_what_is_per_step_becomes_a_rate_by_the_step_of_the_announced_run():
    fuel = Source("fuel", FLOAT64, "data", per_step=True)
    signals = SignalMap("v", (*SIGNALS.signals, MappedSignal("fuel_kg_per_s", ((fuel,),))))
    built = ObservationBuilder(SPEC, signals)
    built.start_run(RUN)
    ticks = []
    for source, value in ((VOLTAGE, 1.0), (CURRENT, 1.0), (SOC, 0.5), (ENGINE, 0.0), (fuel, 2e-3)):
        ticks += built.sense(source, 100 * MS, value, 0)
    assert ticks[0].frame.values["fuel_kg_per_s"] == pytest.approx(2e-3 / RUN.dt_s)


def test_a_sampled_spec_survives_a_policy_file():
    spec = ObservationSpec(
        SAMPLED_SIGNALS, 0.1, (), "sampled", (Sampling("soc", "mean", 3.0),), lag_s=0.01
    )
    assert ObservationSpec.from_json(spec.to_json()) == spec
    assert "sampling" not in ObservationSpec().to_json()


class Message:
    """Fields as rclpy and rosbags both have them."""

    class Header:
        seq = 4

    header = Header()
    data = 2.5
    flag = True
    text = "no"
    name = ("left", "right")
    effort = (1.0, 2.0)


@pytest.mark.parametrize(
    ("path", "value"),
    [
        ("data", 2.5),
        ("flag", 1.0),
        ("header.seq", 4.0),
        ("effort[1]", 2.0),
        ("effort[left]", 1.0),
    ],
)
def test_a_field_path_finds_its_number(path, value):
    assert read_field(Message(), path) == value


@pytest.mark.parametrize(
    "path", ["nothing", "text", "effort", "effort[2]", "effort[middle]", "header", "data[0]"]
)
def test_a_path_to_no_number_is_refused(path):
    with pytest.raises(BagError, match="field"):
        read_field(Message(), path)


@pytest.mark.parametrize("path", ["", ".", "a.", "a..b", "a[", "a[]", "1a", "__class__", "a b"])
def test_what_is_no_path_is_refused(path):
    with pytest.raises(ConfigError, match="field"):
        parse_path(path)


def test_a_complaint_names_signal_value_and_range():
    assert range_complaint("soc", 0.5) is None
    assert range_complaint("soc", 120.0) == "soc: 120, allowed 0..1"
    assert "finite" in (range_complaint("power_demand_w", math.nan) or "")
