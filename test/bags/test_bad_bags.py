"""Bags that are no good: each gets one line that names the bag and what is wrong with it."""

import json
import math

import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin, Writer

from tractor_ems.bags.in_process import write_samples_bag
from tractor_ems.bags.read import provenance_of, read_bag
from tractor_ems.bags.rosbags_messages import RosbagsMessages, serialize, typestore
from tractor_ems.bags.runs import trajectory_of
from tractor_ems.bags.transitions import iter_traces
from tractor_msgs_py import topics
from tractor_msgs_py.codec import encode
from tractor_msgs_py.errors import BagError
from tractor_msgs_py.types import PowerDemand

FACTORY = RosbagsMessages()


def foreign_bag(path, messages, storage=StoragePlugin.MCAP):
    """A bag of another writer: (topic, type, CDR bytes) at one second each."""
    with Writer(path, version=9, storage_plugin=storage) as writer:
        connections = {}
        for k, (topic, kind, data) in enumerate(messages):
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=typestore())
            writer.write(connections[topic], (k + 1) * 10**9, data)
    return path


def string(data):
    return serialize(FACTORY.string(data), topics.STRING)


def joint_state(names, efforts, stamp_ns=10**9):
    return serialize(FACTORY.joint_state(stamp_ns, names, efforts), topics.JOINT_STATE)


def demand(k, power_w=1e5):
    return "/power_demand", topics.JOINT_STATE, joint_state(["power_demand"], [power_w], k * 10**9)


def refused(path, match):
    """The error is one line, names the bag and says what is wrong."""
    with pytest.raises(BagError, match=match) as caught:
        read_bag(path)
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)
    assert caught.value.exit_code == 2


def test_missing_bag(tmp_path):
    refused(tmp_path / "nothing", "no such bag")


def test_folder_without_a_bag(tmp_path):
    refused(tmp_path, "0 storage files")


@pytest.mark.parametrize("keep", [0.1, 0.5, 0.9, 0.999])
def test_truncated_bag(bag, tmp_path, keep):
    content = (bag / "bag_0.mcap").read_bytes()
    copy = tmp_path / "copy"
    copy.mkdir()
    (copy / "metadata.yaml").write_bytes((bag / "metadata.yaml").read_bytes())
    (copy / "bag_0.mcap").write_bytes(content[: int(keep * len(content))])
    refused(copy, "not a readable bag")


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 this is a zip", b"\x89MCAP0\r\n"])
def test_file_that_is_no_mcap(tmp_path, content):
    path = tmp_path / "thing.mcap"
    path.write_bytes(content)
    with pytest.raises(BagError, match=r"thing\.mcap"):
        read_bag(path)


def test_unfinished_recording_points_to_recover(tmp_path):
    (tmp_path / "bag_0.mcap.part").write_bytes(b"")
    refused(tmp_path, "ems bag recover")


@pytest.mark.parametrize("text", ["{", "rosbag2_bagfile_information: 3", "- 1", ""])
def test_malformed_metadata(bag, tmp_path, text):
    (tmp_path / "metadata.yaml").write_text(text)
    (tmp_path / "bag_0.mcap").write_bytes((bag / "bag_0.mcap").read_bytes())
    refused(tmp_path, "provenance cannot be read|not a readable bag")


def test_foreign_bag_names_what_it_holds(tmp_path):
    path = foreign_bag(tmp_path / "bag", [("/chatter", topics.STRING, string("hello"))])
    refused(path, "no topic power_demand, holds /chatter")


def test_empty_bag(tmp_path):
    with Writer(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        writer.add_connection("/power_demand", topics.JOINT_STATE, typestore=typestore())
    refused(tmp_path / "bag", "is empty")


def test_bag_with_states_and_no_demand_in_it(driven, write):
    path = write([s for s in driven.samples if not isinstance(s, PowerDemand)])
    refused(path, "no topic power_demand")


def test_wrong_message_type_on_a_contract_topic(tmp_path):
    message = ("/battery_state", topics.STRING, string("0.85"))
    path = foreign_bag(tmp_path / "bag", [demand(1), message])
    refused(path, "/battery_state is std_msgs/msg/String, expected sensor_msgs/msg/BatteryState")


def test_wrong_type_in_a_namespace_that_is_no_tractor_is_ignored(tmp_path):
    other = ("/robot/battery_state", topics.STRING, string("fine"))
    path = foreign_bag(tmp_path / "bag", [demand(1), demand(2), other])
    assert len(read_bag(path)[0].demand) == 2


def test_other_type_hash_on_a_contract_topic(bag, tmp_path):
    text = (bag / "metadata.yaml").read_text().replace("RIHS01_a13e", "RIHS01_0000")
    (tmp_path / "metadata.yaml").write_text(text)
    (tmp_path / "bag_0.mcap").write_bytes((bag / "bag_0.mcap").read_bytes())
    refused(tmp_path, "has type hash RIHS01_0000")


@pytest.mark.parametrize(
    ("names", "efforts"),
    [(["power"], [1.0]), (["power_demand"], []), ([], []), (["power_demand", "x"], [1.0, 2.0])],
)
def test_wrong_layout(tmp_path, names, efforts):
    message = ("/power_demand", topics.JOINT_STATE, joint_state(names, efforts))
    refused(foreign_bag(tmp_path / "bag", [message]), "power_demand: .*names")


def test_bytes_that_are_no_message(tmp_path):
    message = ("/power_demand", topics.JOINT_STATE, b"\x00\x01\x00\x00\x05")
    refused(foreign_bag(tmp_path / "bag", [message]), "not a sensor_msgs/msg/JointState")


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("{", "not JSON"),
        ("[]", "expected an object"),
        ("{}", "is missing"),
        ('{"dt_s": NaN}', "missing|dt_s"),
    ],
)
def test_bad_run_info_json(tmp_path, text, match):
    message = ("/run_info", topics.STRING, string(text))
    refused(foreign_bag(tmp_path / "bag", [demand(1), message]), match)


def test_run_info_field_out_of_range(driven, tmp_path):
    _, message = encode(driven.info, FACTORY)
    data = json.loads(message.data) | {"dt_s": -1.0}
    info = ("/run_info", topics.STRING, string(json.dumps(data)))
    refused(foreign_bag(tmp_path / "bag", [demand(1), info]), "dt_s -1.0, allowed")


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_demand_that_is_not_finite_is_counted_and_left_out(tmp_path, value):
    path = foreign_bag(tmp_path / "bag", [demand(1), demand(2, value), demand(3)])
    (run,) = read_bag(path)
    assert run.refusals == {"not_finite": 1} and len(run.demand) == 2


def test_stamps_that_go_back_or_are_unset_are_counted(tmp_path):
    path = foreign_bag(tmp_path / "bag", [demand(5), demand(6), demand(4), demand(0), demand(7)])
    (run,) = read_bag(path)
    assert run.refusals == {"stamp_backwards": 1, "zero_stamp": 1}
    assert list(run.demand) == [5 * 10**9, 6 * 10**9, 7 * 10**9]


def test_demand_only_bag_has_no_trajectory(tmp_path):
    (run,) = read_bag(foreign_bag(tmp_path / "bag", [demand(1), demand(2)]))
    assert run.info is None and not run.complete
    with pytest.raises(BagError, match="no run_info"):
        trajectory_of(run)


@pytest.mark.parametrize("storage", list(StoragePlugin))
def test_bag_of_another_writer_reads(tmp_path, storage):
    messages = [demand(k, 1e5 + k) for k in range(1, 31)]
    path = foreign_bag(tmp_path / "bag", messages, storage)
    (trace,) = iter_traces([path])
    np.testing.assert_array_equal(trace.power_demand_w, 1e5 + np.arange(1.0, 31.0))
    assert provenance_of(path) == {}


def test_samples_before_any_run_info_are_not_lost(driven, tmp_path):
    ordered = [*driven.samples[1:4], driven.samples[0], *driven.samples[4:]]
    write_samples_bag(tmp_path / "bag", ordered, {})
    assert read_bag(tmp_path / "bag")[0].complete
