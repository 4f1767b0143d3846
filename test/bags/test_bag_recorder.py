"""The recorder as a process: what it records, when it stops, what it leaves, how it ends."""

import signal
import time
from dataclasses import replace

import pytest
from bag_evidence import (
    decoded_by_rclpy,
    installed_type_hash,
    type_hashes_of,
    whole_messages,
)

from tractor_ems.bags.check import check
from tractor_ems.bags.read import provenance_of, read_bag
from tractor_ems.bags.runs import trajectory_of
from tractor_msgs_py.trajectory import trajectory_hash


def flushed(folder):
    """How many messages the recorder has handed to the operating system."""
    return len(whole_messages((folder / "rec" / "rec_0.mcap.part").read_bytes()))


def test_complete_run_is_recorded_and_the_recorder_ends_by_itself(
    graph, start_recorder, driven, tmp_path, wait_for
):
    recorder = start_recorder()
    wait_for(graph.subscribed, "the recorder's subscriptions")
    sent = graph.publish(driven.samples)
    code, out, error = recorder.end()
    assert (code, error) == (0, "")
    assert f"{len(sent)} messages, 1 complete runs" in out
    (run,) = read_bag(tmp_path / "rec")
    assert run.complete and run.policy == "rule_based"
    assert trajectory_hash(trajectory_of(run)) == trajectory_hash(driven.trajectory)
    by_topic = {}
    for name, message in sent:
        by_topic.setdefault(f"/{name}", []).append(message)
    decoded = decoded_by_rclpy(tmp_path / "rec")
    assert {name: len(messages) for name, messages in decoded.items()} == {
        name: len(messages) for name, messages in by_topic.items()
    }
    assert [m.effort for m in decoded["/powertrain_state"]] == [
        m.effort for m in by_topic["/powertrain_state"]
    ]
    stated = type_hashes_of(tmp_path / "rec")
    assert stated == {name: installed_type_hash(name) for name in stated}
    assert check(tmp_path / "rec").verdict == "pass"
    said = provenance_of(tmp_path / "rec")
    assert said["recorder"] == "bag_recorder" and said["recovered"] == "false"
    assert "output:=rec" in said["recorder_command_line"]


@pytest.mark.parametrize(
    "number", [pytest.param(signal.SIGINT, marks=pytest.mark.slow), signal.SIGTERM]
)
def test_signal_finalises_what_is_there(graph, start_recorder, driven, tmp_path, wait_for, number):
    recorder = start_recorder()
    wait_for(graph.subscribed, "the recorder's subscriptions")
    part = driven.samples[: len(driven.samples) // 2]
    graph.publish(part)
    wait_for(lambda: flushed(tmp_path) == len(part), "the part file to hold what was sent")
    code, out, error = recorder.end(number)
    assert (code, error) == (0, "") and "0 complete runs" in out
    assert sorted(p.name for p in (tmp_path / "rec").iterdir()) == ["metadata.yaml", "rec_0.mcap"]
    (run,) = read_bag(tmp_path / "rec")
    assert not run.complete and run.gaps == 0 and sum(run.driven) > 10


@pytest.mark.slow
def test_signal_before_anything_came_leaves_nothing(graph, start_recorder, tmp_path, wait_for):
    recorder = start_recorder()
    wait_for(graph.subscribed, "the recorder's subscriptions")
    code, _, error = recorder.end(signal.SIGTERM)
    assert (code, error) == (0, "bag_recorder: nothing was received, no bag was written\n")
    assert list(tmp_path.iterdir()) == []


def test_nothing_for_too_long_is_an_aborted_run(graph, start_recorder, driven, tmp_path, wait_for):
    recorder = start_recorder("idle_timeout_s:=1.0")
    wait_for(graph.subscribed, "the recorder's subscriptions")
    graph.publish(driven.samples[:40])
    code, _, error = recorder.end()
    assert code == 3 and "no message for 1 s" in error and "Traceback" not in error
    (run,) = read_bag(tmp_path / "rec")
    assert not run.complete


@pytest.mark.slow
def test_namespaced_topics_are_recorded_under_their_names(
    make_graph, start_recorder, driven, tmp_path, wait_for
):
    tractor = make_graph("/tractor1")
    recorder = start_recorder(ros=("-r", "__ns:=/tractor1"))
    wait_for(tractor.subscribed, "the recorder's subscriptions")
    tractor.publish(driven.samples)
    assert recorder.end()[0] == 0
    (run,) = read_bag(tmp_path / "rec")
    assert run.namespace == "/tractor1" and run.complete


@pytest.mark.slow
def test_two_runs_with_the_same_stamps_go_into_one_bag(
    graph, start_recorder, driven, tmp_path, wait_for
):
    recorder = start_recorder("runs:=2")
    wait_for(graph.subscribed, "the recorder's subscriptions")
    graph.publish(driven.samples)
    wait_for(lambda: flushed(tmp_path) == len(driven.samples), "the first run")
    second = replace(driven.info, run_id="second")
    graph.publish([second])
    wait_for(lambda: flushed(tmp_path) == len(driven.samples) + 1, "the second run_info")
    graph.publish(driven.samples[1:])
    assert recorder.end()[0] == 0
    runs = read_bag(tmp_path / "rec")
    assert [run.complete for run in runs] == [True, True]
    assert {trajectory_hash(trajectory_of(run)) for run in runs} == {
        trajectory_hash(driven.trajectory)
    }


@pytest.mark.parametrize(
    ("parameters", "output", "message"),
    [
        pytest.param(("runs:=-1",), "rec", "parameter runs", marks=pytest.mark.slow),
        pytest.param(("ruins:=1",), "rec", "parameter ruins: unknown", marks=pytest.mark.slow),
        ((), "there", "exists already"),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(
    start_recorder, tmp_path, parameters, output, message
):
    (tmp_path / "there").mkdir()
    code, out, error = start_recorder(*parameters, output=output).end()
    assert (code, out) == (2, "")
    assert error.startswith("bag_recorder: ") and message in error and error.count("\n") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["there"]
    assert list((tmp_path / "there").iterdir()) == []


@pytest.mark.slow
def test_a_bag_without_a_name_is_named_after_the_time(start_recorder, tmp_path):
    recorder = start_recorder(output=None)
    deadline_s = time.monotonic() + 60.0
    while not list(tmp_path.iterdir()):
        assert time.monotonic() < deadline_s, recorder.end(signal.SIGKILL)
        time.sleep(0.05)
    (begun,) = tmp_path.iterdir()
    assert begun.name.startswith("tractor_ems_20")
    assert recorder.end(signal.SIGTERM)[0] == 0
    assert list(tmp_path.iterdir()) == [], "nothing was received, nothing stays"
