"""A run through separate processes: the same result, and no process left whatever happens."""

import contextlib
import os
import signal
import socket
import subprocess
import sys
import threading

import psutil
import pytest

from tractor_ems import ros_run
from tractor_ems.bags.check import check
from tractor_ems.drive import drive
from tractor_ems.policies.rules import Conventional, RuleBased
from tractor_ems.ros_run import DOMAIN_VARIABLE, MODULES, run_ros
from tractor_ems.scenario import make_scenario
from tractor_msgs_py.errors import ConfigError, RunAborted
from tractor_msgs_py.provenance import command_line
from tractor_msgs_py.trajectory import trajectory_hash

DEMAND_W = [60e3, 150e3, 200e3, 90e3, 20e3, 180e3, 240e3, 105e3, 130e3, 40e3, 110e3, 150e3]
RULES = ("rule_based_policy", {"policy": "rule_based"})


@pytest.fixture
def scenario(make_cycle):
    return make_scenario("paper", make_cycle(DEMAND_W), 0.8, 0.8)


@pytest.fixture(autouse=True)
def no_process_is_left():
    before = set(psutil.Process().children(recursive=True))
    yield
    assert set(psutil.Process().children(recursive=True)) <= before


def expected(policy, scenario) -> str:
    (trajectory,) = drive(policy, scenario.params, scenario.power_demand_w[None], 0.8, 0.8)
    return trajectory_hash(trajectory)


def test_recorded_run_equals_the_in_process_run_and_its_bag(scenario, tmp_path):
    from tractor_ems.bags.read import read_bag
    from tractor_ems.bags.runs import trajectory_of

    result = run_ros(
        ("rule_based_policy", {"policy": "conventional"}), scenario, record=tmp_path / "bag"
    )
    (run,) = read_bag(tmp_path / "bag")
    hashes = {trajectory_hash(result.trajectory), trajectory_hash(trajectory_of(run))}
    assert hashes == {expected(Conventional(), scenario), result.run["trajectory_hash"]}
    assert [path.name for path in tmp_path.glob("*bag*")] == ["bag"]
    assert result.run["command_line"] == run.info.command_line == command_line()
    assert run.complete and run.policy == "conventional" and result.bag == tmp_path / "bag"


@pytest.mark.slow
def test_a_recorder_that_stands_still_for_a_while_loses_nothing(tmp_path):
    stop, stood_still = threading.Event(), []

    def hold_up() -> None:
        while not stop.wait(0.2):
            for child in psutil.Process().children():
                with contextlib.suppress(psutil.Error):
                    if MODULES["bag_recorder"] in child.cmdline():
                        child.suspend()
                        stop.wait(0.5)
                        child.resume()
                        stood_still.append(child.pid)

    thread = threading.Thread(target=hold_up)
    thread.start()
    try:
        run_ros(RULES, make_scenario("paper", "planter", 0.85, 0.836), record=tmp_path / "bag")
    finally:
        stop.set()
        thread.join()
    assert stood_still
    report = check(tmp_path / "bag")
    assert report.verdict == "pass", [item for item in report.checks if item.outcome == "fail"]


@pytest.mark.slow
def test_a_cycle_out_of_a_bag_is_driven_too(scenario, tmp_path):
    run_ros(RULES, scenario, record=tmp_path / "bag")
    again = make_scenario("paper", str(tmp_path / "bag"), 0.8, 0.8)
    result = run_ros(RULES, again)
    assert trajectory_hash(result.trajectory) == expected(RuleBased(again.params), again)
    assert result.run["cycle"] == again.cycle.name


@pytest.mark.slow
def test_dp_is_given_the_scenario(scenario):
    from tractor_ems.policies.dp import solve_policy

    result = run_ros(("dp_policy", {}), scenario)
    policy = solve_policy(scenario.params, scenario.power_demand_w, 0.8, 0.8)
    assert trajectory_hash(result.trajectory) == expected(policy, scenario)


def test_bad_input_of_a_node_is_one_line_and_leaves_no_bag(scenario, tmp_path):
    missing = str(tmp_path / "none.safetensors")
    with pytest.raises(ConfigError) as error:
        run_ros(("ddqn_policy", {"policy_file": missing}), scenario, record=tmp_path / "bag")
    assert str(error.value).startswith("ddqn_policy: ") and missing in str(error.value)
    assert "\n" not in str(error.value)
    assert not list(tmp_path.glob("*bag*"))


def test_an_existing_bag_is_refused_and_kept(scenario, tmp_path):
    (tmp_path / "bag").mkdir()
    with pytest.raises(ConfigError, match="exists already"):
        run_ros(RULES, scenario, record=tmp_path / "bag")
    assert (tmp_path / "bag").is_dir()


@pytest.mark.parametrize("otherwise", ["fails", pytest.param("succeeds", marks=pytest.mark.slow)])
def test_a_bag_that_somebody_else_makes_meanwhile_is_kept(
    scenario, monkeypatch, tmp_path, otherwise
):
    real, theirs = ros_run._wait, tmp_path / "bag" / "theirs.mcap"

    def lose_the_race(nodes, deadline_s, signals):
        theirs.parent.mkdir()
        theirs.write_text("precious")
        if otherwise == "fails":
            raise RunAborted("the run failed")
        real(nodes, deadline_s, signals)

    monkeypatch.setattr(ros_run, "_wait", lose_the_race)
    with pytest.raises(RunAborted, match=r"the run failed|cannot be put in place"):
        run_ros(RULES, scenario, record=tmp_path / "bag")
    assert theirs.read_text() == "precious"
    assert [path.name for path in tmp_path.glob("*bag*")] == ["bag"]


def test_a_cycle_file_with_any_name_reaches_the_plant(make_cycle):
    named = make_scenario("paper", make_cycle(DEMAND_W, "acker 🚜 'ä\""), 0.8, 0.8)
    result = run_ros(RULES, named)
    assert trajectory_hash(result.trajectory) == expected(RuleBased(named.params), named)


@pytest.mark.parametrize(
    ("code", "error"), [(2, ConfigError), (3, RunAborted), (1, RunAborted), (-9, RunAborted)]
)
def test_the_exit_code_of_a_node_says_whether_input_was_bad(tmp_path, code, error):
    script = f"import os, sys; os.kill(os.getpid(), 9) if {code} < 0 else sys.exit({code})"
    process = subprocess.Popen([sys.executable, "-c", script])
    process.wait(60)
    (tmp_path / "log").write_text("bag_recorder: no space left on device\n")
    failure = ros_run._failure(ros_run._Node("bag_recorder", process, tmp_path / "log"))
    assert type(failure) is error


@pytest.mark.parametrize("failure", [KeyboardInterrupt(), RuntimeError("anything")])
def test_no_process_outlives_an_interrupted_call(scenario, monkeypatch, tmp_path, failure):
    children = []

    def interrupt(nodes, deadline_s, signals):
        children.extend(node.process for node in nodes)
        raise failure

    monkeypatch.setattr(ros_run, "_wait", interrupt)
    with pytest.raises(type(failure)):
        run_ros(RULES, scenario, record=tmp_path / "bag")
    assert len(children) == 3
    assert all(child.returncode is not None for child in children)


@pytest.mark.parametrize(
    ("number", "ending"), [(signal.SIGINT, KeyboardInterrupt), (signal.SIGTERM, SystemExit)]
)
def test_no_process_outlives_signals_at_the_worst_moments(scenario, monkeypatch, number, ending):
    children = []

    class Child(subprocess.Popen):
        """A signal comes before the caller knows of the child, and again while it is ended."""

        def __init__(self, *args, **settings):
            super().__init__(*args, **settings)
            children.append(self)
            signal.raise_signal(number)

        def terminate(self):
            signal.raise_signal(number)
            super().terminate()

    monkeypatch.setattr(ros_run.subprocess, "Popen", Child)
    if number == signal.SIGINT:  # a shell's background job starts with it ignored
        signal.signal(number, signal.default_int_handler)
    before = signal.getsignal(number)
    with pytest.raises(ending):
        run_ros(RULES, scenario)
    assert children and all(child.returncode is not None for child in children)
    assert signal.getsignal(number) is before


def test_a_policy_that_is_killed_is_named(scenario, monkeypatch):
    real = ros_run._wait

    def kill_policy(nodes, deadline_s, signals):
        nodes[1].process.kill()
        nodes[1].process.wait()
        real(nodes, deadline_s, signals)

    monkeypatch.setattr(ros_run, "_wait", kill_policy)
    with pytest.raises(RunAborted, match="rule_based_policy: killed by SIGKILL"):
        run_ros(RULES, scenario)


def test_a_run_that_takes_too_long_is_aborted(scenario):
    with pytest.raises(RunAborted, match="plant_sim: not done in time"):
        run_ros(RULES, scenario, timeout_s=0.0)


@pytest.mark.parametrize("text", ["233", "-1", "one", "1.5"])
def test_a_domain_that_does_not_exist_is_refused(scenario, monkeypatch, text):
    monkeypatch.setenv(DOMAIN_VARIABLE, text)
    with pytest.raises(ConfigError, match=rf"{DOMAIN_VARIABLE}: '{text}', allowed 0..232"):
        run_ros(RULES, scenario)


def test_simultaneous_runs_get_domains_of_their_own():
    with ros_run._domain(None) as one, ros_run._domain(None) as other:
        assert one != other and {one, other} <= set(range(1, 101))
    with ros_run._domain(7) as wanted:
        assert wanted == 7


def test_domains_reserved_by_others_are_left_alone():
    with ros_run._domain(None) as free:
        pass
    with socket.socket() as reservation:
        reservation.bind(("", ros_run._DOMAIN_PORT + free))
        with ros_run._domain(None) as another:
            assert another != free


TERMINATED = """
import sys
from tractor_ems.ros_run import run_ros
from tractor_ems.scenario import make_scenario
run_ros(("rule_based_policy", {}), make_scenario("paper", sys.argv[1]))
"""


def test_sigterm_takes_the_nodes_along(make_cycle, wait_for):
    cycle = make_cycle([150e3] * 50_000, "long")
    caller = subprocess.Popen([sys.executable, "-c", TERMINATED, cycle], env=dict(os.environ))
    try:
        nodes = psutil.Process(caller.pid).children
        wait_for(lambda: len(nodes()) == 2, "plant and policy")
        started = nodes()
        caller.send_signal(signal.SIGTERM)
        assert caller.wait(60) == 128 + signal.SIGTERM
    finally:
        caller.kill()
        caller.wait()
    gone, alive = psutil.wait_procs(started, timeout=0)
    assert len(gone) == 2 and not alive
