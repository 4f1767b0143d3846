"""Bad parameters stop a node with one line and code 2; help lists every parameter."""

import signal

import pytest

from tractor_ems.nodes import bag_player, ddqn_policy, dp_policy, rule_based_policy
from tractor_ems.nodes.policy_node import COMMON
from tractor_msgs_py.ros.shell import run_node
from tractor_sim.nodes import plant_parameters, plant_sim

NODES = {
    "plant_sim": (plant_sim.main, plant_parameters.PARAMETERS),
    "rule_based_policy": (rule_based_policy.main, (*rule_based_policy.PARAMETERS, *COMMON)),
    "dp_policy": (dp_policy.main, (*dp_policy.PARAMETERS, *COMMON)),
    "bag_player": (bag_player.main, bag_player.PARAMETERS),
    "ddqn_policy": (ddqn_policy.main, (*ddqn_policy.PARAMETERS, *COMMON)),
}


@pytest.fixture
def run(domain_id, monkeypatch, capfd):
    """Runs a node in this process; returns exit code, stdout and stderr."""
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}

    def run_main(name: str, *words: str) -> tuple[int, str, str]:
        monkeypatch.setattr("sys.argv", [name, *words])
        code = NODES[name][0]()
        out, error = capfd.readouterr()
        return code, out, error

    yield run_main
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.mark.parametrize(
    ("name", "override", "said"),
    [
        ("plant_sim", "cicle:=planter", "parameter cicle: unknown, declared are"),
        ("plant_sim", "soc_initial:=1", "parameter soc_initial: 1 is not a valid float"),
        ("plant_sim", "soc_initial:=1.5", "range -1..1"),
        ("plant_sim", "soc_initial:=.nan", "range -1..1"),
        ("plant_sim", "soc_initial:=0.5", "allowed 0.7..0.9"),
        ("plant_sim", "soc_target:=0.95", "allowed 0.7..0.9"),
        ("plant_sim", "expected_recorders:=-1", "range 0..16"),
        ("plant_sim", "answer_timeout_s:=.inf", "range 0.01..3600"),
        ("plant_sim", "mode:=fast", "one of lockstep, real_time"),
        ("plant_sim", "cycle:=plantre", "cycle 'plantre': unknown"),
        ("plant_sim", "powertrain:=papre", "powertrain 'papre': unknown"),
        ("plant_sim", "cycle:=none.csv", "none.csv: cannot be read"),
        ("rule_based_policy", "policy:=rule_base", "one of rule_based, conventional"),
        ("rule_based_policy", "threshold_w:=-1.0", "range 0..1e+09"),
        ("rule_based_policy", "soc_guard:=1", "parameter soc_guard: 1 is not a valid bool"),
        ("plant_sim", "output:=/dev/null/run", "/dev/null/run: no place for a result"),
        ("plant_sim", "demand:=topics", "one of cycle, topic"),
        ("bag_player", "what:=topics", "parameter bag: '', expected a bag to play"),
        ("bag_player", "bag:=none", "none: no such bag"),
        ("bag_player", "rate:=0.0", "range 0.001..1000"),
        ("bag_player", "pace:=fast", "one of auto, lockstep, real_time"),
        ("bag_player", "loop:=true", "parameter loop: unknown"),
        ("dp_policy", "actions:=100000", "range 2..20000"),
        ("dp_policy", "soc_points:=1", "range 4..5000"),
        ("dp_policy", "cycle:=planter_0x", "cycle 'planter_0x': unknown"),
        ("ddqn_policy", "policy_file:=none.safetensors", "none.safetensors"),
        ("ddqn_policy", "policy:=none.safetensors", "parameter policy: unknown"),
        ("ddqn_policy", "powertrain:=wheel_loader", "none ships for powertrain 'wheel_loader'"),
        ("ddqn_policy", "signals:=signals", "a vehicle does not say which"),
        ("ddqn_policy", "outside_envelope:=stop", "one of warn, fallback"),
        ("rule_based_policy", "planned_work_s:=-1.0", "range 0..1e+07"),
        ("dp_policy", "planned_work_s:=60.0", "parameter planned_work_s: unknown"),
    ],
)
def test_a_bad_parameter_stops_the_node_with_one_line_and_code_2(run, name, override, said):
    code, out, error = run(name, "--ros-args", "-p", override)
    assert (code, out) == (2, "")
    (line,) = error.splitlines()
    assert line.startswith(f"{name}: ") and said in line


def test_a_period_the_plant_cannot_keep_is_refused(run):
    words = ("-p", "mode:=real_time", "-p", "period_s:=0.001")
    code, _, error = run("plant_sim", "--ros-args", *words)
    assert code == 2 and "parameter period_s: 0.001, allowed 0.005..60 or 0" in error


@pytest.mark.parametrize(
    "words",
    [
        ["planter"],
        ["--verbose"],
        ["--ros-args", "-p", "broken"],
        ["--ros-args", "-p", "soc_initial:=[1,"],
        ["--ros-args", "--params-file", "none.yaml"],
        ["--ros-args", "--verbose"],
    ],
)
def test_a_bad_command_line_stops_the_node_with_one_line_and_code_2(run, words):
    code, _, error = run("plant_sim", *words)
    assert code == 2
    (line,) = error.splitlines()
    assert line.startswith("plant_sim: ")


def test_a_misspelt_name_in_a_parameter_file_stops_the_node(run, tmp_path):
    path = tmp_path / "plant.yaml"
    path.write_text("plant_sim:\n  ros__parameters:\n    soc_inital: 0.8\n")
    code, _, error = run("plant_sim", "--ros-args", "--params-file", str(path))
    assert code == 2 and "parameter soc_inital: unknown" in error


def test_a_cut_policy_file_stops_the_node(run, untrained):
    path, _ = untrained()
    with open(path, "rb+") as file:
        file.truncate(1000)
    code, _, error = run("ddqn_policy", "--ros-args", "-p", f"policy_file:={path}")
    (line,) = error.splitlines()
    assert code == 2 and path in line


@pytest.mark.parametrize("name", sorted(NODES))
def test_help_names_every_parameter_with_its_description(run, name):
    code, out, error = run(name, "--help")
    assert (code, error) == (0, "")
    for parameter in NODES[name][1]:
        assert parameter.name in out and parameter.text in out


@pytest.mark.parametrize("name", sorted(NODES))
def test_every_parameter_has_a_description_and_every_number_a_range(name):
    for parameter in NODES[name][1]:
        assert len(parameter.description) > 10
        if isinstance(parameter.default, int | float) and not isinstance(parameter.default, bool):
            assert parameter.minimum <= parameter.default <= parameter.maximum
            assert parameter.unit


def test_a_programming_mistake_is_no_bad_input(domain_id):
    def build(node, values):
        raise KeyError("a bug")

    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        with pytest.raises(KeyError):
            run_node("broken", (), build, ["broken"])
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
