"""Samples survive the wire; layouts that are not the contract's are refused by name."""

import dataclasses
import json
import math
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rclpy.serialization import deserialize_message, serialize_message

from tractor_msgs_py import codec, topics
from tractor_msgs_py.errors import BagError
from tractor_msgs_py.ros.messages import CLASSES, RosMessages
from tractor_msgs_py.types import (
    BatteryPowerCommand,
    BatteryReading,
    CommandMode,
    PowerDemand,
    PowertrainReading,
    Reason,
    RunInfo,
)

FACTORY = RosMessages()
stamps = st.integers(1, 2**31 * 10**9 - 1)
powers = st.floats(-1e9, 1e9)
INFO = RunInfo(
    run_id="r1",
    cycle="planter",
    cycle_hash="c",
    powertrain="paper",
    powertrain_hash="p",
    t0_ns=10**12,
    dt_s=1.0,
    steps=766,
    p_aux_w=0.0,
    soc_initial=0.85,
    soc_target=0.836,
)


def over_the_wire(sample):
    topic, message = codec.encode(sample, FACTORY)
    received = deserialize_message(serialize_message(message), CLASSES[topic.type])
    return codec.DECODERS[topic.name](received)


@given(stamp=stamps, values=st.lists(powers, min_size=10, max_size=10), on=st.booleans())
def test_float64_samples_come_back_bit_for_bit(stamp, values, on):
    for sample in (
        PowerDemand(stamp, values[0]),
        PowertrainReading(stamp, on, *values),
        BatteryPowerCommand(stamp, values[1], values[2], CommandMode.FALLBACK),
    ):
        assert over_the_wire(sample) == sample


@pytest.mark.parametrize("reason", Reason)
def test_a_command_says_why_it_is_not_the_policys_wish_and_only_then(reason):
    sample = BatteryPowerCommand(1, 2.0, 3.0, CommandMode.FALLBACK, reason)
    assert over_the_wire(sample) == sample
    names = codec.encode(sample, FACTORY)[1].name
    assert (codec.REASON_NAME in names) == (reason is not Reason.NONE)


@pytest.mark.parametrize("reason", [-1.0, 0.5, max(Reason) + 1.0, math.nan])
def test_an_unknown_reason_is_refused(reason):
    message = FACTORY.joint_state(1, (*codec.COMMAND_NAMES, "reason"), (0.0, 0.0, 1.0, reason))
    with pytest.raises(BagError, match="reason"):
        codec.decode_command(message)


@given(soc=st.floats(0, 1))
def test_soc_comes_back_as_the_in_process_run_sees_it(soc):
    received = over_the_wire(BatteryReading(1, soc, 650.0, -100.0))
    assert received.soc == float(codec.wire_soc(soc))


def test_no_opinion_stays_nan_and_unknown_battery_fields_are_nan():
    received = over_the_wire(BatteryPowerCommand(5, 1.0))
    assert math.isnan(received.engine_power_w)
    _, message = codec.encode(BatteryReading(5, 0.5, 650.0, 0.0), FACTORY)
    assert math.isnan(message.temperature) and math.isnan(message.capacity)


def test_run_info_round_trips_and_ignores_unknown_keys():
    assert over_the_wire(INFO) == INFO
    newer = {**dataclasses.asdict(INFO), "colour": "green"}
    assert codec.decode_run_info(SimpleNamespace(data=json.dumps(newer))) == INFO


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"dt_s": 0.0}, "dt_s"),
        ({"dt_s": True}, "dt_s"),
        ({"steps": "many"}, "steps"),
        ({"steps": 0}, "steps"),
        ({"t0_ns": 0}, "t0_ns"),
        ({"soc_target": 83.6}, "soc_target"),
        ({"run_id": None}, "run_id"),
    ],
)
def test_a_run_info_field_out_of_range_is_refused_by_name(change, named):
    text = json.dumps({**dataclasses.asdict(INFO), **change})
    with pytest.raises(BagError, match=named):
        codec.decode_run_info(SimpleNamespace(data=text))


@pytest.mark.parametrize("text", ["", "[]", "{}", "NaN", '{"run_id": 1}'])
def test_a_run_info_that_is_no_object_of_ours_is_refused(text):
    with pytest.raises(BagError, match="run_info"):
        codec.decode_run_info(SimpleNamespace(data=text))


def test_another_joint_state_layout_is_refused():
    message = FACTORY.joint_state(1, ["wheel"], [1.0])
    for decode in (codec.decode_power_demand, codec.decode_command, codec.decode_powertrain):
        with pytest.raises(BagError, match="wheel"):
            decode(message)
    with pytest.raises(BagError, match="mode"):
        codec.decode_command(FACTORY.joint_state(1, codec.COMMAND_NAMES, [0.0, 0.0, 7.0]))


def test_topic_names_are_relative_and_nothing_asks_for_a_deadline():
    for topic in topics.RECORDED:
        assert not topic.name.startswith("/")
    assert {field.name for field in dataclasses.fields(topics.Qos)} == {
        "reliability",
        "durability",
        "depth",
    }
    assert topics.RUN_INFO.qos == topics.Qos(durability="transient_local", depth=1)
    assert np.all([topic.qos.reliability == "reliable" for topic in topics.RECORDED])


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"dt_s": 1e-12}, "dt_s"),
        ({"dt_s": 1e-4}, "dt_s"),
        ({"steps": 10**9}, "steps"),
        ({"steps": 10**400}, "steps"),
        ({"t0_ns": 2**63 - 1}, "t0_ns"),
        ({"steps": 10_000_000, "dt_s": 3600.0}, "t0_ns"),
        ({"p_aux_w": 10**400}, "p_aux_w"),
    ],
)
def test_a_run_info_that_no_machine_can_drive_is_refused_in_one_short_line(change, named):
    text = json.dumps({**dataclasses.asdict(INFO), **change})
    with pytest.raises(BagError, match=named) as caught:
        codec.decode_run_info(SimpleNamespace(data=text))
    assert len(str(caught.value)) < 200


@pytest.mark.parametrize("number", ["NaN", "Infinity", "1e400"])
def test_a_run_info_holds_finite_numbers_only(number):
    text = json.dumps({**dataclasses.asdict(INFO), "p_aux_w": 0.5}).replace("0.5", number)
    with pytest.raises(BagError, match=r"no JSON number|must be finite"):
        codec.decode_run_info(SimpleNamespace(data=text))


@pytest.mark.parametrize("text", ["[" * 100_000, '{"steps": 1' + "0" * 5000 + "}"])
def test_run_info_json_that_no_parser_takes_is_refused(text):
    with pytest.raises(BagError, match="not JSON"):
        codec.decode_run_info(SimpleNamespace(data=text))
