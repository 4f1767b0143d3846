"""SIGKILL at any moment loses no message that had been flushed; the rest of the run goes on.

"Flushed" is what an independent reader finds whole in the part file of the dead recorder. Before
the kill the test waits until a chosen number of messages can be seen there while the recorder is
alive, which is the recorder's acknowledgement, and keeps publishing while it kills.
"""

import random
import signal
from dataclasses import replace
from pathlib import Path

import pytest
from bag_evidence import (
    decoded_by_rclpy,
    installed_type_hash,
    messages_of,
    type_hashes_of,
    whole_messages,
)
from rclpy.serialization import deserialize_message, serialize_message

from tractor_ems.bags.read import provenance_of, read_bag
from tractor_ems.bags.recover import recover
from tractor_msgs_py.errors import BagError


def part_of(bag: Path) -> Path:
    return bag / f"{bag.name}_0.mcap.part"


def as_received(message):
    """The message with its fields in the precision that they have on the wire."""
    return deserialize_message(serialize_message(message), type(message))


def long_run(driven, ticks):
    """The driven run's samples over and over, on the stamps of one long run."""
    yield replace(driven.info, steps=ticks)
    block = driven.samples[1:-2]
    for k in range(ticks // driven.info.steps):
        shift_ns = k * driven.info.steps * driven.info.dt_ns
        for sample in block:
            yield replace(sample, stamp_ns=sample.stamp_ns + shift_ns)


def kill_and_recover(graph, start_recorder, driven, bag, wait_for, rng):
    recorder = start_recorder(output=str(bag), ros=("-r", f"__ns:=/{bag.name}"))
    wait_for(graph.subscribed, "the recorder's subscriptions")
    wanted, burst = rng.randrange(20, 1500), rng.randrange(0, 400)
    samples = long_run(driven, 60 * driven.info.steps)
    sent = []
    for sample in samples:
        sent += graph.publish([sample])
        if len(sent) >= wanted:
            break
    wait_for(lambda: len(whole_messages(part_of(bag).read_bytes())) >= wanted, "flushed messages")
    for _, sample in zip(range(burst), samples, strict=False):
        sent += graph.publish([sample])
    code, _, _ = recorder.end(signal.SIGKILL)
    assert code == -signal.SIGKILL
    flushed = whole_messages(part_of(bag).read_bytes())
    assert wanted <= len(flushed) <= len(sent)
    with pytest.raises(BagError, match="ems bag recover"):
        read_bag(bag)

    done = recover(bag)

    assert messages_of(bag) == flushed
    assert sum(done.messages.values()) == len(flushed)
    decoded = decoded_by_rclpy(bag)
    for topic, messages in decoded.items():
        published = [as_received(message) for name, message in sent if topic.endswith(f"/{name}")]
        assert [repr(m) for m in messages] == [repr(m) for m in published[: len(messages)]]
    stated = type_hashes_of(bag)
    assert stated == {name: installed_type_hash(name) for name in stated}
    assert provenance_of(bag)["recovered"] == "true"
    (run,) = read_bag(bag)
    assert not run.complete and run.gaps == 0
    return done


def kill_repeatedly(make_graph, start_recorder, driven, tmp_path, wait_for, times):
    """Each time in a namespace of its own: a killed recorder stays matched for its lease."""
    rng = random.Random(times)
    for k in range(times):
        graph = make_graph(f"/killed_{k}")
        kill_and_recover(graph, start_recorder, driven, tmp_path / f"killed_{k}", wait_for, rng)
        graph.close()


def test_killed_recorder_loses_no_flushed_message(
    make_graph, start_recorder, driven, tmp_path, wait_for
):
    kill_repeatedly(make_graph, start_recorder, driven, tmp_path, wait_for, 1)


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_twenty_kills_lose_no_flushed_message(
    make_graph, start_recorder, driven, tmp_path, wait_for
):
    kill_repeatedly(make_graph, start_recorder, driven, tmp_path, wait_for, 20)
