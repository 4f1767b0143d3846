"""``default`` is the policy that ships for the powertrain at hand, on every way to it."""

from dataclasses import replace

import numpy as np
import pytest

from tractor_ems.evaluate import evaluate
from tractor_ems.learning.rewards import RewardConfig
from tractor_ems.nodes import ddqn_policy
from tractor_ems.policies import shipped
from tractor_ems.policies.envelope import envelope_of
from tractor_ems.policies.mlp import Mlp
from tractor_ems.policies.q_policy import Normalisation, QPolicy, save_policy
from tractor_ems.policies.registry import make_policy, node_of, policy_file
from tractor_ems.policies.shipped import shipped_policy
from tractor_ems.scenario import make_scenario
from tractor_msgs_py.errors import ConfigError, PolicyError
from tractor_msgs_py.observation import ObservationSpec
from tractor_sim.config import load_powertrain
from tractor_sim.powertrain_json import powertrain_hash

FIELD = load_powertrain("field")
SPEC = ObservationSpec(dt_s=1.0)


@pytest.fixture
def shipping(tmp_path, monkeypatch):
    """A folder that ships one policy, made by hand, for ``field``; returns its file."""
    file = tmp_path / "policy" / "field.safetensors"
    file.parent.mkdir()
    weights = (np.zeros((4, 2), np.float32), np.zeros((2, 4), np.float32))
    net = Mlp(weights, (np.zeros(4, np.float32), np.zeros(2, np.float32)))
    policy = QPolicy(
        name="ddqn_counterfactual",
        spec=SPEC,
        params=FIELD,
        reward=RewardConfig(),
        net=net,
        scaling=Normalisation(1e5, 1e5),
        gamma=0.99,
        metadata={"envelope": envelope_of(SPEC, [np.array([2e4, 2e5])], 1.0)},
    )
    save_policy(file, policy)
    monkeypatch.setattr(shipped, "resource_path", lambda kind, *parts: tmp_path.joinpath(*parts))
    return file


@pytest.fixture
def field_run(tmp_path):
    path = tmp_path / "short.csv"
    path.write_text("time_s,power_demand_w\n0,50e3\n1,60e3\n2,55e3\n")
    return str(path)


def values(**given):
    defaults = {parameter.name: parameter.default for parameter in ddqn_policy.PARAMETERS}
    return {**defaults, "signals": "", **given}


def test_the_paper_powertrain_has_one():
    assert shipped_policy("paper") == policy_file("default", "paper")
    assert shipped_policy("paper").is_file()


@pytest.mark.parametrize("name", ["wheel_loader", "", "../policy/paper", "paper.safetensors"])
def test_a_powertrain_without_one_is_told_which_have(name):
    with pytest.raises(PolicyError, match=r"none ships for powertrain .*only for .*paper"):
        shipped_policy(name)


def test_it_is_found_by_the_name_of_the_powertrain(shipping, field_run):
    assert policy_file("default", "field") == shipping
    scenario = make_scenario("field", field_run)
    assert make_policy("default", scenario).params == FIELD
    result, _ = evaluate("default", scenario, with_dp=False)
    assert result.powertrain == "field" and result.violations == 0
    executable, parameters = node_of("default", scenario)
    assert (executable, parameters["policy_file"]) == ("ddqn_policy", str(shipping.resolve()))


def test_changed_settings_get_the_same_file_and_are_refused_by_its_hash(shipping, field_run):
    scenario = make_scenario("field:engine.start_fuel_kg=0.06", field_run)
    with pytest.raises(PolicyError, match="was made for powertrain field"):
        make_policy("default", scenario)
    assert make_policy("default", scenario, allow_other_powertrain=True).params == FIELD


def test_the_node_takes_it_by_name_with_its_envelope(shipping):
    setup = ddqn_policy.prepare(values(powertrain="field"))
    assert (setup.params, setup.powertrain_hash) == (FIELD, powertrain_hash(FIELD))
    assert setup.envelope == {"power_demand_w": (2e4, 2e5)}
    assert ddqn_policy.prepare(values(policy_file=str(shipping))).params == FIELD


def test_an_older_file_has_no_envelope_and_is_driven_all_the_same():
    assert ddqn_policy.prepare(values(powertrain="paper")).envelope is None


def test_without_either_the_run_says_it_and_a_vehicle_cannot():
    assert ddqn_policy.prepare(values()) is None
    with pytest.raises(ConfigError, match="parameter powertrain: '', a vehicle does not say"):
        ddqn_policy.prepare(values(signals="mine.yaml"))


def test_a_file_and_a_powertrain_together_are_refused(shipping):
    with pytest.raises(ConfigError, match="not allowed beside policy_file"):
        ddqn_policy.prepare(values(policy_file=str(shipping), powertrain="field"))


def test_a_damaged_envelope_stops_the_node(shipping):
    policy = ddqn_policy.prepare(values(powertrain="field")).policy
    save_policy(shipping, replace(policy, metadata={**policy.metadata, "envelope": {"soc": [1]}}))
    with pytest.raises(PolicyError, match="envelope"):
        ddqn_policy.prepare(values(powertrain="field"))
