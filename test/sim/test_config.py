"""Bad powertrain files are refused in one line that names file, field and value."""

import copy
from itertools import pairwise

import pytest
import yaml

from tractor_ems.learning.config import load_train_config
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


CURVE = "engine.curves.optimal_line"
NAMED = [
    ("engine.idle_fuel_kg_per_s", 2.5, "engine.idle_fuel_kg_per_s: 2.5", "< 0.00052878"),
    ("battery.ocv_v.3", 100.0, "battery.ocv_v.3: 100.0", ">= 640.44"),
    ("battery.ocv_v.3", -1.0, "battery.ocv_v.3: ", "greater than 0 (got -1.0)"),
    ("battery.ocv_soc.3", 0.9, "battery.ocv_soc.4: 0.35", "> 0.9"),
    ("battery.ocv_soc.24", 0.79, "battery.ocv_soc.24: 0.79", "> 0.825"),
    (f"{CURVE}.power_w.3", 1.0, f"{CURVE}.power_w.3: 1.0", "> 15000.0"),
    (f"{CURVE}.power_w.54", 275001.0, f"{CURVE}.power_w.54: 275001.0", "275000.0"),
    (f"{CURVE}.power_w", [1.0, 2.0], f"{CURVE}.power_w: 2 entries", "55"),
    (f"{CURVE}.fuel_kg_per_s.3", 1e-5, f"{CURVE}.fuel_kg_per_s.3: 1e-05", "> 0.000468384"),
    ("engine.curve", "nosuch", "engine.curve: 'nosuch'", "fixed_1800_rpm, optimal_line"),
    ("engine.curves", {}, "engine.curves, engine.curve_power_w: none given", "either"),
    ("engine", None, "engine: nothing", "a mapping"),
    ("battery", {}, "battery.energy_j: is missing", "4 more"),
    ("generator.curve_efficiency.3", 0.0, "generator.curve_efficiency.3: ", "greater than 0"),
]
"""What the field tractor's file has changed, and the field, value and range a reader is told."""


@pytest.mark.parametrize(("dotted", "value", "start", "allowed"), NAMED)
def test_a_wrong_curve_is_refused_with_its_entry_its_value_and_the_range(
    tmp_path, dotted, value, start, allowed
):
    document = yaml.safe_load(resource_path("config", "powertrain", "field.yaml").read_text())
    *parents, last = (int(part) if part.isdigit() else part for part in dotted.split("."))
    place = document
    for parent in parents:
        place = place[parent]
    place[last] = value
    message = refused(tmp_path, document)
    assert f"mine.yaml: {start}" in message and allowed in message
    assert "{'" not in message and "_Engine" not in message and len(message) < 300


@pytest.mark.parametrize(
    ("field", "k", "value", "allowed"),
    [
        ("curve_efficiency", 1, 1.0, "0 < value < 1"),
        ("curve_power_w", 0, 1.0, "allowed 0"),
        ("curve_power_w", 2, 0.0, "> "),
    ],
)
def test_a_wrong_efficiency_curve_is_refused_with_its_entry(
    tmp_path, document, field, k, value, allowed
):
    document["engine"][field][k] = value
    message = refused(tmp_path, document)
    assert f"engine.{field}.{k}: {value}" in message and allowed in message


@pytest.mark.parametrize("text", ["", "---\n", "[]", "5", "diesel"])
def test_a_file_that_holds_no_settings_is_refused_in_words_of_the_reader(tmp_path, text):
    path = tmp_path / "mine.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError, match="allowed a mapping of names to values") as caught:
        load_powertrain(path)
    assert "_Powertrain" not in str(caught.value)


def test_text_that_is_not_yaml_is_refused(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text("engine: [1,\n  {")
    with pytest.raises(ConfigError, match="not YAML"):
        load_powertrain(path)


def test_a_powertrain_that_never_saw_the_schema_meets_the_same_ranges():
    """A policy file embeds its powertrain as JSON; no YAML schema stands in front of that."""
    whole = params_to_json(load_powertrain("paper"))
    for section, field, value in [
        ("engine", "fuel_lhv_j_per_kg", -1.0),
        ("engine", "idle_fuel_kg_per_s", float("nan")),
        ("engine", "min_off_s", float("inf")),
        ("engine", "ramp_w_per_s", -5.0),
        ("engine", "curve_power_w", [0.0, float("nan"), 275e3]),
        (None, "dt_s", 0.0),
        (None, "dt_s", float("nan")),
        (None, "p_aux_w", float("inf")),
        (None, "p_aux_w", 10**400),
        (None, "soc_target", 2.0),
    ]:
        data = copy.deepcopy(whole)
        (data[section] if section else data)[field] = value
        with pytest.raises(ConfigError, match="int too large" if value == 10**400 else field):
            params_from_json(data)


NOT_SETTINGS = {
    "a month 13": ("name: 2023-13-01", "cannot be read"),
    "too many digits": (f"dt_s: {'9' * 5000}", "cannot be read"),
    "too many hexadecimal digits": (f"seed: 0x{'f' * 9000}", "thousands of digits"),
    "deep nesting": ("name: " + "[" * 5000, "nested more than 32 deep"),
    "nested aliases": (
        "a: &a [1]\n"
        + "".join(f"{b}: &{b} [{f'*{a}, ' * 9}]\n" for a, b in pairwise("abcdefghi")),
        "alias *a, no aliases",
    ),
    "a large file": ("#" * 2_000_000, "bytes a settings file may have"),
    "text of no encoding": (None, "cannot be read"),
}


@pytest.mark.parametrize("case", NOT_SETTINGS)
@pytest.mark.parametrize("load", [load_powertrain, load_train_config])
def test_no_yaml_content_ends_in_a_traceback(case, load, tmp_path):
    text, reason = NOT_SETTINGS[case]
    path = tmp_path / "mine.yaml"
    if text is None:
        path.write_bytes(b"\xff\xfe\xfd")
    else:
        path.write_text(text)
    with pytest.raises(ConfigError) as caught:
        load(path)
    message = str(caught.value)
    assert "mine.yaml" in message and "\n" not in message and len(message) < 500
    assert reason in message


def test_an_unknown_name_lists_the_shipped_ones():
    with pytest.raises(ConfigError, match="paper"):
        load_powertrain("papre")


def test_parameters_survive_json_and_keep_their_hash():
    params = load_powertrain("paper")
    again = params_from_json(params_to_json(params))
    assert again == params
    assert powertrain_hash(again) == powertrain_hash(params)
