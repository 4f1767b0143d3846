"""A killed recording is finalised by the recorder's own code; whatever is whole is kept."""

from pathlib import Path

import pytest
import yaml
from bag_evidence import MAGIC, messages_of, whole_messages
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tractor_ems.bags import finalise as finalise_module
from tractor_ems.bags.in_process import write_samples_bag
from tractor_ems.bags.read import provenance_of, read_bag
from tractor_ems.bags.recover import recover
from tractor_ems.bags.rosbags_messages import RosbagsMessages, serialize
from tractor_ems.bags.runs import trajectory_of
from tractor_ems.bags.write import BagWriter
from tractor_msgs_py import topics
from tractor_msgs_py.codec import encode
from tractor_msgs_py.errors import BagError
from tractor_msgs_py.trajectory import trajectory_hash


@pytest.fixture(scope="module")
def part(driven, tmp_path_factory):
    """The part file of a recording that was abandoned after its last message."""
    folder = tmp_path_factory.mktemp("part") / "bag"
    factory = RosbagsMessages()
    channels = {f"/{topic.name}": topic for topic in topics.RECORDED}
    writer = BagWriter(folder, channels, {"recorder": "test"})
    for k, sample in enumerate(driven.samples):
        topic, message = encode(sample, factory)
        writer.write(f"/{topic.name}", serialize(message, topic.type), 10 + k, 10 + k, k + 1)
    return (folder / "bag_0.mcap.part").read_bytes()


def abandoned(folder: Path, content: bytes) -> Path:
    folder.mkdir(parents=True)
    (folder / f"{folder.name}_0.mcap.part").write_bytes(content)
    return folder


def test_every_message_is_in_the_part_before_write_returns(part, driven):
    assert len(whole_messages(part)) == len(driven.samples)


def test_recovered_bag_is_the_bag_that_would_have_been_closed(part, driven, tmp_path):
    done = recover(abandoned(tmp_path / "bag", part))
    assert done.cut_bytes == 0 and sum(done.messages.values()) == len(driven.samples)
    assert sorted(p.name for p in (tmp_path / "bag").iterdir()) == ["bag_0.mcap", "metadata.yaml"]
    (run,) = read_bag(tmp_path / "bag")
    assert trajectory_hash(trajectory_of(run)) == trajectory_hash(driven.trajectory)
    said = provenance_of(tmp_path / "bag")
    assert (said["recovered"], said["cut_bytes"], said["recorder"]) == ("true", "0", "test")


@settings(
    max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(data=st.data())
def test_whatever_is_whole_before_a_cut_is_recovered(part, tmp_path_factory, data):
    cut = part[: data.draw(st.integers(0, len(part)), label="bytes kept")]
    bag = abandoned(tmp_path_factory.mktemp("cut") / "bag", cut)
    whole = whole_messages(cut)
    if not whole:
        with pytest.raises(BagError):
            recover(bag)
        assert [path.read_bytes() for path in bag.iterdir()] == [cut]
        return
    done = recover(bag)
    assert messages_of(bag) == whole
    assert sum(done.messages.values()) == len(whole)
    assert done.cut_bytes < max(len(m) for m in whole_messages(part)) + 31
    metadata = yaml.safe_load((bag / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    assert metadata["message_count"] == len(whole)
    assert metadata["custom_data"]["cut_bytes"] == str(done.cut_bytes)


@pytest.mark.parametrize("tail", [b"\0" * 4096, b"\xff" * 100, bytes(range(256))])
def test_garbage_that_a_power_cut_leaves_is_cut_off(part, tail, tmp_path):
    half = part[: len(part) // 2]
    whole = whole_messages(half)
    boundary = half.rfind(whole[-1]) + len(whole[-1])
    bag = abandoned(tmp_path / "bag", half[:boundary] + tail)
    recover(bag)
    assert messages_of(bag) == whole


def test_crash_while_finalising_loses_nothing(part, driven, tmp_path, monkeypatch):
    bag = abandoned(tmp_path / "bag", part)
    real = finalise_module.write_bytes

    def crash(path, data):
        raise KeyboardInterrupt

    monkeypatch.setattr(finalise_module, "write_bytes", crash)
    with pytest.raises(KeyboardInterrupt):
        recover(bag)
    assert (bag / "bag_0.mcap.part").is_file()
    monkeypatch.setattr(finalise_module, "write_bytes", real)
    (bag / ".bag_0.mcap.1234.part").write_bytes(b"left by a killed process")
    recover(bag)
    assert sorted(p.name for p in bag.iterdir()) == ["bag_0.mcap", "metadata.yaml"]
    assert len(messages_of(bag)) == len(driven.samples)


def test_finalised_bag_has_nothing_to_recover(driven, tmp_path):
    write_samples_bag(tmp_path / "bag", driven.samples, {})
    before = {p.name: p.read_bytes() for p in (tmp_path / "bag").iterdir()}
    with pytest.raises(BagError, match="0 part files"):
        recover(tmp_path / "bag")
    assert {p.name: p.read_bytes() for p in (tmp_path / "bag").iterdir()} == before


@pytest.mark.parametrize("content", [b"", b"no mcap at all", MAGIC])
def test_part_that_holds_no_message_is_refused_and_kept(content, tmp_path):
    bag = abandoned(tmp_path / "bag", content)
    with pytest.raises(BagError, match="holds no message"):
        recover(bag)
    assert [path.name for path in bag.iterdir()] == ["bag_0.mcap.part"]


def test_missing_folder_is_refused(tmp_path):
    with pytest.raises(BagError, match="no such bag"):
        recover(tmp_path / "nothing")


def test_a_recording_that_goes_on_is_left_alone(driven, tmp_path):
    bag = tmp_path / "bag"
    topic, message = encode(driven.samples[1], RosbagsMessages())
    writer = BagWriter(bag, {f"/{topic.name}": topic}, {})
    data = serialize(message, topic.type)
    writer.write(f"/{topic.name}", data, 10, 10)
    beside = bag / ".bag_0.mcap.1234.part"
    beside.write_bytes(b"of a finalise that goes on")
    for refused in (read_bag, recover, lambda bag: recover(bag / "bag_0.mcap.part")):
        with pytest.raises(BagError, match="still being recorded") as caught:
            refused(bag)
        assert str(bag) in str(caught.value)
    assert beside.exists()
    beside.unlink()
    writer.write(f"/{topic.name}", data, 11, 11)
    assert writer.close().messages == {f"/{topic.name}": 2}
    assert len(messages_of(bag)) == 2


def test_the_recorder_holds_its_part_until_it_is_finalised(driven, tmp_path, monkeypatch):
    bag = tmp_path / "bag"
    topic, message = encode(driven.samples[1], RosbagsMessages())
    writer = BagWriter(bag, {f"/{topic.name}": topic}, {})
    writer.write(f"/{topic.name}", serialize(message, topic.type), 10, 10)
    real, seen = finalise_module.write_bytes, []

    def look(path, data):
        with pytest.raises(BagError, match="still being recorded"):
            recover(bag)
        seen.append(path.name)
        real(path, data)

    monkeypatch.setattr(finalise_module, "write_bytes", look)
    writer.close()
    assert seen == ["metadata.yaml"]
