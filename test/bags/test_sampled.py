"""A vehicle's bag through its signal map: the frames are the live ones, and traces follow."""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tractor_ems.bags.any_messages import AnyBag
from tractor_ems.bags.in_process import write_demand_bag
from tractor_ems.bags.rosbags_messages import RosbagsMessages, serialize, typestore
from tractor_ems.bags.sampled import read_sampled, series_of, wire
from tractor_ems.bags.sampled_traces import cycle_of_sampled_bag, iter_sampled_traces
from tractor_ems.bags.transitions import iter_traces
from tractor_ems.bags.write import BagWriter
from tractor_ems.signals.config import load_signal_map
from tractor_ems.signals.vehicle import sampled_spec, values_of, vehicle_run
from tractor_msgs_py.errors import BagError
from tractor_msgs_py.observation import DemandFilter, Observation, ObservationBuilder, SampledTick
from tractor_msgs_py.sampling import LAG_S
from tractor_msgs_py.topics import JOINT_STATE, Topic

GOLDEN = Path(__file__).resolve().parents[2] / "bags"
FLOAT64 = "std_msgs/msg/Float64"
EPOCH_NS = 1_750_000_000_000_000_000
MONOTONIC_NS = 77_000_000_000_000
VEHICLE = load_signal_map("example_vehicle")
SPEC = sampled_spec(
    VEHICLE, 0.1, (DemandFilter("low_pass", 8.0), DemandFilter("running_mean", 60))
)
PERIODS_MS = {
    "hv/bus_voltage": 100,
    "hv/traction_current": 100,
    "hv/implement_current": 100,
    "bms/current": 100,
    "genset/state": 200,
    "genset/fuel_rate": 200,
    "bms/soc_percent": 1000,
}


@dataclass(frozen=True)
class Heard:
    topic: str
    type: str
    message: Any
    publish_ns: int
    received_ns: int


def said(topic: str, stamp_ns: int, rng: np.random.Generator) -> tuple[str, Any]:
    """A plausible message of a topic."""
    if topic == "genset/state":
        power_kw = float(rng.uniform(0.0, 200.0))
        entries = (float(power_kw > 20.0), power_kw)
        made = RosbagsMessages().joint_state(stamp_ns, ("running", "power_kw"), entries)
        return JOINT_STATE, made
    low, high = {"hv/bus_voltage": (600, 700), "bms/soc_percent": (70, 90)}.get(topic, (-50, 200))
    if topic == "genset/fuel_rate":
        low, high = 0, 60
    return FLOAT64, typestore().types[FLOAT64](data=float(rng.uniform(low, high)))


def recording(seed: int, seconds: float, delay_ms: float, faults: float) -> list[Heard]:
    """Every topic at its rate with jitter and delays; a share of faulty messages."""
    rng = np.random.Generator(np.random.PCG64(seed))
    heard: list[Heard] = []
    for topic, period_ms in PERIODS_MS.items():
        phase_ms = rng.uniform(0, period_ms)
        for k in range(int(1000 * seconds / period_ms)):
            jitter_ms = rng.uniform(-0.2, 0.2) * period_ms
            stamp_ns = EPOCH_NS + int(1e6 * (phase_ms + k * period_ms + jitter_ms + 1000))
            received_ns = stamp_ns + int(1e6 * rng.exponential(delay_ms)) + 37
            fault = rng.choice(["zero", "future", "past", "nan", "twice"])
            fault = fault if rng.uniform() < faults else ""
            if fault == "zero":
                stamp_ns = 0
            elif fault == "future":
                stamp_ns += 10_000_000_000
            elif fault == "past":
                stamp_ns -= 100_000_000_000
            kind, message = said(topic, stamp_ns, rng)
            if fault == "nan" and kind == FLOAT64:
                message.data = float("nan")
            for again in range(2 if fault == "twice" else 1):
                heard.append(Heard(topic, kind, message, stamp_ns, received_ns + 1000 * again))
    return sorted(heard, key=lambda h: h.received_ns)


def live(heard: Sequence[Heard], seed: int) -> list[SampledTick]:
    """What a node makes of them that polls whenever its executor lets it."""
    rng = np.random.Generator(np.random.PCG64(seed))
    sources: dict[str, list[Any]] = {}
    for source in VEHICLE.sources:
        sources.setdefault(source.topic, []).append(source)
    builder = ObservationBuilder(SPEC, VEHICLE)
    builder.start_run(vehicle_run(0.1, 0.8, f"vehicle-{seed}"))
    ticks: list[SampledTick] = []
    offset_ns = MONOTONIC_NS - EPOCH_NS
    now_ns = heard[0].received_ns
    for item in heard:
        while rng.uniform() < 0.5:
            now_ns = int(rng.integers(now_ns, item.received_ns + 1))
            ticks += builder.poll(now_ns + offset_ns)
        now_ns = item.received_ns
        for sample in values_of(sources[item.topic], item.message, item.publish_ns):
            ticks += builder.sense(*sample, now_ns + offset_ns)
    return ticks + builder.poll(now_ns + offset_ns + round(LAG_S * 1e9) + 1_000_000)


def record(path: Path, heard: Sequence[Heard], namespace: str = "/tractor1") -> Path:
    names = {f"{namespace}/{h.topic}": Topic(h.topic, h.type) for h in heard}
    with BagWriter(path, names, {}) as bag:
        for h in heard:
            data = serialize(h.message, h.type)
            bag.write(f"{namespace}/{h.topic}", data, h.received_ns, h.publish_ns)
    return path


def known(ticks: Sequence[SampledTick]) -> list[SampledTick]:
    """Ticks at which anything was known: hours of silence are no ticks in a bag."""
    return [tick for tick in ticks if tick.frame.values]


def assert_same(one: Sequence[SampledTick], other: Sequence[SampledTick]) -> None:
    one, other = known(one), known(other)
    assert [t.frame for t in one] == [t.frame for t in other]
    for a, b in zip(one, other, strict=True):
        assert (a.observation is None) == (b.observation is None)
        if a.observation is None or b.observation is None:
            continue
        for column in fields(Observation):
            assert np.array_equal(
                getattr(a.observation, column.name), getattr(b.observation, column.name)
            ), column.name


CASES = {
    "seed": st.integers(0, 2**32),
    "delay_ms": st.sampled_from([0.0, 2.0, 20.0, 80.0]),
    "faults": st.sampled_from([0.0, 0.1, 0.5]),
}


@settings(max_examples=3, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(**CASES)
def test_a_bag_gives_the_frames_and_observations_that_were_live(seed, delay_ms, faults):
    assert_bag_is_live(recording(seed, 3.0, delay_ms, faults), seed, clean=not faults + delay_ms)


@pytest.mark.slow
@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(**CASES)
def test_many_bags_give_the_frames_and_observations_that_were_live(seed, delay_ms, faults):
    assert_bag_is_live(recording(seed, 6.0, delay_ms, faults), seed, clean=not faults + delay_ms)


def assert_bag_is_live(heard: Sequence[Heard], seed: int, clean: bool) -> None:
    with TemporaryDirectory() as folder:
        bag = read_sampled(record(Path(folder) / "bag", heard), VEHICLE, SPEC, soc_target=0.8)
    (run,) = bag.runs
    observed = [t for t in run.ticks if t.observation is not None]
    if clean:
        assert len(observed) > 15
    # The map's target is what counts in a bag; live it is a parameter.
    ticks = live(heard, seed)
    for tick in ticks:
        if tick.observation is not None:
            tick.observation.soc_target[:] = VEHICLE.soc_target
    assert_same(run.ticks, ticks)


def test_a_clean_recording_is_sampled_without_a_refusal(tmp_path):
    bag = read_sampled(record(tmp_path / "bag", recording(1, 4.0, 1.0, 0.0)), VEHICLE, SPEC)
    assert bag.namespace == "/tractor1" and bag.refused_samples == 0 and not bag.complaints
    frames = [tick.frame for tick in bag.runs[0].ticks]
    assert {b.stamp_ns - a.stamp_ns for a, b in pairwise(frames)} == {10**8}
    assert all(frame.stamp_ns % 10**8 == 0 for frame in frames)


@pytest.mark.parametrize(
    "name", ["dp_planter", pytest.param("rule_based_planter", marks=pytest.mark.slow)]
)
def test_the_shipped_map_reads_the_projects_own_bags_as_the_exact_reader_does(name):
    (sampled,) = iter_sampled_traces([GOLDEN / name], load_signal_map(), 1.0, driven=True)
    (exact,) = iter_traces([GOLDEN / name])
    for column in fields(exact):
        if column.name in ("shortfall_j", "dissipated_j"):  # no signals
            continue
        one, other = getattr(sampled, column.name), getattr(exact, column.name)
        assert np.array_equal(one, other) if isinstance(other, np.ndarray) else one == other


def test_a_demand_only_bag_is_read_through_the_shipped_map():
    (trace,) = iter_sampled_traces([GOLDEN / "demand_only"], load_signal_map(), 1.0)
    assert trace.demand_only and len(trace) == 600 and trace.from_start and trace.to_end
    cycle = cycle_of_sampled_bag(GOLDEN / "demand_only", load_signal_map(), 1.0)
    assert np.array_equal(cycle.power_demand_w, trace.power_demand_w)


def test_a_gap_in_the_demand_cuts_the_trace(tmp_path):
    stamps = EPOCH_NS + np.concatenate((np.arange(20), np.arange(50, 80))) * 10**8
    write_demand_bag(tmp_path / "bag", stamps, np.linspace(1e5, 2e5, 50))
    first, second = iter_sampled_traces([tmp_path / "bag"], load_signal_map(), 0.1)
    # Demand is known for its max_age_s of 1.5 s after the last sample.
    assert (len(first), len(second)) == (35, 30)
    assert first.from_start and not second.from_start and second.to_end
    with pytest.raises(BagError, match="2 stretches of demand"):
        cycle_of_sampled_bag(tmp_path / "bag", load_signal_map(), 0.1)


def test_a_missing_topic_or_another_type_is_named(tmp_path):
    heard = recording(1, 2.0, 1.0, 0.0)
    lacking = [h for h in heard if h.topic != "hv/traction_current"]
    with pytest.raises(BagError, match=r"no topic /tractor1/hv/traction_current \(std_msgs"):
        read_sampled(record(tmp_path / "lacking", lacking), VEHICLE, SPEC)
    with pytest.raises(BagError, match="no topic /power_demand "):
        read_sampled(tmp_path / "lacking", load_signal_map(), SPEC)
    other = [
        Heard(h.topic, JOINT_STATE, RosbagsMessages().joint_state(1, (), ()), 1, h.received_ns)
        if h.topic == "bms/current"
        else h
        for h in heard
    ]
    with pytest.raises(BagError, match=r"bms/current is sensor_msgs/msg/JointState.*Float64"):
        read_sampled(record(tmp_path / "other", other), VEHICLE, SPEC)


def test_an_optional_signal_may_be_absent_and_its_column_is(tmp_path):
    heard = [h for h in recording(1, 3.0, 1.0, 0.0) if h.topic != "genset/fuel_rate"]
    path = record(tmp_path / "bag", heard)
    assert read_sampled(path, VEHICLE, SPEC).absent == ("fuel_kg_per_s",)
    (trace,) = iter_sampled_traces([path], VEHICLE, 0.1)
    assert trace.fuel_kg is None and len(trace) > 20


def test_two_tractors_in_one_bag_have_to_be_told_apart(tmp_path):
    heard = recording(1, 2.0, 1.0, 0.0)
    names = {
        f"{space}/{h.topic}": Topic(h.topic, h.type) for h in heard for space in ("/a", "/b/c")
    }
    with BagWriter(tmp_path / "bag", names, {}) as bag:
        for h in heard:
            for space in ("/a", "/b/c"):
                bag.write(
                    f"{space}/{h.topic}", serialize(h.message, h.type), h.received_ns, h.publish_ns
                )
    with pytest.raises(BagError, match="namespaces /a, /b/c, choose one"):
        read_sampled(tmp_path / "bag", VEHICLE, SPEC)
    assert wire(AnyBag(tmp_path / "bag"), VEHICLE, "/b/c").namespace == "/b/c"
    chosen = read_sampled(tmp_path / "bag", VEHICLE, SPEC, namespace="/a")
    assert len(chosen.runs[0].ticks) > 10


def test_soc_in_percent_where_a_fraction_is_mapped_is_refused_with_the_hint(tmp_path):
    path = record(tmp_path / "bag", recording(1, 3.0, 1.0, 0.0))
    wrong = tmp_path / "wrong.yaml"
    text = (GOLDEN.parent / "config" / "signals_example_vehicle.yaml").read_text(encoding="utf-8")
    wrong.write_text(text.replace("scale: 0.01\n", "scale: 1.0\n"), encoding="utf-8")
    with pytest.raises(BagError, match=r"soc: .*looks like percent, which needs scale: 0\.01"):
        iter_sampled_traces([path], load_signal_map(wrong), 0.1)


def test_a_series_keeps_every_value_and_the_product_of_its_sources(tmp_path):
    heard = recording(1, 2.0, 0.0, 0.0)
    series = series_of(record(tmp_path / "bag", heard), VEHICLE, "battery_power_w")
    volts = [h for h in heard if h.topic == "hv/bus_voltage"]
    amps = [h for h in heard if h.topic == "bms/current"]
    started = [v for v in volts if v.received_ns > amps[0].received_ns]
    assert series.stamp_ns.tolist() == [v.publish_ns for v in started]
    for stamp_ns, value, v in zip(series.stamp_ns, series.value, started, strict=True):
        a = [h for h in amps if h.received_ns < v.received_ns][-1]
        assert value == -v.message.data * a.message.data and stamp_ns == v.publish_ns


def test_a_type_that_is_not_standard_is_read_as_the_bag_defines_it(tmp_path):
    from mcap.well_known import MessageEncoding, Profile, SchemaEncoding
    from mcap.writer import Writer
    from rosbags.typesys import get_types_from_msg
    from rosbags.typesys.store import Typestore

    text = "uint8 state\nmy_msgs/Part[] parts\n" + "=" * 80 + "\nMSG: my_msgs/Part\nfloat32 kw\n"
    store = Typestore()
    store.register(get_types_from_msg(text, "my_msgs/msg/Loads"))
    part, loads = store.types["my_msgs/msg/Part"], store.types["my_msgs/msg/Loads"]
    with (tmp_path / "own.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start(profile=Profile.ROS2)
        schema = writer.register_schema("my_msgs/msg/Loads", SchemaEncoding.ROS2, text.encode())
        channel = writer.register_channel("/loads", MessageEncoding.CDR, schema)
        for k in range(30):
            made = loads(state=1, parts=[part(kw=40.0 + k), part(kw=1.5)])
            data = bytes(store.serialize_cdr(made, "my_msgs/msg/Loads"))
            stamp_ns = EPOCH_NS + k * 10**8
            writer.add_message(channel, log_time=stamp_ns, data=data, publish_time=stamp_ns)
        writer.finish()
    own = tmp_path / "own.yaml"
    source = "topic: loads, type: my_msgs/msg/Loads, scale: 1000, stamp: publish"
    own.write_text(
        "vehicle: own\nsignals:\n  power_demand_w:\n    sum:\n"
        f"      - {{{source}, field: 'parts[0].kw'}}\n      - {{{source}, field: 'parts[1].kw'}}\n"
    )
    (trace,) = iter_sampled_traces([tmp_path / "own.mcap"], load_signal_map(own), 0.1)
    assert trace.power_demand_w[:3].tolist() == [41_500.0, 42_500.0, 43_500.0]


def test_a_sqlite3_bag_is_sampled_by_its_log_times(tmp_path):
    from rosbags.rosbag2 import StoragePlugin, Writer

    heard = recording(1, 3.0, 0.0, 0.0)
    with Writer(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        kinds = {h.topic: h.type for h in heard}
        found = {
            topic: writer.add_connection(f"/{topic}", kind, typestore=typestore())
            for topic, kind in kinds.items()
        }
        for h in heard:
            writer.write(found[h.topic], h.received_ns, serialize(h.message, h.type))
    sampled = read_sampled(tmp_path / "bag", VEHICLE, SPEC)
    # Recorded without delay, which MCAP knows and sqlite3 need not.
    again = read_sampled(record(tmp_path / "mcap", heard), VEHICLE, SPEC)
    assert sampled.namespace == "/" and len(known(sampled.runs[0].ticks)) > 20
    one, other = sampled.runs[0].ticks[15].frame, again.runs[0].ticks[15].frame
    assert one.stamp_ns == other.stamp_ns and one.values == pytest.approx(other.values, rel=1e-3)


def test_a_run_that_is_announced_says_what_it_is(tmp_path):
    (trace,) = iter_sampled_traces([GOLDEN / "dp_planter"], load_signal_map(), 0.5)
    (exact,) = iter_traces([GOLDEN / "dp_planter"])
    assert trace.dt_s == 0.5 and len(trace) == pytest.approx(2 * len(exact), abs=2)
    for name in ("soc_target", "p_aux_w", "cycle", "cycle_hash", "powertrain_hash", "policy"):
        assert getattr(trace, name) == getattr(exact, name)
