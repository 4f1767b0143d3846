"""The player with plant and policy: one trajectory, bytes as recorded, and every early end."""

import signal
from collections import defaultdict
from pathlib import Path

import numpy as np
import pytest
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rosbags.interfaces import (
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import get_types_from_msg
from std_msgs.msg import Float64, String

from tractor_ems.answer import Answerer
from tractor_ems.bags.in_process import record_in_process, write_demand_bag
from tractor_ems.bags.read import read_bag
from tractor_ems.bags.rosbags_messages import serialize, typestore
from tractor_ems.drive import drive
from tractor_ems.nodes.bag_player import PARAMETERS, build
from tractor_ems.policies.rules import RuleBased
from tractor_ems.scenario import make_scenario
from tractor_msgs_py import topics
from tractor_msgs_py.errors import CycleError, RunAborted
from tractor_msgs_py.trajectory import trajectory_hash
from tractor_msgs_py.types import BatteryPowerCommand, CommandMode
from tractor_sim.config import load_powertrain
from tractor_sim.nodes import plant_parameters, topic_plant
from tractor_sim.run_files import read_run

pytestmark = pytest.mark.slow
BAGS = Path(__file__).resolve().parents[2] / "bags"
DEMAND_W = [60e3, 150e3, 200e3, 90e3, 20e3, 180e3, 240e3, 105e3, 130e3, 40e3, 110e3, 150e3]


def player_on(graph, name="bag_player", **values):
    defaults = {parameter.name: parameter.default for parameter in PARAMETERS}
    return build(graph.node(name), {**defaults, **values})


def plant_on(graph, output, **values):
    defaults = {parameter.name: parameter.default for parameter in plant_parameters.PARAMETERS}
    values = {**defaults, "demand": "topic", "output": str(output), **values}
    return topic_plant.build(graph.node("plant_sim"), values)


def ended(graph, *logics) -> None:
    """Spin until each has ended well."""
    codes: dict[int, int] = {}

    def all_ended() -> bool:
        for number, logic in enumerate(logics):
            code = codes.get(number, logic.finished())
            if code is not None:
                codes[number] = code
        return len(codes) == len(logics)

    graph.spin_until(all_ended, "the end of plant and player")
    assert set(codes.values()) == {0}


def test_the_paper_bag_played_into_the_plant_is_the_run_on_the_cycle(start):
    scenario = make_scenario("paper", "planter")
    policy = RuleBased(scenario.params)
    (expected,) = drive(policy, scenario.params, scenario.power_demand_w[None], 0.85, 0.85)
    plant, node = start("plant_sim", demand="topic"), start("rule_based_policy")
    player = start("bag_player", bag=BAGS / "dp_planter")
    assert plant.end() == 0, plant.output
    assert player.end() == 0, player.output
    assert node.end(signal.SIGTERM) == 0
    assert "planter on paper: 766 steps" in plant.output
    assert f"hash {trajectory_hash(expected)[:16]}" in plant.output
    assert "published 766, late 0" in player.output
    assert "driven 766, driven_old 0, not_driven 0" in player.output


@pytest.mark.parametrize("plant_first", [True, False])
def test_auxiliaries_are_taken_off_and_put_on_without_a_bit_of_difference(
    graph, make_cycle, tmp_path, plant_first
):
    scenario = make_scenario("field", make_cycle(DEMAND_W))
    expected = record_in_process(RuleBased(scenario.params), scenario, tmp_path / "bag")
    graph.policy(Answerer(RuleBased(scenario.params)))
    plant = plant_on(graph, tmp_path / "run", powertrain="field") if plant_first else None
    player = player_on(graph, bag=str(tmp_path / "bag"))
    ended(graph, plant or plant_on(graph, tmp_path / "run", powertrain="field"), player)
    trajectory, result = read_run(tmp_path / "run")
    assert scenario.params.p_aux_w > 0
    assert trajectory_hash(trajectory) == trajectory_hash(expected)
    assert result["cycle"] == "short"


@pytest.mark.parametrize("plant_mode", ["real_time", "lockstep"])
def test_real_time_at_twenty_times_accounts_for_every_tick(graph, tmp_path, plant_mode):
    bag = tmp_path / "bag"
    stamps = np.arange(1, len(DEMAND_W) + 1) * 10**9
    write_demand_bag(bag, stamps, np.array(DEMAND_W))
    graph.policy(Answerer(RuleBased(load_powertrain("paper"))))
    plant = plant_on(graph, tmp_path / "run", mode=plant_mode, period_s=0.05)
    player = player_on(graph, bag=str(bag), pace="real_time", rate=20.0)
    ended(graph, plant, player)
    trajectory, result = read_run(tmp_path / "run")
    old = int(np.sum(trajectory.power_demand_w != DEMAND_W))
    counters = player._replay.counters
    assert counters["published"] == len(DEMAND_W)
    # A tick that was driven late at an equal demand is held and yet not old.
    assert counters["driven_old"] == old <= result["counters"].get("demand_held", 0)
    assert counters["driven"] + old + counters["not_driven"] == len(DEMAND_W)
    if plant_mode == "lockstep":
        assert old == 0


def long_bag(path) -> str:
    write_demand_bag(path, np.arange(1, 5001) * 10**9, np.full(5000, 150e3))
    return str(path)


def test_a_player_that_is_told_to_end_midway_ends_the_run_with_a_named_reason(
    start, graph, tmp_path
):
    plant = start("plant_sim", demand="topic", demand_timeout_s=1.0, output=tmp_path / "run")
    policy = start("rule_based_policy")
    player = start("bag_player", bag=long_bag(tmp_path / "long"))
    observer = graph.peer(topics.BATTERY)
    graph.spin_until(lambda: len(observer.heard[topics.BATTERY.name]) > 20, "some ticks")
    assert player.end(signal.SIGTERM) == 0
    assert plant.end() == 3
    (line,) = [text for text in plant.output.splitlines() if text.startswith("plant_sim: ")]
    assert "no duty_cycle_demand of tick" in line and "0 publishers" in line
    assert not any((tmp_path / "run").iterdir())
    (said,) = [text for text in player.output.splitlines() if text.startswith("bag_player: ")]
    assert "5000 steps, published" in said and "Traceback" not in player.output
    assert policy.end(signal.SIGTERM) == 0


def test_in_real_time_the_last_demand_is_held_for_a_while_and_then_the_run_ends(graph, tmp_path):
    graph.policy(Answerer(RuleBased(load_powertrain("paper"))))
    settings = {"mode": "real_time", "period_s": 0.05, "demand_timeout_s": 0.5}
    plant = plant_on(graph, tmp_path / "run", **settings)
    player = player_on(graph, bag=long_bag(tmp_path / "long"))
    graph.spin_until(lambda: player._replay.seen > 5, "some ticks")
    graph.remove(player._node)
    with pytest.raises(RunAborted, match=r"no duty_cycle_demand of tick .* 0 publishers"):
        graph.spin_until(plant.finished, "the end of the run")
    assert plant._plant._run.demand_counters["demand_held"] > 1


def test_a_second_player_is_refused_and_the_run_it_disturbs_ends(graph, tmp_path):
    graph.policy(Answerer(RuleBased(load_powertrain("paper"))))
    plant = plant_on(graph, tmp_path / "run")
    first = player_on(graph, bag=long_bag(tmp_path / "long"))
    graph.spin_until(lambda: first._replay.seen > 5, "some ticks")
    second = player_on(graph, "other_player", bag=str(tmp_path / "long"))
    with pytest.raises(RunAborted, match=r"2 publishers on duty_cycle_demand, allowed 1: another"):
        graph.spin_until(second.finished, "the refusal")
    with pytest.raises(RunAborted, match=r"2 publishers on duty_cycle_demand|another replay was"):
        graph.spin_until(plant.finished, "the end of the run")


def test_a_plant_refuses_steps_that_it_does_not_make(graph, tmp_path):
    write_demand_bag(tmp_path / "half", np.arange(1, 9) * 500_000_000, np.full(8, 1e5))
    plant = plant_on(graph, tmp_path / "run")
    player_on(graph, bag=str(tmp_path / "half"))
    with pytest.raises(CycleError, match=r"cycle half: dt_s 0\.5, powertrain paper needs 1\.0"):
        graph.spin_until(plant.finished, "the refusal")


def test_a_plant_ends_when_no_player_comes(graph, tmp_path):
    plant = plant_on(graph, tmp_path / "run", match_timeout_s=0.2)
    with pytest.raises(RunAborted, match=r"not started within 0.2 s: no duty_cycle_info"):
        graph.spin_until(plant.finished, "the end of its patience")


# --- topics -----------------------------------------------------------------------------------


def offered(reliability, durability) -> list[Qos]:
    never = QosTime(9223372036, 854775807)
    ends = (never, never, QosLiveliness.AUTOMATIC, never, False)
    return [Qos(QosHistory.KEEP_LAST, 7, reliability, durability, *ends)]


def vehicle_bag(path, storage) -> dict[str, list[bytes]]:
    """A bag of topics that nobody here knows, one of a type that is not installed."""
    store = typestore()
    store.register(get_types_from_msg("float64 value\n", "acme_msgs/msg/Thing"))
    rng = np.random.default_rng(np.random.PCG64(5))
    latched = offered(QosReliability.RELIABLE, QosDurability.TRANSIENT_LOCAL)
    sensor = offered(QosReliability.BEST_EFFORT, QosDurability.VOLATILE)
    sent: dict[str, list[bytes]] = defaultdict(list)
    with Writer(path, version=9, storage_plugin=storage) as writer:

        def topic(name, kind, qos=()):
            connection = writer.add_connection(
                name, kind, typestore=store, offered_qos_profiles=qos
            )

            def write(k, **fields):
                data = serialize(store.types[kind](**fields), kind)
                writer.write(connection, 10**18 + k * 10**7, data)
                sent[name].append(data)

            return write

        note = topic("/vehicle/note", "std_msgs/msg/String", latched)
        volts = topic("/vehicle/bus_voltage", "std_msgs/msg/Float64")
        speed = topic("/vehicle/speed", "std_msgs/msg/Float64", sensor)
        thing = topic("/acme/thing", "acme_msgs/msg/Thing")
        note(0, data="rain")
        for k in range(50):
            volts(k, data=rng.normal(650.0, 5.0))
            speed(k, data=float(k))
            thing(k, value=float(k))
    return sent


@pytest.mark.parametrize("storage", [StoragePlugin.MCAP, StoragePlugin.SQLITE3])
def test_topics_of_any_bag_are_published_byte_by_byte_with_their_qos(
    graph, tmp_path, storage, capfd
):
    sent = vehicle_bag(tmp_path / "bag", storage)
    heard: dict[str, list[bytes]] = defaultdict(list)
    node = graph.node("listener")

    def listen(name, kind, qos):
        node.create_subscription(kind, name, heard[name].append, qos, raw=True)

    listen("/vehicle/bus_voltage", Float64, 100)
    listen(
        "/vehicle/speed", Float64, QoSProfile(depth=100, reliability=ReliabilityPolicy.BEST_EFFORT)
    )
    player = player_on(graph, what="topics", bag=str(tmp_path / "bag"))
    ended(graph, player)
    late = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    listen("/vehicle/note", String, late)  # what was latched is still given to who comes late
    graph.spin_until(lambda: heard["/vehicle/note"], "the latched note")
    assert heard["/vehicle/bus_voltage"] == sent["/vehicle/bus_voltage"]
    assert heard["/vehicle/note"] == sent["/vehicle/note"]
    # Best effort as recorded: a reliable subscription would not match it, and losses are allowed.
    speeds = heard["/vehicle/speed"]
    assert speeds and set(speeds) <= set(sent["/vehicle/speed"])
    (info,) = node.get_publishers_info_by_topic("/vehicle/speed")
    assert info.qos_profile.reliability is ReliabilityPolicy.BEST_EFFORT
    player.shutdown()
    said = capfd.readouterr().out
    assert "published 101, late" in said and "topics 3" in said
    assert "skipped /acme/thing (acme_msgs/msg/Thing)" in said


def test_topics_in_lockstep_play_the_plant_to_a_policy(graph):
    """A policy decides on the recorded observations as it did live, with a recorder announced."""
    bag = BAGS / "rule_based_planter"
    (run,) = read_bag(bag)
    assert run.info.expected_recorders == 1
    answers: list[BatteryPowerCommand] = []
    peer = graph.peer(topics.COMMAND)
    peer.on_sample = answers.append
    graph.policy(Answerer(RuleBased(load_powertrain("paper"))))
    player = player_on(graph, what="topics", pace="lockstep", bag=str(bag), duration_s=1.0)
    ended(graph, player)
    nominal: dict[int, BatteryPowerCommand] = {}

    def all_heard() -> bool:
        nominal.update({a.stamp_ns: a for a in answers if a.mode is CommandMode.NOMINAL})
        return len(nominal) == player._schedule.answered

    graph.spin_until(all_heard, "the last answer")
    assert len(nominal) > 50
    for stamp_ns, answer in nominal.items():
        assert repr(answer) == repr(run.command[stamp_ns])  # NaN is no opinion


def test_topics_in_lockstep_end_without_a_policy(graph):
    bag = str(BAGS / "rule_based_planter")
    graph.peer(topics.POWER_DEMAND)
    player = player_on(graph, what="topics", pace="lockstep", bag=bag, match_timeout_s=0.5)
    with pytest.raises(RunAborted, match=r"no publisher on battery_power_command within 0.5 s"):
        graph.spin_until(player.finished, "the end of its patience")
