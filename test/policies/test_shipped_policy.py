"""The policy that ships is the one its card describes, and is as good on cycles it never saw."""

import hashlib
from pathlib import Path

import pytest

from tractor_ems.evaluate import evaluate
from tractor_ems.policies.card import card_of, markdown
from tractor_ems.policies.envelope import stored_envelope
from tractor_ems.policies.made import load_made
from tractor_ems.policies.q_policy import load_policy
from tractor_ems.policies.registry import policy_file
from tractor_ems.scenario import make_scenario
from tractor_sim.config import load_powertrain
from tractor_sim.duty_cycle.library import cycle_names
from tractor_sim.duty_cycle.shipped import published_hashes
from tractor_sim.powertrain_json import powertrain_hash

HELD_OUT = Path(__file__).resolve().parents[2] / "docs" / "data" / "held_out.json"
FILE = policy_file("default", "paper")
OTHERS = [path for path in sorted(FILE.parent.glob("*.safetensors")) if path != FILE]
"""Of later powertrains; their cards are generated and their files know what training saw."""


def test_the_card_names_the_file_by_its_hash():
    card = FILE.with_suffix(".md").read_text(encoding="utf-8")
    assert hashlib.sha256(FILE.read_bytes()).hexdigest() in card


@pytest.mark.parametrize("file", OTHERS, ids=lambda path: path.stem)
def test_the_others_know_their_envelope_and_have_the_card_that_the_command_writes(file):
    made = load_made(file)
    assert made.params == load_powertrain(file.stem)
    assert stored_envelope(made.metadata)
    train = {published_hashes()[name].sha256 for name in cycle_names("train")}
    assert made.metadata["cycle_hashes"] and set(made.metadata["cycle_hashes"]) <= train
    page = markdown(card_of(file, HELD_OUT if HELD_OUT.is_file() else None))
    assert file.with_suffix(".md").read_text(encoding="utf-8") == page


def test_it_was_made_for_the_shipped_powertrain_from_training_cycles_alone():
    metadata = load_policy(FILE).metadata
    assert metadata["powertrain_hash"] == powertrain_hash(load_powertrain("paper"))
    train = {published_hashes()[name].sha256 for name in cycle_names("train")}
    assert metadata["cycle_hashes"]
    assert set(metadata["cycle_hashes"]) <= train
    assert len(metadata["bag_hashes"]) == 24


@pytest.mark.parametrize(
    "cycle",
    [
        "planter_1001",
        *(pytest.param(f"planter_{seed}", marks=pytest.mark.slow) for seed in range(1002, 1006)),
    ],
)
def test_it_keeps_its_cards_promise_and_beats_the_rule_base(cycle):
    scenario = make_scenario("paper", cycle, 0.85, 0.836)
    ours, rule_base = (evaluate(name, scenario)[0] for name in ("default", "rule_based"))
    assert 0.9995 <= ours.dp_ratio <= 1.0005
    assert rule_base.dp_ratio < ours.dp_ratio
    assert abs(ours.soc_final - 0.836) <= 0.01
    assert ours.violations == 0
    assert ours.shortfall_j == 0.0
