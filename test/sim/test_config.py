"""Bad powertrain files are refused in one line that names file, field and value."""

import pytest
import yaml

from tractor_msgs_py.errors import ConfigError
from tractor_sim.config import load_powertrain
from tractor_sim.powertrain_json import params_from_json, params_to_json, powertrain_hash
from tractor_sim.resources import resource_path


@pytest.fixture
def document():
    return yaml.safe_load(resource_path("config", "powertrain", "paper.yaml").read_text())


def refused(tmp_path, document):
    path = tmp_path / "mine.yaml"
    path.write_text(yaml.safe_dump(document))
    with pytest.raises(ConfigError) as caught:
        load_powertrain(path)
    assert "\n" not in str(caught.value)
    assert "mine.yaml" in str(caught.value)
    return str(caught.value)


def test_an_unknown_key_is_refused(tmp_path, document):
    document["battery"]["capasity"] = 1.0
    assert "battery.capasity" in refused(tmp_path, document)


def test_a_negative_capacity_is_refused_with_its_value(tmp_path, document):
    document["battery"]["energy_j"] = -5.0
    message = refused(tmp_path, document)
    assert "battery.energy_j" in message and "-5.0" in message


@pytest.mark.parametrize(
    ("section", "field", "value"),
    [
        ("battery", "soc_min", 0.95),
        ("battery", "power_max_w", float("nan")),
        ("engine", "curve_efficiency", [0.1, 1.4]),
        ("engine", "curve_power_w", [0.0, 275e3]),
        ("engine", "fuel_lhv_j_per_kg", "diesel"),
        (None, "soc_initial", 0.2),
        (None, "dt_s", 0.0),
        (None, "name", "a b"),
    ],
)
def test_values_out_of_range_are_refused(tmp_path, document, section, field, value):
    (document[section] if section else document)[field] = value
    assert field in refused(tmp_path, document)


def test_text_that_is_not_yaml_is_refused(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text("engine: [1,\n  {")
    with pytest.raises(ConfigError, match="not YAML"):
        load_powertrain(path)


def test_an_unknown_name_lists_the_shipped_ones():
    with pytest.raises(ConfigError, match="paper"):
        load_powertrain("papre")


def test_parameters_survive_json_and_keep_their_hash():
    params = load_powertrain("paper")
    again = params_from_json(params_to_json(params))
    assert again == params
    assert powertrain_hash(again) == powertrain_hash(params)
