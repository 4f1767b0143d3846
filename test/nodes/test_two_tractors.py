"""Two tractors at once on one machine, in two namespaces or in two domains: none hears the other.

Different powertrains, policies, cycles and lengths, so that a crossed message cannot go unnoticed.
"""

import signal
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import domain_coordinator
import numpy as np
import pytest

from tractor_ems.bags.check import check
from tractor_ems.bags.read import read_bag
from tractor_ems.bags.runs import trajectory_of
from tractor_ems.drive import drive
from tractor_ems.policies.registry import make_rule
from tractor_msgs_py import topics
from tractor_msgs_py.codec import wire_soc
from tractor_msgs_py.trajectory import Trajectory, trajectory_hash
from tractor_sim.config import load_powertrain
from tractor_sim.run_files import read_run

pytestmark = pytest.mark.slow
VALUE = {
    "power_demand": "power_w",
    "battery_state": "soc",
    "powertrain_state": "applied_battery_power_w",
    "battery_power_command": "battery_power_w",
}
HEARD = (topics.POWER_DEMAND, topics.BATTERY, topics.POWERTRAIN, topics.COMMAND, topics.RUN_INFO)
SOC = 0.8
RECORDERS = 2
"""The recorder and the listener of this test: no tractor starts before it is listened to."""


@dataclass(frozen=True)
class Place:
    """Where a tractor's nodes live and how to listen there."""

    namespace: str
    domain: int
    graph: Any


@dataclass(frozen=True)
class Tractor:
    """What one tractor is told to do and, from the same policy in-process, what it must do."""

    name: str
    place: Place
    powertrain: str
    cycle: str
    executable: str
    policy: dict[str, str]
    expected: Trajectory


@pytest.fixture
def places(request, graph, domain_id, tmp_path) -> Iterator[list[Place]]:
    """Two namespaces of one domain, or no namespace in two domains."""
    if request.param == "namespaces":
        yield [Place(f"/tractor{i}", domain_id, graph) for i in (1, 2)]
        return
    with domain_coordinator.domain_id() as second:
        other = type(graph)(second, tmp_path)
        yield [Place("", domain_id, graph), Place("", second, other)]
        other.close()


@pytest.fixture
def tractors(places, make_cycle, untrained) -> list[Tractor]:
    """A learner on the paper's powertrain with even watts, a rule on a smaller one with odd."""
    policy_file, learned = untrained()
    levelling = make_rule("load_levelling", load_powertrain("utility_150kw"))
    learnt = {"policy_file": policy_file}
    level = {"policy": "load_levelling", "powertrain": "utility_150kw"}
    work = [
        ("paper", "ddqn_policy", learnt, learned, 500, 240e3),
        ("utility_150kw", "rule_based_policy", level, levelling, 450, 120e3),
    ]
    made = []
    for i, (powertrain, executable, parameters, policy, steps, top_w) in enumerate(work):
        params, rng = load_powertrain(powertrain), np.random.Generator(np.random.PCG64(i))
        demand_w = 2.0 * np.round(rng.uniform(0.0, top_w / 2.0, steps)) + i
        cycle = make_cycle(demand_w - params.p_aux_w, f"cycle{i}")
        (expected,) = drive(policy, params, demand_w[None], SOC, SOC)
        made.append(
            Tractor(f"tractor{i}", places[i], powertrain, cycle, executable, parameters, expected)
        )
    return made


def begin(tractor: Tractor, start: Callable, monkeypatch, folder: Path) -> dict[str, Any]:
    """Start plant, policy and recorder of one tractor where it lives."""
    monkeypatch.setenv("ROS_DOMAIN_ID", str(tractor.place.domain))
    there, depth = tractor.place.namespace, {"history_depth": 100_000}
    return {
        "plant_sim": start(
            "plant_sim", there, powertrain=tractor.powertrain, cycle=tractor.cycle,
            soc_initial=SOC, soc_target=SOC, expected_recorders=RECORDERS,
            output=folder / f"{tractor.name}_run", **depth,
        ),
        tractor.executable: start(tractor.executable, there, **tractor.policy, **depth),
        "bag_recorder": start("bag_recorder", there, output=folder / f"{tractor.name}_bag"),
    }  # fmt: skip


def own_values(expected: Trajectory) -> dict[str, dict[int, float]]:
    """By topic: the value that tells a tractor's message from the other's, by stamp."""
    stamps = expected.stamp_ns.tolist()
    after = [*stamps[1:], 2 * stamps[-1] - stamps[-2]]
    soc = wire_soc(np.array([*expected.soc, expected.soc_final])).tolist()
    return {
        "power_demand": dict(zip(stamps, expected.power_demand_w.tolist(), strict=True)),
        "battery_state": dict(zip([stamps[0], *after], soc, strict=True)),
        "powertrain_state": dict(
            zip([stamps[0], *after], [0.0, *expected.battery_power_w.tolist()], strict=True)
        ),
        "battery_power_command": dict(
            zip(stamps, expected.command_battery_power_w.tolist(), strict=True)
        ),
    }


def crossed(heard: dict[str, list[Any]], expected: Trajectory) -> list[Any]:
    """Messages that are none of this tractor's own."""
    own = own_values(expected)
    return [
        sample
        for topic, field in VALUE.items()
        for sample in heard[topic]
        if own[topic].get(sample.stamp_ns) != getattr(sample, field)
    ]


def listen(tractor: Tractor, order: list[str]) -> Any:
    """Hear every topic where a tractor lives, and note in which order they spoke."""
    peer = tractor.place.graph.peer(
        *HEARD, name=f"listener_{tractor.name}", namespace=tractor.place.namespace
    )
    peer.on_sample = lambda sample: order.append(tractor.name)
    return peer


@pytest.mark.parametrize("places", ["namespaces", "domains"], indirect=True)
def test_two_tractors_at_once_hear_and_record_only_themselves(
    tractors, start, monkeypatch, tmp_path
):
    graphs = list(dict.fromkeys(t.place.graph for t in tractors))
    reports = [graph.peer(topics.DIAGNOSTICS, name="reader") for graph in graphs]
    nodes = [begin(t, start, monkeypatch, tmp_path) for t in tractors]
    for t, started in zip(tractors, nodes, strict=True):
        wanted = {(name, t.place.namespace or "/") for name in started}
        observer = t.place.graph.node(f"observer_{t.name}")
        t.place.graph.spin_until(
            lambda o=observer, w=wanted: w <= set(o.get_node_names_and_namespaces()),
            f"the nodes of {t.name}",
        )
    order: list[str] = []
    listeners = [listen(t, order) for t in tractors]
    while any(started["plant_sim"].process.poll() is None for started in nodes):
        for graph in graphs:
            graph.spin(1)

    first = [order.index(t.name) for t in tractors]
    last = [len(order) - order[::-1].index(t.name) for t in tractors]
    assert max(first) < min(last), "they did not drive at the same time"
    run_ids = set()
    for t, started, listener, other in zip(
        tractors, nodes, listeners, reversed(tractors), strict=True
    ):
        outputs = {name: process.output for name, process in started.items()}
        assert started["plant_sim"].end() == started["bag_recorder"].end() == 0, outputs
        assert started[t.executable].end(signal.SIGTERM) == 0, outputs
        trajectory, result = read_run(tmp_path / f"{t.name}_run")
        assert trajectory_hash(trajectory) == trajectory_hash(t.expected)
        run_ids.add(result["run_id"])

        assert {info.run_id for info in listener.heard["run_info"]} == {result["run_id"]}
        assert all(len(listener.heard[topic]) > 100 for topic in VALUE)
        assert not crossed(listener.heard, t.expected)
        to_the_other = crossed(listener.heard, other.expected)
        assert len(to_the_other) >= len(listener.heard["power_demand"])  # it would be noticed

        report = check(tmp_path / f"{t.name}_bag")
        assert report.verdict == "pass", report.checks
        (run,) = read_bag(tmp_path / f"{t.name}_bag")
        assert (run.info.run_id, run.namespace) == (result["run_id"], t.place.namespace or "/")
        assert trajectory_hash(trajectory_of(run)) == trajectory_hash(t.expected)
        assert run.policy == t.executable.removesuffix("_policy")
    assert len(run_ids) == len(tractors)

    # /diagnostics is one topic of a domain, for people: its names say which tractor is meant.
    for graph, report in zip(graphs, reports, strict=True):
        here = {
            f"{t.place.namespace}/{name}"
            for t, started in zip(tractors, nodes, strict=True)
            for name in started
            if t.place.graph is graph
        }
        names = {s.name for array in report.heard["/diagnostics"] for s in array.status}
        assert names and names <= here
