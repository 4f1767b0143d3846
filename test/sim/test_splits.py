"""A held-out operation has no other split, whatever the file says."""

import numpy as np
import pytest

from tractor_msgs_py.errors import ConfigError, CycleError
from tractor_sim.duty_cycle.cycle import DutyCycle, cycle_hash
from tractor_sim.duty_cycle.library import generate_cycle, listed_cycles, load_cycle
from tractor_sim.duty_cycle.shipped import (
    hashes_of,
    published_hashes,
    refuse_held_out,
    with_shipped_split,
)
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


def test_every_listed_cycle_is_made_to_the_committed_bytes():
    for row in listed_cycles():
        assert hashes_of(load_cycle(row.name)) == published_hashes()[row.name], row.name


def test_the_list_has_what_learning_and_scoring_need():
    by_split = {split: listed_cycles(split) for split in ("train", "validation", "held_out")}
    assert len(by_split["held_out"]) >= 60
    assert len({row.operation for row in by_split["held_out"]}) >= 4
    assert {f"planter_{seed}" for seed in range(1001, 1013)} <= {
        row.name for row in by_split["validation"]
    }
    assert {"planter", "planter_1", "planter_99"} <= {row.name for row in by_split["train"]}
    assert not {"planter_7", "planter_1013"} & {row.name for row in listed_cycles()}


@pytest.mark.parametrize("name", ["rotary_hoe_2001", "planter_1001", "whtc"])
def test_a_rounded_or_shifted_copy_of_a_listed_cycle_keeps_its_split(name):
    original = load_cycle(name)
    demand_w = np.round(original.power_demand_w) + 4e3
    copy = with_shipped_split(DutyCycle("mine", demand_w, 1.0, "csv"))
    assert (copy.split, copy.operation) == (original.split, original.operation)
    other = with_shipped_split(DutyCycle("mine", demand_w[::-1].copy(), 1.0, "csv"))
    assert (other.split, other.operation) == (None, "csv")


def test_training_on_a_held_out_cycle_is_refused_whatever_it_is_called():
    held_out = load_cycle("baler_2001")
    renamed = DutyCycle("mine", held_out.power_demand_w, 1.0, "csv")
    for cycle in (held_out, renamed):
        with pytest.raises(CycleError, match="baler_2001, a held-out cycle"):
            refuse_held_out(cycle)
    refuse_held_out(load_cycle("planter_1001"))
    refuse_held_out(load_cycle("chisel_plow_1"))


def test_a_deeper_cycle_of_the_same_seed_is_another_and_the_same_one_the_same():
    shallow, deep = (generate_cycle("chisel_plow", 1, depth_cm=depth) for depth in (12, 25))
    assert cycle_hash(shallow) != cycle_hash(deep)
    assert shallow.power_demand_w.mean() < deep.power_demand_w.mean()
    listed = load_cycle("chisel_plow_1")
    assert cycle_hash(generate_cycle("chisel_plow", 1)) == cycle_hash(listed)
    assert listed.split == "train" and listed.area_ha is not None
    listed.power_demand_w[:] = 0.0  # a caller's own copy
    assert load_cycle("chisel_plow_1").power_demand_w.any()


@pytest.mark.parametrize("operation", ["rotary_hoe", "mixed_day", "measured_job_a"])
def test_demand_is_in_whole_watts_so_that_every_machine_has_the_same_bytes(operation):
    demand_w = generate_cycle(operation, 5, duration_s=300).power_demand_w
    assert demand_w.shape == (300,)
    np.testing.assert_array_equal(demand_w, np.rint(demand_w))
