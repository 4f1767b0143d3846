"""Policy files: a round trip to the byte, and one line for everything that is wrong with one."""

import hashlib
import json
import os
import struct
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import save_file

from tractor_ems.drive import drive
from tractor_ems.learning.rewards import RewardConfig, resolve
from tractor_ems.policies.mlp import Mlp
from tractor_ems.policies.policy_file import read_policy_file, write_policy_file
from tractor_ems.policies.q_policy import Normalisation, QPolicy, load_policy, save_policy
from tractor_msgs_py.errors import PolicyError
from tractor_msgs_py.observation import DemandFilter, ObservationSpec
from tractor_sim.config import load_powertrain
from tractor_sim.duty_cycle.library import load_cycle

PAPER = load_powertrain("paper")


@pytest.fixture
def policy() -> QPolicy:
    rng = np.random.default_rng(0)
    return QPolicy(
        name="ddqn_counterfactual",
        spec=ObservationSpec(dt_s=1.0, filters=(DemandFilter("low_pass", 8.0),)),
        params=PAPER,
        reward=resolve(RewardConfig(), PAPER),
        net=Mlp(
            (rng.normal(size=(8, 3)).astype(np.float32), rng.normal(size=(2, 8)).astype("f4")),
            (np.zeros(8, np.float32), np.ones(2, np.float32)),
            "tanh",
        ),
        scaling=Normalisation(143e3, 40e3),
        gamma=0.98,
        metadata={"seed": 3, "bag_hashes": ["ab"], "command_line": "ems train"},
    )


@pytest.fixture
def file(policy: QPolicy, tmp_path: Path) -> Path:
    path = tmp_path / "policy.safetensors"
    save_policy(path, policy)
    return path


def test_a_policy_survives_its_file(policy: QPolicy, file: Path):
    loaded = load_policy(file)
    demand = load_cycle("planter_31").power_demand_w[None, :100]
    a, b = (drive(p, PAPER, demand, 0.85, 0.836)[0] for p in (policy, loaded))
    assert np.array_equal(a.battery_power_w, b.battery_power_w)
    assert (loaded.spec, loaded.params, loaded.reward, loaded.scaling) == (
        policy.spec,
        policy.params,
        policy.reward,
        policy.scaling,
    )
    assert loaded.metadata["bag_hashes"] == ["ab"] and loaded.metadata["seed"] == 3
    assert loaded.metadata["format_version"] == 1


def test_equal_policies_give_equal_bytes_and_so_does_saving_again(file: Path, tmp_path: Path):
    again = tmp_path / "again.safetensors"
    save_policy(again, load_policy(file))
    assert again.read_bytes() == file.read_bytes()


def rewrite(file: Path, **changes: object) -> None:
    """The same file with other metadata or tensors."""
    tensors, data = read_policy_file(file)
    new_tensors = changes.pop("tensors", {})
    assert isinstance(new_tensors, dict)
    for name, tensor in new_tensors.items():
        tensors[name] = tensor
        if tensor is None:
            del tensors[name]
    document = json.dumps(data | changes)
    save_file(tensors, str(file), metadata={"tractor_ems.policy": document})


NAN = np.array([np.nan, 1.0], np.float32)

BAD = {
    "unknown version": ({"format_version": 99}, "format version 99"),
    "unknown kind": ({"kind": "oracle"}, "kind 'oracle'"),
    "hash of another powertrain": ({"powertrain_hash": "0" * 64}, "do not match their hash"),
    "no reward": ({"reward": None}, "metadata is not a policy's"),
    "reward out of range": ({"reward": {"kp": -1.0}}, "reward.kp"),
    "no observation": ({"observation": {}}, "observation spec"),
    "broken powertrain": ({"powertrain": {"name": "x"}}, "powertrain"),
    "layer count": ({"network": {"layers": 3, "activation": "tanh"}}, "expected"),
    "activation": ({"network": {"layers": 2, "activation": "sin"}}, "activation 'sin'"),
    "gamma": ({"gamma": 1.5}, "gamma: 1.5"),
    "NaN weight": ({"tensors": {"layer1.bias": NAN}}, "layer1.bias must be finite"),
    "float64 weight": ({"tensors": {"layer1.bias": np.ones(2)}}, "is float64"),
    "missing tensor": ({"tensors": {"layer1.bias": None}}, "expected"),
    "extra tensor": ({"tensors": {"layer9.bias": np.ones(2, "f4")}}, "expected"),
    "other shapes": ({"tensors": {"layer1.weight": np.ones((2, 7), "f4")}}, "do not fit"),
    "other outputs": (
        {"tensors": {"layer1.weight": np.ones((5, 8), "f4"), "layer1.bias": np.ones(5, "f4")}},
        "to 5 outputs",
    ),
    "no layers": ({"network": {"layers": 0, "activation": "tanh"}}, "allowed whole numbers 1..16"),
    "endless layers": ({"network": {"layers": 10**10, "activation": "tanh"}}, "layers"),
    "no actions": ({"actions": 0}, "actions: 0, allowed whole numbers 2..30000"),
    "endless actions": ({"actions": 10**14}, "actions"),
    "infinite actions": ({"actions": float("inf")}, "actions: inf"),
    "actions as text": ({"actions": "1600"}, "actions: '1600'"),
    "gamma of 400 digits": ({"gamma": 10**400}, "metadata is not a policy's"),
    "other inputs": ({"tensors": {"layer0.weight": np.ones((8, 6), "f4")}}, "maps 6 inputs"),
}


@pytest.mark.parametrize("case", BAD)
def test_a_wrong_policy_file_gets_one_line_that_names_it(case: str, file: Path):
    changes, reason = BAD[case]
    rewrite(file, **changes)
    with pytest.raises(PolicyError) as caught:
        load_policy(file)
    message = str(caught.value)
    assert reason in message and str(file) in message and "\n" not in message


@pytest.mark.parametrize(
    ("section", "field", "value"),
    [
        (None, "dt_s", 0.0),
        ("engine", "fuel_lhv_j_per_kg", -1.0),
        ("engine", "start_fuel_kg", -1.0),
    ],
)
def test_an_embedded_powertrain_is_checked_even_where_its_hash_fits(
    section: str | None, field: str, value: float, file: Path
):
    powertrain = read_policy_file(file)[1]["powertrain"]
    (powertrain[section] if section else powertrain)[field] = value
    text = json.dumps(powertrain, sort_keys=True, separators=(",", ":"))
    rewrite(file, powertrain=powertrain, powertrain_hash=hashlib.sha256(text.encode()).hexdigest())
    with pytest.raises(PolicyError, match=field):
        load_policy(file)


def test_metadata_nested_too_deeply_is_refused(file: Path):
    deep = "[" * 100_000
    save_file({"x": np.ones(3, np.float32)}, str(file), metadata={"tractor_ems.policy": deep})
    with pytest.raises(PolicyError, match="not a policy document"):
        load_policy(file)


def test_a_missing_file_and_a_folder_are_refused(tmp_path: Path):
    for path in (tmp_path / "none.safetensors", tmp_path):
        with pytest.raises(PolicyError, match=str(path)):
            load_policy(path)


def test_every_cut_of_the_file_is_refused(file: Path):
    whole = file.read_bytes()
    for size in [0, 1, 7, 8, 9, 100, len(whole) // 2, len(whole) - 40, len(whole) - 1]:
        file.write_bytes(whole[:size])
        with pytest.raises(PolicyError, match="safetensors"):
            load_policy(file)


def test_foreign_files_are_refused(file: Path):
    for content in (b"PK\x03\x04" + bytes(200), os.urandom(500), struct.pack("<Q", 2) + b"{}"):
        file.write_bytes(content)
        with pytest.raises(PolicyError, match=r"safetensors|not a policy"):
            load_policy(file)
    save_file({"x": np.ones(3, np.float32)}, str(file), metadata={"tractor_ems.policy": "[1]"})
    with pytest.raises(PolicyError, match="not a policy document"):
        load_policy(file)


def test_weights_that_are_not_finite_are_never_written(policy: QPolicy, tmp_path: Path):
    path = tmp_path / "bad.safetensors"
    with pytest.raises(PolicyError, match="nothing written"):
        write_policy_file(path, {"layer0.weight": NAN}, {})
    assert list(tmp_path.iterdir()) == []
