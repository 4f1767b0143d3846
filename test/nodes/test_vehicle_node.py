"""A policy on a vehicle: any topic, in the shadow, engaged by a service, tuned while it runs."""

import json
import signal
import time
from dataclasses import dataclass, replace

import numpy as np
import pytest
from rclpy.node import Node
from rclpy.parameter import Parameter as Setting
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64
from std_srvs.srv import SetBool

from tractor_ems.answer import Answerer
from tractor_ems.answer_sampled import RUN_INFO_S, SampledAnswerer
from tractor_ems.decide import DecideConfig
from tractor_ems.handover import HandoverConfig, Mode
from tractor_ems.nodes import rule_based_policy
from tractor_ems.nodes.policy_node import PolicyNode
from tractor_ems.nodes.policy_parameters import COMMON, OUTSIDE, PLANNED_WORK, SOC_TARGET
from tractor_ems.nodes.policy_setup import Paperwork
from tractor_ems.nodes.policy_topics import SHADOW, CommandOutlet
from tractor_ems.nodes.vehicle_node import VehicleNode
from tractor_ems.policies.protocol import ANY_RUN
from tractor_ems.policies.rules import RuleBased
from tractor_ems.shadow_log import ShadowLog, price_of
from tractor_ems.signals.config import load_signal_map
from tractor_msgs_py import topics
from tractor_msgs_py.errors import ConfigError, PolicyError
from tractor_msgs_py.observation import ObservationSpec
from tractor_msgs_py.ros.shell import accept_changes, declare
from tractor_msgs_py.ros.wire import message_class
from tractor_msgs_py.sampling import Sampling
from tractor_msgs_py.signals import MappedSignal, SignalMap, Source
from tractor_msgs_py.supervisor import Condition
from tractor_msgs_py.types import CommandMode, Reason
from tractor_sim.config import load_powertrain
from tractor_sim.powertrain import Command

DT_S = 0.05
POWERTRAIN = f"paper:dt_s={DT_S}"
PARAMS = load_powertrain(POWERTRAIN)
FLOAT = "std_msgs/msg/Float64"
LOOSE = {"allow_other_powertrain": True}
"""The shipped policy knows its powertrain at steps of 1 s."""


def source(topic, scale=1.0):
    return Source(topic, FLOAT, "data", scale, stamp="publish")


BUS = SignalMap(
    "bus",
    (
        MappedSignal("power_demand_w", ((source("bus_voltage"), source("bus_current")),)),
        MappedSignal("soc", ((source("soc_percent", 0.01),),)),
        MappedSignal("engine_power_w", ((source("genset_kw", 1000.0),),)),
    ),
    soc_target=0.8,
)
SAYS = {"bus_voltage": 600.0, "bus_current": 200.0, "soc_percent": 80.0, "genset_kw": 120.0}


@dataclass(frozen=True)
class Half:
    """Wishes half of the demand from the generator; breaks where it is told to."""

    broken: bool = False
    name: str = "half"
    spec: object = ANY_RUN

    def init(self, batch):
        return None

    def act(self, observation, state):
        if self.broken:
            raise ValueError("out of order")
        return Command(0.5 * observation.power_demand_w, np.full(1, np.nan)), state


@pytest.fixture
def drive(graph):
    """Puts a policy with a signal map on the graph."""

    def make(signals, policy=None, shadow=False, name="policy", **papers):
        ramp = HandoverConfig(1e6)
        config = DecideConfig(handover=ramp, shadow=shadow, params=PARAMS)
        answerer = SampledAnswerer(policy or RuleBased(PARAMS), signals, config, DT_S)
        return VehicleNode(graph.node(name), answerer, 10, Paperwork(shadow, **papers))

    return make


@pytest.fixture
def vehicle(graph):
    """Publishes what a vehicle says, each time it is called."""
    node = graph.node("vehicle")
    publishers = {name: node.create_publisher(Float64, name, 10) for name in SAYS}

    def say(**values):
        for name, value in {**SAYS, **values}.items():
            publishers[name].publish(Float64(data=value))
        graph.spin(3)
        return True

    return say


def until(graph, vehicle, condition, what):
    graph.spin_until(lambda: vehicle() and condition(), what)


def test_it_drives_the_plant_through_the_map_of_the_projects_own_topics(graph, drive, make_cycle):
    node = drive(load_signal_map(), Half())
    demand_w = [120e3] * 40
    cycle = make_cycle(demand_w)
    rows = "".join(f"{k * DT_S:.6g},{p!r}\n" for k, p in enumerate(demand_w))
    with open(cycle, "w") as file:
        file.write("time_s,power_demand_w\n" + rows)
    plant = graph.plant(powertrain=POWERTRAIN, cycle=cycle, mode="real_time")
    trajectory, _ = graph.drive(plant)
    answerer = node._answerer
    assert answerer.run.powertrain == POWERTRAIN
    assert answerer.count.ticks >= 30 and answerer.decider.fallbacks == 0
    assert (trajectory.battery_power_w == 60e3).sum() > 10
    assert node.outlet.latencies.count > 10


def test_a_vehicle_without_run_info_is_driven_after_a_while(graph, drive, vehicle):
    node = drive(BUS)
    begin_s = time.monotonic()
    until(graph, vehicle, lambda: node._answerer.decision, "a decision")
    assert time.monotonic() - begin_s >= RUN_INFO_S
    seen, run = node._answerer.decision.observation, node._answerer.run
    assert (run.run_id, run.soc_target) == ("vehicle-1", 0.8)
    assert seen.power_demand_w[0] == 120e3 and seen.soc[0] == pytest.approx(0.8)
    assert seen.stamp_ns % round(DT_S * 1e9) == 0
    assert seen.engine_power_w[0] == 120e3
    assert seen.discharge_limit_w[0] <= PARAMS.battery.power_max_w


def test_soc_in_percent_is_refused_with_a_hint_and_never_driven(graph, drive, vehicle):
    signals = replace(
        BUS,
        signals=(
            BUS.signals[0],
            MappedSignal("soc", ((source("soc_percent"),),)),
            BUS.signals[2],
        ),
    )
    node = drive(signals)
    until(graph, vehicle, lambda: node._answerer.count.ticks > 3, "blind ticks")
    values = node._values()
    assert "looks like percent, which needs scale: 0.01" in values["missing_soc"]
    assert node._answerer.decision is None


def test_in_the_shadow_nothing_is_on_the_command_topic_until_it_is_enabled_and_after(
    graph, drive, vehicle
):
    peer = graph.peer(topics.COMMAND, SHADOW)
    wishes = []
    peer.node.create_subscription(JointState, "policy/shadow_command", wishes.append, 10)
    client = peer.node.create_client(SetBool, "policy/enable")
    commands = peer.heard[topics.COMMAND.name]
    node = drive(BUS, Half(), shadow=True)

    def enable(on):
        future = client.call_async(SetBool.Request(data=on))
        until(graph, vehicle, future.done, "the service")
        return future.result()

    until(graph, vehicle, lambda: wishes, "the shadow's wish")
    assert node.outlet.others() == 0 and node.outlet.listeners() == 0
    until(graph, vehicle, lambda: node._answerer.decider.trust.nominal, "trust")
    response = enable(True)
    assert response.success and "engaging from 120000 W" in response.message
    until(graph, vehicle, lambda: node._answerer.decider.mode is Mode.ENGAGED, "engaged")
    until(graph, vehicle, lambda: commands and commands[-1].reason is Reason.NONE, "a command")
    assert commands[-1].battery_power_w == pytest.approx(60e3)
    assert enable(True).message == "already engaged"
    assert enable(False).success
    until(graph, vehicle, lambda: node._answerer.decider.mode is Mode.SHADOW, "the shadow")
    count = peer.node.count_publishers
    until(graph, vehicle, lambda: count(topics.COMMAND.name) == 0, "no publisher")
    assert commands[-1].mode is CommandMode.FALLBACK
    assert commands[-1].reason is Reason.HANDOVER


def test_enabling_is_refused_beside_another_policy_and_without_observations(graph, drive, vehicle):
    node = drive(BUS, Half(), shadow=True)
    client = graph.peer().node.create_client(SetBool, "policy/enable")

    def refused():
        future = client.call_async(SetBool.Request(data=True))
        graph.spin_until(future.done, "the service")
        assert not future.result().success
        return future.result().message

    graph.spin_until(client.service_is_ready, "the service")
    assert "INIT" in refused()
    other = graph.peer(name="incumbent")
    other.publisher(topics.COMMAND)
    graph.spin_until(lambda: node.outlet.others() == 1, "the other policy")
    message = refused()
    assert "/incumbent" in message and "stop them first" in message
    assert node._answerer.decider.mode is Mode.SHADOW


def test_another_policy_is_seen_on_a_command_topic_of_another_name(graph):
    named = ["--ros-args", "-r", f"{topics.COMMAND.name}:=renamed"]
    node = Node("policy", context=graph.context, cli_args=named)
    outlet = CommandOutlet(node, 10, driving=True, shadow=False)
    graph.peer().node.create_publisher(JointState, "renamed", 10)
    graph.spin_until(lambda: outlet.others() == 1, "the other policy")
    node.destroy_node()


def test_what_a_policy_was_held_up_with_is_not_said_late(graph, drive, vehicle):
    node = drive(BUS, Half())
    until(graph, vehicle, lambda: node.outlet.latencies.count, "a command")
    said, skipped = node.outlet.latencies.count, node._answerer.count.skipped
    decision, now_ns = node._answerer.decision, time.monotonic_ns()
    node._say([decision], now_ns - 3_000_000_000)
    assert (node.outlet.latencies.count, node._answerer.count.skipped) == (said, skipped + 1)
    node._say([decision], now_ns)
    assert node.outlet.latencies.count == said + 1


def test_a_policy_that_fails_becomes_the_fallback_law_and_the_node_lives(graph, drive, vehicle):
    peer = graph.peer(topics.COMMAND)
    node = drive(BUS, Half(broken=True))
    commands = peer.heard[topics.COMMAND.name]
    until(graph, vehicle, lambda: commands, "a command")
    assert commands[0].mode is CommandMode.FALLBACK and commands[0].reason is Reason.FAULT
    values = node._values()
    assert values["condition"] == "FAULT" and values["policy_error"] == "ValueError: out of order"


def test_a_signal_that_stops_ends_trust_although_others_go_on(graph, drive, vehicle):
    aged = [replace(signal, max_age_s=0.2) for signal in BUS.signals]
    node = drive(replace(BUS, signals=tuple(aged)))
    until(graph, vehicle, lambda: node._answerer.decision, "a decision")
    only = graph.node("half_a_vehicle")
    publisher = only.create_publisher(Float64, "soc_percent", 10)

    def stale():
        publisher.publish(Float64(data=80.0))
        graph.spin(2)
        return node._answerer.decider.trust.condition is Condition.STALE

    graph.spin_until(stale, "STALE")
    assert node._values()["missing_power_demand_w"] == "stale"


def test_dynamic_parameters_are_checked_committed_and_the_others_refused(graph, drive, vehicle):
    node = drive(BUS, Half())
    ros, parameters = node._node, (*COMMON, *OUTSIDE, SOC_TARGET, PLANNED_WORK)
    declare(ros, parameters)
    accept_changes(ros, parameters, node)
    until(graph, vehicle, lambda: node._answerer.run, "a run")

    def put(name, value):
        return ros.set_parameters([Setting(name, value=value)])[0]

    assert put("soc_target", 0.75).successful
    assert put("ramp_w_per_s", 5e3).successful
    assert put("observation_timeout_s", 0.3).successful
    answerer = node._answerer
    assert answerer.run.soc_target == 0.75
    assert answerer.decider.config.handover.ramp_w_per_s == 5e3
    assert answerer.decider.config.timeout_s == 0.3
    assert put("soc_target", -1.0).successful and answerer.run.soc_target == 0.8
    for name, value in (("soc_target", 2.0), ("soc_target", float("nan")), ("shadow", True)):
        refused = put(name, value)
        assert not refused.successful and refused.reason
    assert "read-only" in put("signals", "other").reason
    assert put("planned_work_s", 1800.0).successful
    assert put("outside_envelope", "fallback").successful
    assert put("outside_envelope_s", 3.0).successful
    config = answerer.decider.config
    assert (config.outside_fallback, config.outside_s) == (True, 3.0)
    until(graph, vehicle, lambda: "time_left_s" in node._values(), "the countdown")
    assert 1700.0 < node._values()["time_left_s"] <= 1800.0
    for name, value in (("planned_work_s", -1.0), ("outside_envelope", "stop")):
        refused = put(name, value)
        assert not refused.successful and refused.reason
    assert answerer.run.soc_target == 0.8


def test_a_peer_whose_qos_does_not_fit_is_named_with_the_policy(graph, drive):
    node = drive(BUS)
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    graph.node("peer").create_subscription(
        JointState, topics.COMMAND.name, lambda msg: None, latched
    )
    mismatches = node.outlet.mismatches
    graph.spin_until(lambda: mismatches, "the event")
    assert mismatches == {f"/{topics.COMMAND.name}": "DURABILITY"}
    assert "DURABILITY" in node._values()[f"qos_/{topics.COMMAND.name}"]


def test_a_drive_leaves_a_report_a_log_and_a_line(graph, drive, vehicle, tmp_path, capsys):
    log = ShadowLog(PARAMS, DT_S, price_of(PARAMS), tmp_path / "shadow.csv", {"policy": "half"})
    node = drive(BUS, Half(), shadow=True, log=log, report=tmp_path / "report.json")
    until(graph, vehicle, lambda: log.sum.ticks > 3, "a few ticks")
    node.shutdown()
    assert "policy: shadow: " in capsys.readouterr().out
    report = json.loads((tmp_path / "report.json").read_text())
    assert report["mode"] == "shadow" and report["ticks"] > 3
    summed = json.loads((tmp_path / "shadow.json").read_text())["sum"]
    assert summed["battery_difference_j"] > 0.0, "half of the demand would come from the battery"


def test_a_shadow_follows_an_incumbent_in_lockstep_and_changes_nothing(graph, make_cycle):
    params = load_powertrain("paper")
    graph.policy(Answerer(RuleBased(params)), "incumbent")
    config = DecideConfig(shadow=True, params=params)
    shadow = Answerer(RuleBased(params), config=config)
    log = ShadowLog(params, 1.0, price_of(params))
    PolicyNode(graph.node("shadow"), shadow, 10, Paperwork(True, log))
    demand_w = [60e3, 150e3, 200e3, 90e3, 20e3, 180e3]
    trajectory, _ = graph.drive(graph.plant(cycle=make_cycle(demand_w)))
    assert len(trajectory) == 6
    graph.spin_until(lambda: log.sum.ticks >= 4, "the log")
    assert log.sum.equivalent_difference_kg == pytest.approx(0.0, abs=1e-9)
    with pytest.raises(PolicyError, match="not in lockstep"):
        shadow.decider.engage()


def test_a_message_type_that_is_not_installed_is_named_with_its_package():
    with pytest.raises(ConfigError, match="no_such_msgs/msg/X: package no_such_msgs is not inst"):
        message_class("no_such_msgs/msg/X")
    with pytest.raises(ConfigError, match="package std_msgs has no such message"):
        message_class("std_msgs/msg/X")
    assert message_class(FLOAT) is Float64


def test_a_map_that_cannot_be_subscribed_stops_the_node_with_one_line_and_code_2(
    domain_id, monkeypatch, capfd, tmp_path
):
    path = tmp_path / "map.yaml"
    row = "{topic: t, type: no_such_msgs/msg/X, field: data, stamp: publish}"
    names = ("power_demand_w", "soc", "engine_power_w")
    path.write_text("vehicle: v\nsignals:\n" + "".join(f"  {name}: {row}\n" for name in names))
    monkeypatch.setattr("sys.argv", ["rule", "--ros-args", "-p", f"signals:={path}"])
    assert rule_based_policy.main() == 2
    (line,) = capfd.readouterr().err.splitlines()
    assert "no_such_msgs is not installed" in line and str(path) in line


def test_a_map_that_samples_otherwise_than_the_policy_was_made_for_is_refused():
    spec = ObservationSpec(
        ("power_demand_w", "soc", "engine_power_w"),
        0.1,
        mode="sampled",
        sampling=(Sampling("soc", "mean", 5.0),),
    )
    soc = replace(BUS.signals[1], how="last")
    signals = replace(BUS, signals=(BUS.signals[0], soc, BUS.signals[2]))
    with pytest.raises(PolicyError, match=r"soc\.how: last, the policy was made for mean"):
        SampledAnswerer(Half(spec=spec), signals, DecideConfig(params=PARAMS))


def test_what_a_policy_does_not_see_may_be_sampled_otherwise_than_where_it_learnt():
    spec = ObservationSpec(
        ("power_demand_w", "soc", "engine_power_w"),
        0.1,
        mode="sampled",
        sampling=(Sampling("battery_power_w", "mean", 5.0),),
    )
    battery = replace(BUS.signals[0], name="battery_power_w", how="last")
    signals = replace(BUS, signals=(*BUS.signals, battery))
    assert SampledAnswerer(Half(spec=spec), signals, DecideConfig(params=PARAMS)).spec == spec
    blind = replace(signals, signals=tuple(s for s in signals.signals if "engine" not in s.name))
    with pytest.raises(PolicyError, match=r"battery_power_w\.how: last"):
        SampledAnswerer(Half(spec=spec), blind, DecideConfig(params=PARAMS))


@pytest.mark.slow
def test_a_shadow_takes_over_from_a_real_incumbent_and_its_log_survives_sigkill(
    start, graph, wait_for, tmp_path
):
    path, log = tmp_path / "work.csv", tmp_path / "shadow.csv"
    rows = "".join(f"{0.1 * k:.1f},100e3\n" for k in range(20_000))
    path.write_text("time_s,power_demand_w\n" + rows)
    vehicle = {"powertrain": "paper:dt_s=0.1"}
    peer = graph.peer(topics.POWERTRAIN)
    client = peer.node.create_client(SetBool, "ddqn_policy/enable")
    words = {"signals": "signals", "powertrain": "paper", "shadow": True, "shadow_log": str(log)}
    shadow = start("ddqn_policy", **words, **LOOSE)
    incumbent = start("rule_based_policy", policy="conventional", **vehicle)
    plant = start("plant_sim", cycle=str(path), mode="real_time", **vehicle)

    def enabled():
        future = client.call_async(SetBool.Request(data=True))
        graph.spin_until(future.done, "the service")
        return future.result().success

    graph.spin_until(lambda: len(peer.heard[topics.POWERTRAIN.name]) > 20, "the incumbent")
    assert not enabled(), "one policy at a time"
    assert incumbent.end(signal.SIGTERM) == 0
    graph.spin_until(enabled, "the hand-over")
    wait_for(lambda: log.read_text().count("\n") > 20, "the log")
    assert shadow.end(signal.SIGKILL) != 0
    lines = [line for line in log.read_text().splitlines() if line[0].isdigit()]
    stamps = [int(line.split(",")[0]) for line in lines[:-1]]
    assert stamps == sorted(set(stamps)) and len(stamps) > 10
    assert plant.end(signal.SIGTERM) == 0
    assert "Traceback" not in incumbent.output + shadow.output + plant.output
