"""What a player says on the wire: there and back, and every malformed announcement is refused."""

import json
from dataclasses import asdict

import pytest

from tractor_ems.bags.rosbags_messages import RosbagsMessages, deserialize, serialize
from tractor_msgs_py import topics
from tractor_msgs_py.codec import DECODERS, MAX_STEPS, decode_duty_cycle_info, encode
from tractor_msgs_py.errors import BagError
from tractor_msgs_py.types import DutyCycleDemand, DutyCycleInfo

INFO = DutyCycleInfo("one", "short", "0" * 64, 10**12, 1.0, 5)


@pytest.mark.parametrize("sample", [INFO, DutyCycleDemand(1_500_000_000, -12.5)])
def test_a_player_is_understood_as_it_spoke(sample):
    topic, message = encode(sample, RosbagsMessages())
    received = deserialize(serialize(message, topic.type), topic.type)
    assert DECODERS[topic.name](received) == sample


def test_the_plants_own_demand_is_not_taken_for_a_cycle():
    message = RosbagsMessages().joint_state(10**9, ("power_demand",), (1e5,))
    with pytest.raises(BagError, match="duty_cycle_demand: JointState names"):
        DECODERS[topics.DUTY_CYCLE_DEMAND.name](message)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"steps": 0}, "steps 0, allowed 1"),
        ({"steps": MAX_STEPS + 1}, f"allowed 1..{MAX_STEPS}"),
        ({"steps": 5.0}, "field steps is 5.0"),
        ({"dt_s": 0.0}, "dt_s 0.0, allowed"),
        ({"dt_s": 1e9}, "dt_s 1000000000.0, allowed"),
        ({"t0_ns": 0}, "t0_ns 0, allowed from 1"),
        ({"t0_ns": 2**63}, "t0_ns"),
        ({"cycle": None}, "field cycle is None"),
    ],
)
def test_an_announcement_out_of_range_is_refused_by_field(change, said):
    message = RosbagsMessages().string(json.dumps({**asdict(INFO), **change}))
    with pytest.raises(BagError, match=rf"duty_cycle_info: .*{said}"):
        decode_duty_cycle_info(message)


@pytest.mark.parametrize("text", ["", "[]", '{"dt_s": NaN}', "{}"])
def test_an_announcement_that_is_none_is_refused(text):
    with pytest.raises(BagError, match="duty_cycle_info: "):
        decode_duty_cycle_info(RosbagsMessages().string(text))
