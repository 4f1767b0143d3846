"""A policy's card says what its file says, the same each time, and where the policy's use ends."""

import json
from dataclasses import replace

import pytest

from tractor_ems.cli import main
from tractor_ems.policies.card import card_of, limits_of, markdown
from tractor_ems.policies.q_policy import load_policy, save_policy
from tractor_ems.policies.shipped import shipped_policy
from tractor_msgs_py.errors import ConfigError

PAPER = shipped_policy("paper")
ENVELOPE = {"power_demand_w": [-2e4, 2.5e5], "feature0": [1e4, 2e5], "soc": [0.7, 0.9]}


@pytest.fixture
def policy_with(tmp_path):
    """The shipped policy with other metadata, in a file of its own."""

    def make(**metadata):
        shipped = load_policy(PAPER)
        path = tmp_path / "mine.safetensors"
        save_policy(path, replace(shipped, metadata={**shipped.metadata, **metadata}))
        return path

    return make


def test_it_says_what_the_file_says_whatever_folder_it_is_in(policy_with, tmp_path):
    path = policy_with(envelope=ENVELOPE, seed=7)
    card, data = card_of(path), load_policy(path).metadata
    assert (card.powertrain, card.powertrain_hash) == ("paper", data["powertrain_hash"])
    assert list(card.bag_hashes) == data["bag_hashes"] and list(card.cycles) == data["cycles"]
    assert (card.seed, card.command_line) == (7, data["command_line"])
    page = markdown(card)
    assert page == markdown(card_of(path)) and str(tmp_path) not in page
    ranges = ("| power_demand_w | -20.0 kW | 250.0 kW |", "| soc | 0.700 | 0.900 |")
    hashes = [item[:12] for item in card.bag_hashes]
    for text in (card.sha256, *ranges, "demand, low pass of 8 s", *hashes):
        assert text in page


def test_a_file_without_an_envelope_says_that_nobody_is_warned(policy_with):
    limits = " ".join(limits_of(card_of(PAPER)))
    assert "no envelope" in limits and "no planned end" in limits
    assert "outside_envelope" in " ".join(limits_of(card_of(policy_with(envelope=ENVELOPE))))


def test_a_policy_with_a_planned_end_says_how_far_it_looks():
    card = replace(card_of(PAPER), horizon_s=3600.0)
    assert "planned end up to 3600 s" in markdown(card)
    assert "farthest it knows, 3600 s" in " ".join(limits_of(card))


def test_scores_come_from_beside_the_file_or_from_its_metadata(policy_with, tmp_path):
    path = policy_with(scores={"median": 0.99})
    assert card_of(path).scores == {"median": 0.99}
    beside = tmp_path / "mine.scores.json"
    mine = {"median": 0.996, "ci95": [0.995, 0.997], "worst": None}
    study = {"policies": {"ddqn_counterfactual": mine, "sdp": {}}}
    study["per_operation"] = {"ddqn_counterfactual": {"baler": {"median": 0.993, "worst": 0.98}}}
    beside.write_text(json.dumps(study))
    card = card_of(path)
    assert card.scores == mine
    assert "| baler | 0.993 | 0.98 | - | - |" in markdown(card)
    assert "| ci95 | 0.995 .. 0.997 |" in markdown(card) and "| worst | - |" in markdown(card)
    assert "No scores" not in markdown(card)
    beside.write_text(json.dumps({"policies": {"sdp": {}}}))
    with pytest.raises(ConfigError, match="no scores of policy ddqn_counterfactual"):
        card_of(path)
    beside.write_text("{")
    with pytest.raises(ConfigError, match=r"mine\.scores\.json: cannot be read as JSON"):
        card_of(path)


def test_the_command_prints_writes_and_answers_programs(capsys, tmp_path):
    assert main(["policy", "card", "paper"]) == 0
    page = capsys.readouterr().out
    assert page.startswith("# Policy card: `paper.safetensors`\n")
    out = tmp_path / "card.md"
    assert main(["policy", "card", str(PAPER), "--out", str(out), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert out.read_text(encoding="utf-8") == page
    assert document["kind"] == "ddqn_counterfactual" and len(document["limits"]) >= 4
    assert document["envelope"] is None and document["out"] == str(out)


@pytest.mark.parametrize("name", ["wheel_loader", "none.safetensors"])
def test_what_is_no_policy_is_one_line_and_code_2(capsys, name):
    assert main(["policy", "card", name]) == 2
    captured = capsys.readouterr()
    assert captured.out == "" and captured.err.count("\n") == 1 and name in captured.err
