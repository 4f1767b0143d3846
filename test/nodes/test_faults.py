"""What goes wrong on a wire, told to real executables: who falls back, drives on, recovers.

The faults are in faults.py, the reaction times in docs/measured.md; here only behaviour counts.
"""

import signal
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import pytest
from nodes.faults import (
    DIFFERENT_SAMPLED,
    PERIOD_S,
    PLANT_FAULTS,
    POLICY_FAULTS,
    Outcome,
    PlantFault,
    PolicyFault,
    try_plant,
    try_policy,
)
from nodes.lost_processes import lose_and_replace
from nodes.scripted import SOC, TENTH, ScriptedPlant, ScriptedPolicy, random_demand, write_cycle
from nodes.stage import Process, Stage, stage

from tractor_msgs_py import topics
from tractor_msgs_py.ros.wire import publish_on
from tractor_msgs_py.types import BatteryPowerCommand, BatteryReading, CommandMode
from tractor_sim.plant_run import prepare_run

pytestmark = pytest.mark.slow
TIMEOUT_S = 0.4
PATIENCE_S, LONGEST_S = 1.2, 20.0
"""How long a side is watched that should drive on, and one that should fall back [s]."""

STEPS = 20_000
OBSERVATION = (topics.POWER_DEMAND, topics.BATTERY, topics.POWERTRAIN)


@pytest.fixture(scope="module")
def on() -> Iterator[Stage]:
    with stage() as made:
        yield made


@pytest.fixture(scope="module")
def work(on) -> str:
    return write_cycle(on.folder / "work.csv", random_demand(0, STEPS), PERIOD_S)


@pytest.fixture(scope="module")
def even(on) -> str:
    """Constant: a held set-point then leaves the battery what it had, the fallback law 0."""
    return write_cycle(on.folder / "even.csv", [100e3] * STEPS, PERIOD_S)


def policy_of(on: Stage, there: str, sampled: bool) -> Process:
    """A real policy, by equal stamps or through the map of the simulator's own topics."""
    how = {"signals": "signals"} if sampled else {}
    return on.start(
        "rule_based_policy", there, powertrain=TENTH, observation_timeout_s=TIMEOUT_S, **how
    )


@pytest.fixture(scope="module")
def plant(request, on, work) -> Iterator[ScriptedPlant]:
    """A scripted plant with a real policy that hears it."""
    there = f"/{request.param}"
    policy = policy_of(on, there, request.param == "sampled")
    peer = on.graph.peer(topics.COMMAND, name="scripted_plant", namespace=there)
    scripted = ScriptedPlant(peer, work)
    yield scripted
    assert on.end(policy) == 0, policy.output
    assert "Traceback" not in policy.output

    def last() -> CommandMode:
        return scripted.commands[-1][1].mode

    on.graph.spin_until(lambda: last() is CommandMode.SHUTDOWN, "what it leaves behind")
    on.graph.spin(5)
    assert last() is CommandMode.SHUTDOWN
    on.graph.remove(peer.node)


def start_plant(on: Stage, cycle: str, **parameters: Any) -> Any:
    return on.start(
        "plant_sim",
        powertrain=TENTH,
        cycle=cycle,
        mode="real_time",
        command_timeout_s=TIMEOUT_S,
        soc_initial=SOC,
        **parameters,
    )


@pytest.fixture(scope="module")
def policy(on, even) -> Iterator[ScriptedPolicy]:
    """A scripted policy with a real plant that hears it, in a namespace of their own."""
    peer = on.graph.peer(*OBSERVATION, name="scripted_policy", namespace="/other")
    node = start_plant(on, even, namespace="/other")
    yield ScriptedPolicy(peer)
    assert on.end(node) == 0, node.output
    assert "Traceback" not in node.output
    on.graph.remove(peer.node)


TRIES = 3
"""A busy machine may stop a node for longer than its timeout, which then rightly falls back: a
side that should drive on must do so in one of three tries."""


def judge(fault: PolicyFault | PlantFault, attempt: Callable[[float], Outcome]) -> Outcome:
    for _ in range(TRIES if fault.drives_on else 1):
        outcome = attempt(PATIENCE_S if fault.drives_on else LONGEST_S)
        assert outcome.unsafe == 0, outcome
        assert outcome.recovery_ticks is not None, outcome
        if (outcome.reaction_s is None) == fault.drives_on:
            return outcome
    raise AssertionError(f"{fault.expected} was expected: {outcome}")


@pytest.mark.parametrize(
    ("plant", "fault"),
    [
        pytest.param(mode, fault, id=f"{mode}: {fault.name}")
        for mode in ("exact", "sampled")
        for fault in POLICY_FAULTS
        if mode == "exact" or fault.name in DIFFERENT_SAMPLED
    ],
    indirect=["plant"],
)
def test_a_policy_answers_what_it_hears_safely(on, plant, fault: PolicyFault, request):
    sampled = request.node.callspec.params["plant"] == "sampled"
    outcome = judge(fault, lambda patience_s: try_policy(on.graph, plant, fault, patience_s))
    if fault.drives_on:
        assert outcome.nominal > 0.5, outcome
    else:
        assert outcome.reason is (fault.reason_sampled if sampled else fault.reason)


def test_percent_that_is_mapped_as_a_fraction_never_drives_and_is_told_the_scale(on, work):
    policy = policy_of(on, "/percent", sampled=True)
    peer = on.graph.peer(
        topics.COMMAND, topics.DIAGNOSTICS, name="scripted_plant", namespace="/percent"
    )
    plant, diagnosed = ScriptedPlant(peer, work), peer.heard[topics.DIAGNOSTICS.name]
    plant.begin()

    def told() -> bool:
        plant.tick(changed=lambda s: replace(s, soc=80.0) if isinstance(s, BatteryReading) else s)
        on.graph.spin_to(plant.next_s())
        values = [value for array in diagnosed for s in array.status for value in s.values]
        return any(v.key == "missing_soc" and "scale: 0.01" in v.value for v in values)

    on.graph.spin_until(told, "the hint")
    assert not any(command.mode is CommandMode.NOMINAL for _, command in plant.commands)
    assert on.end(policy) == 0, policy.output
    on.graph.remove(peer.node)


@pytest.mark.parametrize("fault", PLANT_FAULTS, ids=lambda fault: fault.name)
def test_a_plant_applies_only_what_is_right(on, policy, fault: PlantFault):
    judge(fault, lambda patience_s: try_plant(on.graph, policy, fault, patience_s))


def test_a_lost_policy_or_plant_is_noticed_and_its_replacement_drives(on):
    took = lose_and_replace(on, TIMEOUT_S)
    assert len(took) == 6
    assert min(took.values()) > 0.0


def wrong(topic: topics.Topic) -> topics.Topic:
    """The topic with the QoS that does not reach a subscriber of the contract's."""
    if topic.qos.durability == "transient_local":
        return replace(topic, qos=replace(topic.qos, durability="volatile"))
    return replace(topic, qos=replace(topic.qos, reliability="best_effort"))


def test_a_peer_with_the_wrong_qos_is_named_and_not_heard(on, even):
    """Here the scripted sides publish best effort, and run_info without its history."""
    policy = on.start("rule_based_policy", namespace="/qos", powertrain=TENTH)
    vehicle = start_plant(on, even, namespace="/qos_plant")
    peers = [
        on.graph.peer(topics.COMMAND, name="wrong_plant", namespace="/qos"),
        on.graph.peer(*OBSERVATION, name="wrong_policy", namespace="/qos_plant"),
    ]
    for topic in (topics.RUN_INFO, *OBSERVATION):
        peers[0]._publishers[topic.name] = publish_on(peers[0].node, wrong(topic))
    peers[1]._publishers[topics.COMMAND.name] = publish_on(peers[1].node, wrong(topics.COMMAND))
    run = prepare_run(TENTH, even, mode="real_time")
    samples = (run.info, *run.samples())

    def named() -> bool:
        peers[0].say(*samples)
        peers[1].say(BatteryPowerCommand(run.stamp_ns, 0.0))
        on.graph.spin_to(time.monotonic() + PERIOD_S)
        said = policy.output.count("QoS") + vehicle.output.count("QoS")
        return said >= 5

    on.graph.spin_until(named, "a line about every wrong topic")
    for topic in (topics.RUN_INFO, *OBSERVATION):
        assert topic.name in policy.output
    assert topics.COMMAND.name in vehicle.output
    assert not any(heard for peer in peers for heard in peer.heard.values())
    for node in (policy, vehicle):
        assert on.end(node) == 0, node.output
    for peer in peers:
        on.graph.remove(peer.node)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_more_signals_do_not_kill_a_node_that_is_ending(on, number):
    there = f"/{number.name.lower()}"
    node = policy_of(on, there, sampled=False)
    watcher = on.graph.node("watcher", there)
    known = watcher.get_node_names_and_namespaces
    on.graph.spin_until(lambda: ("rule_based_policy", there) in known(), "the policy")

    def ended() -> bool:
        node.process.send_signal(number)
        return node.process.poll() is not None

    on.graph.spin_until(ended, "its end")
    assert node.end() == 0, node.output
    assert "Traceback" not in node.output
    on.graph.remove(watcher)
