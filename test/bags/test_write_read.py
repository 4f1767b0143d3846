"""Writing and reading back: the same run, the same bytes, a bag that others can read."""

import dataclasses
import hashlib
import json
import resource

import numpy as np
import pytest
import yaml
from bag_evidence import decoded_by_rclpy, installed_type_hash, type_hashes_of
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader
from rosbags.interfaces import QosDurability, QosReliability

from tractor_ems.bags.in_process import record_in_process, write_samples_bag, write_trajectory_bag
from tractor_ems.bags.read import bag_hash, find_bags, provenance_of, read_bag
from tractor_ems.bags.recover import recover
from tractor_ems.bags.rosbags_messages import definition, type_hash
from tractor_ems.bags.runs import observations_of, trajectory_of
from tractor_ems.bags.scan import scan_mcap
from tractor_ems.bags.write import BagWriter
from tractor_ems.policies.rules import BestPoint, Conventional, MyopicGreedy, RuleBased
from tractor_ems.scenario import make_scenario
from tractor_msgs_py import topics
from tractor_msgs_py.errors import BagError, RunAborted
from tractor_msgs_py.observation import DemandFilter, ObservationSpec
from tractor_msgs_py.trajectory import Trajectory, trajectory_hash
from tractor_msgs_py.types import (
    BatteryPowerCommand,
    BatteryReading,
    CommandMode,
    PowerDemand,
    PowertrainReading,
    RunInfo,
)


@pytest.mark.parametrize(
    "make",
    [
        RuleBased,
        lambda _: Conventional(),
        *(pytest.param(policy, marks=pytest.mark.slow) for policy in (BestPoint, MyopicGreedy)),
    ],
)
def test_bag_of_a_run_has_the_trajectory_hash_of_the_run(make, tmp_path):
    scenario = make_scenario("paper", "planter_3")
    trajectory = record_in_process(make(scenario.params), scenario, tmp_path / "bag")
    (run,) = read_bag(tmp_path / "bag")
    assert run.complete and run.gaps == 0 and run.duplicates == 0 and run.refusals == {}
    assert trajectory_hash(trajectory_of(run)) == trajectory_hash(trajectory)


def test_every_column_survives_the_bag(bag, driven):
    read = trajectory_of(read_bag(bag)[0])
    for field in dataclasses.fields(Trajectory):
        wrote, got = getattr(driven.trajectory, field.name), getattr(read, field.name)
        if field.name in ("soc", "soc_final"):  # the wire's SOC is a float32
            np.testing.assert_array_equal(np.float32(wrote), np.float32(got))
        else:
            np.testing.assert_array_equal(wrote, got)


def test_equal_runs_give_equal_bytes(driven, tmp_path):
    for folder in ("one", "two"):
        write_samples_bag(tmp_path / folder / "bag", driven.samples, {"note": "same"})
    one, two = (
        {path.name: path.read_bytes() for path in (tmp_path / folder / "bag").iterdir()}
        for folder in ("one", "two")
    )
    assert one == two and set(one) == {"bag_0.mcap", "metadata.yaml"}
    assert bag_hash(tmp_path / "one" / "bag") == hashlib.sha256(one["bag_0.mcap"]).hexdigest()


def test_existing_folder_is_refused_and_left_alone(driven, tmp_path):
    (tmp_path / "bag").mkdir()
    (tmp_path / "bag" / "precious").write_text("mine")
    with pytest.raises(BagError, match="exists already"):
        write_samples_bag(tmp_path / "bag", driven.samples, {})
    assert [path.name for path in (tmp_path / "bag").iterdir()] == ["precious"]


def test_trajectory_of_another_powertrain_is_not_written(driven, tmp_path):
    params = driven.scenario.params
    weaker = dataclasses.replace(
        params, battery=dataclasses.replace(params.battery, power_max_w=50e3)
    )
    with pytest.raises(BagError, match="does not reproduce"):
        write_trajectory_bag(tmp_path / "bag", weaker, driven.info, driven.trajectory)
    assert not (tmp_path / "bag").exists()


def test_writer_that_fails_midway_leaves_a_part_and_no_bag(tmp_path):
    channels = {"/power_demand": topics.POWER_DEMAND}
    with (
        pytest.raises(RuntimeError, match="interrupted"),
        BagWriter(tmp_path / "bag", channels, {}),
    ):
        raise RuntimeError("interrupted")
    assert [path.name for path in (tmp_path / "bag").iterdir()] == ["bag_0.mcap.part"]
    with pytest.raises(BagError, match="ems bag recover"):
        read_bag(tmp_path / "bag")


def test_full_disk_is_one_line_and_keeps_what_was_flushed(tmp_path):
    writer = BagWriter(tmp_path / "bag", {"/run_info": topics.RUN_INFO}, {})
    writer.write("/run_info", b"\x00\x01\x00\x00\x01\x00\x00\x00\x00", 1, 1)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (writer.part.stat().st_size, hard))
    try:
        with pytest.raises(RunAborted, match=r"bag_0\.mcap\.part: cannot be written"):
            writer.write("/run_info", bytes(100_000), 2, 2)
        with pytest.raises(RunAborted, match="cannot be written"):
            writer.close()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert sum(recover(tmp_path / "bag").messages.values()) == 1


def test_mcap_has_chunks_an_index_and_valid_crcs(bag):
    file = bag / "bag_0.mcap"
    scan = scan_mcap(file)
    assert scan.chunks > 0 and scan.chunks_without_crc == 0 and scan.data_crc
    assert all(channel.lost == 0 for channel in scan.channels)
    with file.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        assert reader.get_header().profile == "ros2"
        summary = reader.get_summary()
        assert summary is not None and summary.statistics is not None
        assert len(summary.chunk_indexes) == scan.chunks
        count = sum(1 for _ in reader.iter_messages())
        assert count == summary.statistics.message_count


def test_schemas_and_encodings_are_those_of_rosbag2(bag):
    with (bag / "bag_0.mcap").open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    assert {schema.encoding for schema in summary.schemas.values()} == {"ros2msg"}
    assert {channel.message_encoding for channel in summary.channels.values()} == {"cdr"}
    for schema in summary.schemas.values():
        assert schema.data.decode() == definition(schema.name)


def test_metadata_is_rosbag2_version_9_with_qos_hashes_and_provenance(bag, driven):
    document = yaml.safe_load((bag / "metadata.yaml").read_text())
    metadata = document["rosbag2_bagfile_information"]
    assert metadata["version"] == 9 and metadata["storage_identifier"] == "mcap"
    assert metadata["compression_mode"] == "" and metadata["relative_file_paths"] == ["bag_0.mcap"]
    assert metadata["message_count"] == len(driven.samples)
    assert metadata["duration"]["nanoseconds"] == driven.info.dt_ns * driven.info.steps
    by_name = {t["topic_metadata"]["name"]: t for t in metadata["topics_with_message_count"]}
    assert set(by_name) == {f"/{topic.name}" for topic in topics.RECORDED}
    for topic in topics.RECORDED:
        row = by_name[f"/{topic.name}"]["topic_metadata"]
        assert row["type"] == topic.type and row["type_description_hash"] == type_hash(topic.type)
        (qos,) = row["offered_qos_profiles"]
        assert (qos["reliability"], qos["durability"], qos["depth"]) == (
            topic.qos.reliability,
            topic.qos.durability,
            topic.qos.depth,
        )
    custom = metadata["custom_data"]
    assert custom == provenance_of(bag) and custom["recovered"] == "false"
    (announced,) = json.loads(custom["runs"])
    assert announced["powertrain_hash"] == driven.info.powertrain_hash
    assert announced["cycle_hash"] == driven.info.cycle_hash


def test_lone_mcap_file_reads_like_its_folder(bag, driven):
    file = bag / "bag_0.mcap"
    assert trajectory_hash(trajectory_of(read_bag(file)[0])) == trajectory_hash(driven.trajectory)
    assert provenance_of(file) == provenance_of(bag)


def test_independent_reader_sees_qos_types_and_every_message(bag, driven):
    with AnyReader([bag]) as reader:
        assert reader.message_count == len(driven.samples)
        qos = {c.topic: c.ext.offered_qos_profiles[0] for c in reader.connections}
        assert qos["/run_info"].durability is QosDurability.TRANSIENT_LOCAL
        assert qos["/power_demand"].reliability is QosReliability.RELIABLE
        seen = 0
        for connection, _, data in reader.messages():
            reader.deserialize(data, connection.msgtype)
            seen += 1
        assert seen == len(driven.samples)


@pytest.mark.parametrize("name", sorted({topic.type for topic in topics.RECORDED}))
def test_type_hash_is_that_of_the_installed_message_package(name):
    assert type_hash(name) == installed_type_hash(name)


def test_payloads_decode_with_rclpy_and_channels_state_the_packages_hashes(bag, driven):
    decoded = decoded_by_rclpy(bag)
    assert sum(len(messages) for messages in decoded.values()) == len(driven.samples)
    stated = type_hashes_of(bag)
    assert stated == {name: installed_type_hash(name) for name in stated}


def test_resent_samples_and_repeated_answers_are_dropped(driven, write):
    resent = []
    for sample in driven.samples:
        resent += [sample] * (1 if isinstance(sample, RunInfo) else 2)
    (run,) = read_bag(write(resent))
    assert run.duplicates == len(driven.samples) - 1
    assert trajectory_hash(trajectory_of(run)) == trajectory_hash(driven.trajectory)


def test_first_nominal_answer_counts(driven, write):
    other = []
    for sample in driven.samples:
        if isinstance(sample, BatteryPowerCommand):
            stop = BatteryPowerCommand(sample.stamp_ns, 1.0, 0.0, CommandMode.SHUTDOWN)
            late = dataclasses.replace(sample, battery_power_w=12.0)
            other += [stop, sample, late]
        else:
            other.append(sample)
    (run,) = read_bag(write(other))
    assert trajectory_hash(trajectory_of(run)) == trajectory_hash(driven.trajectory)
    assert run.duplicates == len(driven.trajectory)


def test_aborted_run_is_returned_incomplete_with_what_was_driven(driven, write):
    whole = driven.trajectory
    last = driven.info.stamp_ns(20)
    kept = [s for s in driven.samples if isinstance(s, RunInfo) or s.stamp_ns <= last]
    (run,) = read_bag(write(kept))
    assert not run.complete and run.gaps == 0
    part = trajectory_of(run)
    assert len(part) == 20
    np.testing.assert_array_equal(part.battery_power_w, whole.battery_power_w[:20])


def test_missing_step_is_a_gap_and_has_no_trajectory(driven, write):
    hole = driven.info.stamp_ns(10)
    kept = [s for s in driven.samples if not (isinstance(s, PowerDemand) and s.stamp_ns == hole)]
    (run,) = read_bag(write(kept))
    assert run.gaps == 1 and not run.complete
    with pytest.raises(BagError, match="1 steps are missing"):
        trajectory_of(run)


def test_runs_with_equal_stamps_in_one_bag_stay_apart(driven, write):
    second = dataclasses.replace(driven.info, run_id="second")
    first, rest = driven.samples[:1], driven.samples[1:]
    half = driven.samples[: len(driven.samples) // 2]
    # The second run's tick 0 is received before its run_info, which travels on another topic.
    runs = read_bag(write([*half, *rest[:2], second, *rest[2:]]))
    assert [run.info.run_id for run in runs if run.info] == [first[0].run_id, "second"]
    assert [run.complete for run in runs] == [False, True]
    assert runs[0].refusals == {} and runs[1].refusals == {}
    assert trajectory_hash(trajectory_of(runs[1])) == trajectory_hash(driven.trajectory)


def test_run_id_that_comes_back_is_refused(driven, write):
    second = dataclasses.replace(driven.info, run_id="second")
    with pytest.raises(BagError, match="announced twice"):
        read_bag(write([driven.info, *driven.samples[1:5], second, driven.info]))


def test_namespaces_are_tractors_of_their_own(driven, tmp_path):
    write_samples_bag(tmp_path / "one", driven.samples, {}, "/tractor1")
    (run,) = read_bag(tmp_path / "one")
    assert run.namespace == "/tractor1"
    assert trajectory_hash(trajectory_of(run)) == trajectory_hash(driven.trajectory)


def test_find_bags_descends_and_takes_a_bag_for_itself(driven, tmp_path):
    for name in ("b/two", "a/one"):
        write_samples_bag(tmp_path / name, driven.samples, {})
    found = [tmp_path / "a" / "one", tmp_path / "b" / "two"]
    assert find_bags([tmp_path]) == found
    assert find_bags(found) == found
    (tmp_path / "empty").mkdir()
    with pytest.raises(BagError, match="holds no bag"):
        find_bags([tmp_path / "empty"])


def test_reader_gives_the_observations_of_the_live_builder(bag, driven):
    spec = ObservationSpec(filters=(DemandFilter("low_pass", 8.0),))
    observations, refusals = observations_of(read_bag(bag)[0], spec)
    assert not refusals and len(observations) == len(driven.trajectory)
    for k, observation in enumerate(observations):
        assert observation.soc[0] == driven.trajectory.soc_observed[k]
        assert observation.power_demand_w[0] == driven.trajectory.power_demand_w[k]


def test_samples_decode_to_what_was_encoded(bag, driven):
    (run,) = read_bag(bag)
    kept = {
        PowerDemand: run.demand,
        BatteryReading: run.battery,
        PowertrainReading: run.powertrain,
        BatteryPowerCommand: run.command,
    }
    for sample in driven.samples[1:]:
        got = kept[type(sample)][sample.stamp_ns]
        for field in dataclasses.fields(sample):
            wrote, read = getattr(sample, field.name), getattr(got, field.name)
            if field.name in ("voltage_v", "current_a"):
                wrote = float(np.float32(wrote))
            assert read == wrote or (read != read and wrote != wrote)
