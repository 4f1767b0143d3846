"""Signal maps in YAML: what they say, and one line for what is wrong with them."""

from pathlib import Path

import pytest

from tractor_ems.bags.rosbags_messages import has_header
from tractor_ems.signals.config import load_signal_map, optional_map
from tractor_ems.signals.vehicle import sampled_spec, values_of, vehicle_run
from tractor_msgs_py.errors import ConfigError
from tractor_msgs_py.observation import ObservationBuilder
from tractor_msgs_py.sampling import Sampler
from tractor_msgs_py.signals import SIGNALS, Source

FLOAT = "type: std_msgs/msg/Float64, field: data"


def written(path: Path, signals: str, head: str = "vehicle: mine\n") -> Path:
    path.write_text(f"{head}signals:\n{signals}", encoding="utf-8")
    return path


@pytest.fixture
def load(tmp_path):
    return lambda signals, head="vehicle: mine\n": load_signal_map(
        written(tmp_path / "map.yaml", signals, head)
    )


def test_the_shipped_map_supplies_every_signal():
    signals = load_signal_map()
    assert signals.names == tuple(SIGNALS)
    ObservationBuilder(sampled_spec(signals, 0.1), signals)
    assert optional_map("") is None and optional_map("signals") == signals


def test_the_example_vehicle_drives_a_policy_too():
    signals = load_signal_map("example_vehicle")
    ObservationBuilder(sampled_spec(signals, 0.1), signals)
    assert signals == load_signal_map("signals_example_vehicle")


def test_scale_offset_and_sign_make_si(load):
    (signal,) = load(
        f"  power_demand_w: {{topic: p, {FLOAT}, scale: 1000, offset: 50, sign: -1}}"
    ).signals
    (source,) = signal.sources
    message = type("Float64", (), {"data": 2.0})()
    assert source.value(message) == -2000.0 + 50.0


def test_factors_of_sums_and_products_reach_every_term(load):
    (signal,) = load(
        f"""
  battery_power_w:
    sign: -1
    sum:
      - product: [{{topic: u, {FLOAT}}}, {{topic: i, {FLOAT}, offset: 1}}]
        scale: 2
      - {{topic: p, {FLOAT}, offset: 3}}
"""
    ).signals
    assert [[(s.topic, s.scale, s.offset) for s in term] for term in signal.terms] == [
        [("u", -2.0, 0.0), ("i", 1.0, 1.0)],
        [("p", -1.0, -3.0)],
    ]


def test_a_stamp_is_the_headers_where_there_is_one():
    assert [has_header(t) for t in ("sensor_msgs/msg/BatteryState", "std_msgs/msg/Float64")] == [
        True,
        False,
    ]
    own = {source.topic: source.stamp for source in load_signal_map("example_vehicle").sources}
    assert own["genset/state"] == "header" and own["hv/bus_voltage"] == "publish"


def test_the_maps_word_on_sampling_is_the_last(load):
    signals = load(f"  soc: {{topic: s, {FLOAT}, how: mean, max_age_s: 7}}").signals
    ((_, way),) = Sampler(signals, (), 10**8)._signals
    assert (way.how, way.max_age_s) == ("mean", 7.0)


@pytest.mark.parametrize(
    ("signals", "says"),
    [
        (f"  soc: {{topic: s, {FLOAT}, sclae: 1}}", "signals.soc.sclae"),
        (f"  speed: {{topic: s, {FLOAT}}}", "signals.speed: unknown signal, allowed power_dem"),
        ("  soc: {topic: s, type: Float64, field: data}", "signals.soc.type"),
        ("  soc: {topic: s, type: std_msgs/msg/Float64}", "signals.soc.field: is missing"),
        ("  soc: {topic: 's s', type: std_msgs/msg/Float64, field: data}", "signals.soc.topic"),
        (f"  soc: {{topic: s, {FLOAT}, scale: 0}}", "signals.soc.scale: 0, allowed any but 0"),
        (f"  soc: {{topic: s, {FLOAT}, scale: .nan}}", "signals.soc.scale"),
        (f"  soc: {{topic: s, {FLOAT}, scale: yes}}", "signals.soc.scale: a truth value"),
        (f"  soc: {{topic: s, {FLOAT}, sign: 2}}", "signals.soc.sign"),
        (f"  soc: {{topic: s, {FLOAT}, how: median}}", "signals.soc.how"),
        (f"  soc: {{topic: s, {FLOAT}, max_age_s: 0}}", "signals.soc.max_age_s"),
        (f"  soc: {{topic: s, {FLOAT}, stamp: mine}}", "signals.soc.stamp"),
        ("  soc: {topic: s, type: std_msgs/msg/Float64, field: 'data['}", "signals.soc: field"),
        ("  soc: {topic: s, type: my/msg/X, field: x}", "signals.soc.stamp: is missing, my/msg/X"),
        ("  soc: {scale: 2}", "signals.soc: no source given, allowed exactly one of topic"),
        (
            f"  soc: {{topic: s, {FLOAT}, sum: [{{topic: s, {FLOAT}}}]}}",
            "signals.soc: topic and sum given",
        ),
        (f"  soc: {{sum: [{{topic: s, {FLOAT}}}], offset: 1}}", "signals.soc.offset: allowed"),
        (
            f"  soc: {{product: [{{sum: [{{topic: s, {FLOAT}}}]}}]}}",
            "signals.soc.product.0: a sum, allowed topics and products",
        ),
        ("  {}", "signals: "),
    ],
)
def test_what_is_wrong_with_a_map_is_said_in_one_line(load, signals, says):
    with pytest.raises(ConfigError) as error:
        load(signals)
    text = str(error.value)
    assert "map.yaml: " in text and says in text and "\n" not in text


@pytest.mark.parametrize(
    ("head", "says"),
    [
        ("vehicle: mine\nsoc_target: 85\n", "soc_target"),
        ("vehicle: mine\np_aux_w: -1\n", "p_aux_w"),
        ("vehicel: mine\n", "vehicel"),
        ("vehicle: !!python/object:os.system mine\n", "not YAML"),
    ],
)
def test_the_head_of_a_map_is_checked(load, head, says):
    with pytest.raises(ConfigError, match=says):
        load(f"  soc: {{topic: s, {FLOAT}}}", head)


def test_a_signal_that_is_mapped_twice_is_refused_where_yaml_keeps_the_last(load):
    one = f"  soc: {{topic: a, {FLOAT}}}\n"
    with pytest.raises(ConfigError, match=r"map\.yaml: .*soc stands twice"):
        load(one + one)


def test_a_vehicle_without_soc_is_no_observation_and_no_error(load):
    signals = load(
        f"  power_demand_w: {{topic: a, {FLOAT}}}\n  engine_power_w: {{topic: b, {FLOAT}}}"
    )
    spec = sampled_spec(signals, 0.01, needed=("power_demand_w",))
    built = ObservationBuilder(spec, signals)
    built.start_run(vehicle_run(0.01, 0.5))
    ticks = [tick for s in signals.sources for tick in built.sense(s, 10**9, 5.0, 10**9)]
    assert ticks[0].observation is None and built.refusals == {"absent_soc": 1}


def test_a_map_that_is_not_there_is_named_with_those_that_are():
    with pytest.raises(ConfigError, match="unknown, shipped are: signals, signals_example_vehi"):
        load_signal_map("nowhere")
    with pytest.raises(ConfigError, match=r"no such signal map"):
        load_signal_map("nowhere.yaml")
    with pytest.raises(ConfigError, match="namespace"):
        optional_map(None, "/a")


def test_a_message_without_an_entry_says_nothing_of_it():
    kind = "sensor_msgs/msg/JointState"
    there, lacking = (Source("t", kind, f"effort[{name}]", stamp="publish") for name in "ab")
    message = type("JointState", (), {"name": ["a"], "effort": [4.0]})()
    assert values_of([there, lacking], message, 7) == [(there, 7, 4.0)]
