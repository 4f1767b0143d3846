"""Bags made to exhaust or mislead their reader: refused in one line, within small memory."""

import dataclasses
import hashlib
import json

import pytest
import yaml
import zstandard
from mcap.writer import CompressionType, Writer

from tractor_ems.bags import chunk_limit
from tractor_ems.bags.chunk_limit import MAX_CHUNK_BYTES
from tractor_ems.bags.in_process import record_in_process, write_samples_bag
from tractor_ems.bags.inspect import info
from tractor_ems.bags.plain_yaml import parse_yaml
from tractor_ems.bags.read import bag_hash, provenance_of, read_bag
from tractor_ems.bags.scan import scan_mcap
from tractor_ems.bags.transitions import iter_traces
from tractor_ems.policies.rules import RuleBased
from tractor_msgs_py.errors import BagError
from tractor_msgs_py.types import PowerDemand


def mcap_of(path, compression, message_bytes):
    """One chunk with one message of zeros."""
    with path.open("wb") as file:
        writer = Writer(file, compression=compression, chunk_size=1 << 30)
        writer.start(profile="ros2")
        schema = writer.register_schema("std_msgs/msg/String", "ros2msg", b"string data")
        channel = writer.register_channel("/power_demand", "cdr", schema)
        writer.add_message(channel, 1, bytes(message_bytes), 1)
        writer.finish()
    return path


@pytest.mark.parametrize("compression", [CompressionType.ZSTD, CompressionType.LZ4])
def test_a_chunk_that_says_it_is_too_large_is_refused(tmp_path, compression):
    path = mcap_of(tmp_path / "x.mcap", compression, MAX_CHUNK_BYTES + 1)
    assert path.stat().st_size < MAX_CHUNK_BYTES / 100
    for read in (read_bag, scan_mcap):
        with pytest.raises(BagError, match=f"allowed {MAX_CHUNK_BYTES}"):
            read(path)


@pytest.mark.parametrize("compression", [CompressionType.ZSTD, CompressionType.LZ4])
def test_a_chunk_that_expands_further_than_it_says_is_refused(tmp_path, compression):
    path = mcap_of(tmp_path / "x.mcap", compression, MAX_CHUNK_BYTES + 1)
    content = bytearray(path.read_bytes())
    true_size, said = chunk_size_of(content), (1000).to_bytes(8, "little")
    for start in (content.find(true_size), content.rfind(true_size)):
        content[start : start + 8] = said
    path.write_bytes(content)
    for read in (read_bag, scan_mcap):
        with pytest.raises(BagError, match="expands further"):
            read(path)


def chunk_size_of(content):
    """The eight bytes that say the chunk's size: first in its header, last in its index."""
    for size in range(MAX_CHUNK_BYTES, MAX_CHUNK_BYTES + 1000):
        if content.count(size.to_bytes(8, "little")) >= 2:
            return size.to_bytes(8, "little")
    raise AssertionError("no chunk size")


def test_frames_in_a_row_are_counted_together(monkeypatch):
    monkeypatch.setattr(chunk_limit, "MAX_CHUNK_BYTES", 1000)
    frames = zstandard.compress(bytes(600)) * 2
    assert chunk_limit._expands_too_far(b"zstd", frames)
    assert not chunk_limit._expands_too_far(b"zstd", frames[: len(frames) // 2])


def test_an_index_that_leads_elsewhere_is_refused(bag, tmp_path):
    content = bytearray((bag / "bag_0.mcap").read_bytes())
    entry = content.rindex(b"\x04\x00\x00\x00zstd")
    content[entry + 16] ^= 1
    (tmp_path / "x.mcap").write_bytes(content)
    with pytest.raises(BagError, match="index names no chunk"):
        read_bag(tmp_path / "x.mcap")


def test_aliases_of_aliases_are_refused_and_plain_ones_are_not():
    levels = [f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 9)}]" for k in range(1, 20)]
    with pytest.raises(BagError, match="here: aliases expand"):
        parse_yaml("\n".join(["a0: &a0 x", *levels]), "here")
    with pytest.raises(BagError, match="here: aliases expand"):
        parse_yaml("&a [*a]", "here")
    assert parse_yaml("[&a {sec: 1}, *a]", "here") == [{"sec": 1}, {"sec": 1}]


@pytest.mark.parametrize(
    "text",
    ["a: 2023-13-01", pytest.param("[" * 5000, marks=pytest.mark.slow), "a: 1" + "0" * 5000],
)
def test_yaml_that_no_parser_takes_is_one_line(text):
    with pytest.raises(BagError, match=r"^here: ") as caught:
        parse_yaml(text, "here")
    assert "\n" not in str(caught.value)


def changed_metadata(bag, **values):
    path = bag / "metadata.yaml"
    document = yaml.safe_load(path.read_text())
    document["rosbag2_bagfile_information"] |= values
    path.write_text(yaml.safe_dump(document))


def test_provenance_is_what_the_hash_covers(driven, tmp_path):
    path = tmp_path / "bag"
    write_samples_bag(path, driven.samples, {f"policy:{driven.info.run_id}": "rule_based"})
    before = provenance_of(path)
    changed_metadata(path, custom_data={f"policy:{driven.info.run_id}": "dp"})
    assert provenance_of(path) == before
    assert read_bag(path)[0].policy == "rule_based"


@pytest.mark.parametrize("names", [["other.mcap.bin"], ["bag_0.mcap", "bag_0.mcap"], []])
def test_metadata_cannot_have_another_file_read_than_the_hashed_one(driven, tmp_path, names):
    path = tmp_path / "bag"
    write_samples_bag(path, driven.samples, {})
    (path / "other.mcap.bin").write_bytes((path / "bag_0.mcap").read_bytes())
    changed_metadata(path, relative_file_paths=names)
    with pytest.raises(BagError, match=r"metadata\.yaml names"):
        read_bag(path)


def test_a_bag_compressed_outside_its_storage_is_refused(driven, tmp_path):
    path = tmp_path / "bag"
    write_samples_bag(path, driven.samples, {})
    changed_metadata(path, compression_format="zstd", compression_mode="MESSAGE")
    with pytest.raises(BagError, match="compression_mode 'message'"):
        read_bag(path)


def test_a_run_announced_as_endless_costs_no_more_than_what_was_recorded(driven, write):
    endless = dataclasses.replace(driven.info, steps=10_000_000)
    (run,) = read_bag(write([endless, *driven.samples[1:]]))
    assert not run.complete and run.gaps == 0
    assert sum(run.driven) == driven.info.steps and len(run.driven) <= driven.info.steps + 1
    assert info_steps(write([endless, *driven.samples[1:]], "again")) == 10_000_000


def info_steps(path):
    (run,) = info(path)["runs"]
    json.dumps(run, allow_nan=False)
    return run["steps"]


def test_a_real_time_run_without_demand_is_no_crash(driven, write):
    first = dataclasses.replace(driven.info, lockstep=False)
    second = dataclasses.replace(first, run_id="silent")
    silent = [s for s in driven.samples[1:] if not isinstance(s, PowerDemand)]
    runs = read_bag(write([first, *driven.samples[1:], second, *silent]))
    assert [len(run.driven) for run in runs] == [driven.info.steps, 0]


@pytest.mark.parametrize("make", ["folder", "dangling"])
def test_something_else_with_the_name_of_a_bag_is_one_line(tmp_path, make):
    thing = tmp_path / "x.mcap"
    if make == "folder":
        thing.mkdir()
    else:
        thing.symlink_to(tmp_path / "nothing")
    for read in (bag_hash, info, lambda path: iter_traces([path])):
        with pytest.raises(BagError, match=r"x\.mcap"):
            read(tmp_path)


def test_an_in_process_bag_names_the_command_line_without_a_folder(driven, tmp_path, monkeypatch):
    monkeypatch.setattr("sys.argv", ["/opt/some/bin/ems", "run", "--policy", "rule_based"])
    path = tmp_path / "bag"
    record_in_process(RuleBased(driven.scenario.params), driven.scenario, path)
    assert provenance_of(path)["command_line"] == "ems run --policy rule_based"
    (run,) = read_bag(path)
    assert run.info.command_line == "ems run --policy rule_based"
    assert bag_hash(path) == hashlib.sha256((path / "bag_0.mcap").read_bytes()).hexdigest()
