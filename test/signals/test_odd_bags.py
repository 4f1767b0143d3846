"""Bags that no vehicle of ours would write: foreign names, empty stamps, equal times."""

import json
from pathlib import Path

import pytest

from tractor_ems.bags.rosbags_messages import RosbagsMessages, serialize, typestore
from tractor_ems.bags.sampled import series_of
from tractor_ems.bags.sampled_traces import iter_sampled_traces
from tractor_ems.bags.write import BagWriter
from tractor_ems.cli import main
from tractor_ems.scenario import make_scenario
from tractor_ems.signals.config import load_signal_map
from tractor_msgs_py.errors import BagError
from tractor_msgs_py.topics import JOINT_STATE, Topic

BAGS = Path(__file__).resolve().parents[2] / "bags"
FLOAT64 = "std_msgs/msg/Float64"


def number(value: float) -> bytes:
    return serialize(typestore().types[FLOAT64](data=value), FLOAT64)


@pytest.fixture
def odd_names(tmp_path):
    names = ("/demand: x\nvehicle: other/power", "/[red]demand/power", "/demand/power\x1b[31m")
    channels = {name: Topic(name, FLOAT64) for name in names}
    channels["/genset"] = Topic("/genset", JOINT_STATE)
    entries = ("engine_power", "engine\nvehicle: other_power")
    unstamped = serialize(RosbagsMessages().joint_state(0, entries, (4e4, 4e4)), JOINT_STATE)
    with BagWriter(tmp_path / "bag", channels, {}) as bag:
        for k in range(20):
            for name in names:
                bag.write(name, number(5e4), 10**9 + k, 10**9 + k)
            bag.write("/genset", unstamped, 10**9 + k, 10**9 + k)
    return tmp_path / "bag"


def test_names_of_any_text_reach_neither_the_draft_nor_the_terminal(capsys, tmp_path, odd_names):
    assert main(["bag", "signals", str(odd_names), "--out", str(tmp_path / "map.yaml")]) == 0
    shown = capsys.readouterr().out
    assert "\x1b" not in shown and "[red]demand" in shown
    (signal,) = load_signal_map(tmp_path / "map.yaml").signals
    assert [source.field for source in signal.sources] == ["effort[engine_power]"]


def test_a_header_that_nobody_stamped_is_drafted_by_publication(tmp_path, odd_names):
    assert main(["bag", "signals", str(odd_names), "--out", str(tmp_path / "map.yaml")]) == 0
    (signal,) = load_signal_map(tmp_path / "map.yaml").signals
    assert signal.sources[0].stamp == "publish"


def test_a_bag_of_which_hardly_anything_can_be_used_does_not_pass(capsys, tmp_path):
    with BagWriter(tmp_path / "bag", {"/p": Topic("/p", FLOAT64)}, {}) as bag:
        for k in range(20):
            bag.write("/p", number(float(k)), 10**9, 10**9)
    source = f"{{topic: p, type: {FLOAT64}, field: data}}"
    (tmp_path / "map.yaml").write_text(f"vehicle: x\nsignals: {{power_demand_w: {source}}}")
    words = ["bag", "check", str(tmp_path / "bag"), "--signals", str(tmp_path / "map.yaml")]
    assert main([*words, "--json"]) == 2
    found = {item["name"]: item for item in json.loads(capsys.readouterr().out)["findings"]}
    assert found["ticks"]["outcome"] == "fail"
    assert "repeated 19" in found["samples"]["detail"]
    assert main([*words, "--dt", "0"]) == 2
    assert "--dt: 0.0, allowed 0.001..3600" in capsys.readouterr().err


def test_an_imported_series_follows_the_fastest_source(tmp_path):
    """Voltage once a second, current ten times: the first source must not set the rate."""
    with BagWriter(tmp_path / "bag", {n: Topic(n, FLOAT64) for n in ("/u", "/i")}, {}) as bag:
        for k in range(30):
            at_ns = (k + 10) * 10**8
            if k % 10 == 0:
                bag.write("/u", number(600.0), at_ns, at_ns)
            bag.write("/i", number(float(k)), at_ns + 1, at_ns + 1)
    factors = ", ".join(f"{{topic: {n}, type: {FLOAT64}, field: data}}" for n in "ui")
    path = tmp_path / "map.yaml"
    path.write_text(f"vehicle: x\nsignals: {{power_demand_w: {{product: [{factors}]}}}}")
    series = series_of(tmp_path / "bag", load_signal_map(path), "power_demand_w")
    assert series.value.tolist() == [600.0 * k for k in range(30)]


def test_what_the_recording_announces_is_not_overruled_quietly(capsys, tmp_path):
    words = ["cycle", "import", str(BAGS / "dp_planter"), "--out", str(tmp_path / "a.csv")]
    assert main([*words, "--signals", "signals", "--aux-w", "100"]) == 2
    assert "announces auxiliaries of 0 W" in capsys.readouterr().err


def test_a_map_beside_a_cycle_that_is_no_bag_is_refused(capsys):
    assert main(["evaluate", "--cycle", "planter_1001", "--signals", "signals"]) == 2
    assert "--signals: no --cycle is a bag" in capsys.readouterr().err


def test_a_shipped_cycle_in_a_bag_keeps_its_split_through_a_map():
    made = make_scenario("paper", str(BAGS / "dp_planter"), signals=load_signal_map())
    assert made.cycle.split == "train"


def test_what_a_drive_lacks_is_named(tmp_path):
    with pytest.raises(BagError, match=r"all that a drive needs \(soc, .* never\)"):
        iter_sampled_traces([BAGS / "demand_only"], load_signal_map(), 1.0, driven=True)
