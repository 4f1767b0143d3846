"""A table of values as a policy: what it reads off the table, and its file."""

import dataclasses

import numpy as np
import pytest
from policies.work import FIELD, driven

from tractor_ems.policies.made import load_made
from tractor_ems.policies.policy_file import write_policy_file
from tractor_ems.policies.sdp import SdpPolicy, _between
from tractor_ems.policies.sdp_file import save_sdp
from tractor_msgs_py.errors import PolicyError
from tractor_msgs_py.observation import DemandFilter
from tractor_msgs_py.trajectory import trajectory_hash

OFFSET = np.linspace(-0.25, 0.25, 21)
WORK_W = np.where(np.arange(240) % 80 < 50, 30e3, 110e3)


def table(times_s=(0.0, 60.0, 240.0), stand=0.0):
    """SOC errors cost more the nearer the end is; standing is worth ``stand`` [kg] less."""
    rng = np.random.Generator(np.random.PCG64(5))
    value = np.zeros((len(times_s), 4, len(OFFSET), 2))
    for k, time_s in enumerate(times_s):
        value[k] = 16.0 / (1.0 + time_s / 60.0) * OFFSET[None, :, None] ** 2
    value += rng.normal(0.0, 1e-4, value.shape)
    value[..., 0] += stand
    return SdpPolicy(
        params=FIELD,
        filters=(DemandFilter("low_pass", 20.0),),
        edges=(np.array([70e3]), np.array([60e3])),
        number=np.arange(4),
        times_s=np.array(times_s),
        offset=OFFSET,
        value_kg=value.astype(np.float32).astype(float),
        price_kg=8.0,
        start_kg=0.015,
        gamma=1.0,
    )


def test_between_two_times_left_both_tables_count():
    k, share = _between(np.array([0.0, 50.0, 200.0]), np.array([-1.0, 0.0, 40.0, 50.0, 125.0]))
    assert k.tolist() == [0, 0, 0, 1, 1]
    assert share.tolist() == pytest.approx([0.0, 0.0, 0.8, 0.0, 0.5])


def test_a_time_left_beyond_the_last_table_counts_as_that():
    k, share = _between(np.array([0.0, 50.0, 200.0]), np.array([200.0, 1e6, np.inf]))
    assert np.all(k + share == 2.0)
    assert np.all(_between(np.array([0.0]), np.array([0.0, np.inf])) == 0.0)


def test_an_engine_that_is_dear_to_have_on_stands():
    (stands,) = driven(table(stand=-0.5), WORK_W[:60])
    (runs,) = driven(table(stand=0.5), WORK_W[:60])
    assert not stands.engine_on[:50].any() and runs.engine_on[2:].all()


def test_a_batch_acts_like_its_members():
    batch_w = np.stack([WORK_W[:100], WORK_W[100:200]])
    for demand_w, run in zip(batch_w, driven(table(), batch_w), strict=True):
        assert trajectory_hash(driven(table(), demand_w)[0]) == trajectory_hash(run)


def test_a_policy_drives_alike_after_its_file(tmp_path):
    policy = dataclasses.replace(table(), metadata={"seed": 3})
    save_sdp(tmp_path / "a.safetensors", policy)
    save_sdp(tmp_path / "b.safetensors", policy)
    assert (tmp_path / "a.safetensors").read_bytes() == (tmp_path / "b.safetensors").read_bytes()
    read = load_made(tmp_path / "a.safetensors")
    assert (read.name, read.metadata["seed"], read.params) == ("sdp", 3, FIELD)
    runs = [driven(p, WORK_W)[0] for p in (policy, read)]
    assert trajectory_hash(runs[0]) == trajectory_hash(runs[1])


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"times_s": np.array([0.0, 60.0])}, "value table"),
        ({"offset": OFFSET[::-1]}, "offset must be"),
        ({"number": np.arange(3)}, "cells"),
        ({"edges": (np.array([70e3, 70e3]), np.zeros(0))}, "cells"),
        ({"times_s": np.array([0.0, 60.0, 60.0])}, "times_s must be"),
    ],
)
def test_a_table_that_does_not_fit_is_refused(change, named):
    with pytest.raises(PolicyError, match=named):
        dataclasses.replace(table(), **change)


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"name": "best"}, "name 'best'"),
        ({"times_s": None}, "metadata"),
        ({"price_kg": "dear"}, "metadata"),
        ({"edges_w": [[1.0]]}, "cells"),
        ({"edges_w": [[[1.0, 2.0]], []]}, "edges_w: shape"),
        ({"times_s": [-5.0]}, "times_s: -5.0, must be >= 0"),
        ({"name": "sdp_unplanned", "times_s": [0.0, 1.0]}, "sdp_unplanned cannot have"),
        ({"offset": [-0.2, 0.0, 0.1]}, "offset: must be evenly spaced"),
        ({"gamma": 1.5}, "gamma: 1.5, allowed 0..1"),
        ({"start_kg": -1.0}, "start_kg: -1.0, allowed"),
        ({"name": "x" * 10**6}, "name 'xxx"),
        ({"envelope": {"soc": [1.0]}}, "envelope: expected"),
    ],
)
def test_a_damaged_file_is_refused(tmp_path, change, named):
    path = tmp_path / "sdp.safetensors"
    save_sdp(path, table())
    metadata = load_made(path).metadata
    tensors = {
        "value_kg": table().value_kg.astype(np.float32),
        "number": np.arange(4, dtype=np.float32),
    }
    write_policy_file(path, tensors, {**metadata, **change})
    with pytest.raises(PolicyError, match=named) as caught:
        load_made(path)
    assert len(str(caught.value)) < 2000
