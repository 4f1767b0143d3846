"""When a run counts as recorded: every topic has reached its end, in whatever order."""

import dataclasses
import itertools

import pytest

from tractor_ems.bags.progress import LATE_S, Progress
from tractor_ems.bags.rosbags_messages import RosbagsMessages, header_stamp_ns, serialize
from tractor_msgs_py.codec import encode
from tractor_msgs_py.errors import BagError
from tractor_msgs_py.types import BatteryPowerCommand, RunInfo

FACTORY = RosbagsMessages()


def feed(progress, samples, now_s=0.0):
    for sample in samples:
        topic, message = encode(sample, FACTORY)
        progress.add(topic.name, serialize(message, topic.type), now_s)


def test_run_is_over_with_its_last_sample_and_not_before(driven):
    progress = Progress()
    for sample in driven.samples:
        assert progress.runs == 0
        feed(progress, [sample])
    assert progress.runs == 1
    feed(progress, driven.samples[-3:])  # resent
    assert progress.runs == 1


def test_order_of_the_last_samples_does_not_matter(driven):
    # The last demand, states and command of a run, and its final states.
    *head, demand, battery, state, command, final_battery, final_state = driven.samples
    tail = (demand, command, final_battery, final_state)
    for order in itertools.permutations(tail):
        progress = Progress()
        feed(progress, [*head, battery, state, *order])
        assert progress.runs == 1


def test_lost_last_answer_ends_the_run_after_a_while(driven):
    last = [s for s in driven.samples if isinstance(s, BatteryPowerCommand)][-1]
    progress = Progress()
    feed(progress, [s for s in driven.samples if s is not last], now_s=10.0)
    progress.poll(10.0 + LATE_S)
    assert progress.runs == 0
    progress.poll(10.1 + LATE_S)
    assert progress.runs == 1


def test_real_time_run_needs_no_answer(driven):
    info = dataclasses.replace(driven.info, lockstep=False)
    rest = [s for s in driven.samples[1:] if not isinstance(s, BatteryPowerCommand)]
    progress = Progress()
    feed(progress, [info, *rest])
    assert progress.runs == 1


def test_second_run_with_the_same_stamps_counts_when_it_is_over(driven):
    progress = Progress()
    feed(progress, driven.samples)
    feed(progress, [dataclasses.replace(driven.info, run_id="second")])
    assert progress.runs == 1
    feed(progress, driven.samples[1:])
    assert progress.runs == 2


def test_aborted_run_does_not_count(driven):
    progress = Progress()
    feed(progress, driven.samples[:-20])
    feed(progress, [dataclasses.replace(driven.info, run_id="second"), *driven.samples[1:]])
    assert progress.runs == 1


@pytest.mark.parametrize("name", ["run_info", "power_demand"])
def test_malformed_message_is_recorded_but_not_counted(driven, name):
    progress = Progress()
    progress.add(name, b"\x00\x01", 0.0)
    feed(progress, driven.samples)
    assert progress.runs == 1


def test_stamp_is_read_from_the_header_of_either_byte_order(driven):
    for sample in driven.samples:
        if isinstance(sample, RunInfo):
            continue
        topic, message = encode(sample, FACTORY)
        assert header_stamp_ns(serialize(message, topic.type)) == sample.stamp_ns
    assert (
        header_stamp_ns(b"\x00\x00\x00\x00" + (7).to_bytes(4, "big") + (9).to_bytes(4, "big"))
        == 7 * 10**9 + 9
    )
    with pytest.raises(BagError, match="header"):
        header_stamp_ns(b"\x00\x01\x00\x00\x00")
