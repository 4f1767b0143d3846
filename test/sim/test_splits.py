"""A held-out operation has no other split, whatever the file says."""

import pytest

from tractor_msgs_py.errors import ConfigError
from tractor_sim.duty_cycle.library import listed_cycles, load_cycle
from tractor_sim.duty_cycle.shipped import hashes_of, published_hashes
from tractor_sim.duty_cycle.splits import read_splits


def write(tmp_path, text):
    path = tmp_path / "splits.yaml"
    path.write_text(text)
    return path


def test_a_list_is_read_in_the_order_train_validation_held_out(tmp_path):
    rows = read_splits(
        write(
            tmp_path,
            "operations:\n"
            "  baler: {held_out: [5, 6]}\n"
            "  chisel_plow: {validation: [9, 9], train: [1, 2]}\n"
            "published: {whtc: validation}\n",
        )
    )
    assert [row.name for row in rows] == [
        "chisel_plow_1",
        "chisel_plow_2",
        "chisel_plow_9",
        "whtc",
        "baler_5",
        "baler_6",
    ]


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("operations: {baler: {held_out: [1, 2], train: [3, 4]}}", "operations.baler"),
        ("operations: {baler: {held_out: [1, 2], validation: [3, 4]}}", "no other split"),
        ("operations: {baler: {train: [1, 5], validation: [5, 6]}}", "seed 5"),
        ("operations: {baler: {train: [5, 1]}}", "[5, 1]"),
        ("operations: {baler: {train: [0, 99999]}}", "10000"),
        ("operations: {baler: {}}", "no split"),
        ("operations: {baler: {training: [1, 2]}}", "training"),
        ("operations: {baler: {train: [-1, 2]}}", "-1"),
        ("operations: {}\nseeds: 3", "seeds"),
        ("published: {whtc: train}", "operations"),
    ],
)
def test_a_wrong_list_is_refused_by_field(tmp_path, text, named):
    with pytest.raises(ConfigError) as caught:
        read_splits(write(tmp_path, text + "\n"))
    assert named in str(caught.value) and "splits.yaml" in str(caught.value)


def test_no_operation_has_both_training_and_held_out_cycles():
    held_out = {row.operation for row in listed_cycles("held_out")}
    other = {row.operation for split in ("train", "validation") for row in listed_cycles(split)}
    assert not held_out & other


def test_no_training_or_validation_cycle_is_a_held_out_one_by_hash():
    by_name = published_hashes()
    held_out = [by_name[row.name] for row in listed_cycles("held_out")]
    rest = [by_name[row.name] for split in ("train", "validation") for row in listed_cycles(split)]
    for kind in ("sha256", "fingerprint"):
        ours = {getattr(h, kind) for h in held_out}
        assert not ours & {getattr(h, kind) for h in rest}
        assert len(ours) == len(held_out)
        assert len({getattr(h, kind) for h in rest}) == len(rest)


def test_one_cycle_of_every_operation_is_made_to_the_committed_bytes():
    first = {row.operation: row.name for row in reversed(listed_cycles())}
    for name in first.values():
        assert hashes_of(load_cycle(name)) == published_hashes()[name], name


@pytest.mark.slow
def test_every_listed_cycle_is_made_to_the_committed_bytes():
    for row in listed_cycles():
        assert hashes_of(load_cycle(row.name)) == published_hashes()[row.name], row.name
