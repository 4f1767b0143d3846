"""Writes a driven run as a vehicle without this stack would record it: other topics and units,
10, 5 and 1 Hz, stamps that jitter, no ``run_info``. config/signals_example_vehicle.yaml maps it.

    python test/signals/vehicle_bag.py OUT [--cycle planter_21] [--policy rule_based] [--seconds N]
"""

import argparse
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from tractor_ems.bags.rosbags_messages import RosbagsMessages, serialize, typestore
from tractor_ems.bags.write import BagWriter
from tractor_ems.drive import drive
from tractor_ems.policies.registry import make_policy
from tractor_ems.scenario import Scenario, make_scenario
from tractor_msgs_py.topics import JOINT_STATE, Topic
from tractor_msgs_py.trajectory import Trajectory
from tractor_sim.config import load_powertrain
from tractor_sim.duty_cycle.library import load_cycle

FLOAT64 = "std_msgs/msg/Float64"
EPOCH_NS = 1_750_000_000_000_000_000
KG_PER_S_TO_L_PER_H = 1.0 / 2.3194e-4
TRACTION_SHARE = 0.6
"""Of the demand; the implement takes the rest."""

RATES_HZ = {
    "hv/bus_voltage": 10,
    "hv/traction_current": 10,
    "hv/implement_current": 10,
    "bms/current": 10,
    "genset/state": 5,
    "genset/fuel_rate": 5,
    "bms/soc_percent": 1,
}


@dataclass(frozen=True)
class Message:
    """One message on its way: stamped by its sender, published, heard by the recorder."""

    topic: str
    type: str
    data: bytes
    publish_ns: int
    log_ns: int


def vehicle_run(
    cycle: str = "planter_21",
    policy: str = "rule_based",
    seconds: int | None = None,
    first: int = 0,
    powertrain: str = "paper:dt_s=0.1",
) -> tuple[Scenario, Trajectory]:
    """A cycle, each of its seconds held for ten steps of 0.1 s, and a drive over it."""
    listed = load_cycle(cycle)
    part_w = listed.power_demand_w[first : None if seconds is None else first + seconds]
    made = make_scenario(powertrain.partition(":")[0], cycle)
    fine = replace(listed, power_demand_w=np.repeat(part_w, 10), dt_s=0.1)
    params = load_powertrain(powertrain)
    scenario = replace(made, params=params, cycle=fine, powertrain_source=powertrain)
    trajectory = drive(
        make_policy(policy, scenario),
        params,
        scenario.power_demand_w[None, :],
        scenario.soc_initial,
        scenario.soc_target,
        t0_ns=EPOCH_NS,
    )[0]
    return scenario, trajectory


def messages(
    scenario: Scenario, trajectory: Trajectory, jitter_s: float, seed: int
) -> Iterator[Message]:
    """What the vehicle says, each topic in its own order.

    A value is published up to ``jitter_s`` after it became true and heard up to 5 ms later.
    """
    rng = np.random.Generator(np.random.PCG64(seed))
    factory, float64 = RosbagsMessages(), typestore().types[FLOAT64]
    steps, dt_s = len(trajectory), scenario.params.dt_s
    soc = np.append(trajectory.soc, trajectory.soc_final)
    voltage_v = 650.0 + 60.0 * (soc[:-1] - 0.85) - trajectory.battery_power_w / 20e3
    engine_w, demand_w = trajectory.engine_power_w, trajectory.power_demand_w
    columns = {
        "hv/bus_voltage": voltage_v,
        "hv/traction_current": TRACTION_SHARE * demand_w / voltage_v,
        "hv/implement_current": (1.0 - TRACTION_SHARE) * demand_w / voltage_v,
        "bms/current": -trajectory.battery_power_w / voltage_v,
        "genset/fuel_rate": trajectory.fuel_kg / dt_s * KG_PER_S_TO_L_PER_H,
        "bms/soc_percent": 100.0 * soc[:-1],
    }
    for topic, rate_hz in RATES_HZ.items():
        stride = round(1.0 / (rate_hz * dt_s))
        delay_ns = rng.integers(0, round(jitter_s * 1e9) + 1, steps)
        heard_ns = rng.integers(200_000, 5_000_000, steps)
        for k in range(0, steps, stride):
            stamp_ns = int(trajectory.stamp_ns[k] + delay_ns[k])
            if topic == "genset/state":
                on = float(trajectory.engine_on[k])
                message = factory.joint_state(
                    stamp_ns, ("engine_running", "electric_power_kw"), (on, engine_w[k] / 1e3)
                )
                kind = JOINT_STATE
            else:
                message, kind = float64(data=float(columns[topic][k])), FLOAT64
            data = serialize(message, kind)
            yield Message(topic, kind, data, stamp_ns, stamp_ns + int(heard_ns[k]))


def write_vehicle_bag(
    out: Path,
    scenario: Scenario,
    trajectory: Trajectory,
    *,
    jitter_s: float = 0.004,
    seed: int = 0,
    namespace: str = "/tractor1",
) -> None:
    """Record the run into the new bag ``out``."""
    said = sorted(messages(scenario, trajectory, jitter_s, seed), key=lambda m: m.log_ns)
    kinds = {f"{namespace}/{m.topic}": m.type for m in said}
    channels = {name: Topic(name, kind) for name, kind in kinds.items()}
    with BagWriter(out, channels, {"recorder": "vehicle_bag.py"}) as bag:
        for m in said:
            bag.write(f"{namespace}/{m.topic}", m.data, m.log_ns, m.publish_ns)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path)
    parser.add_argument("--cycle", default="planter_21")
    parser.add_argument("--policy", default="rule_based")
    parser.add_argument("--seconds", type=int, default=None)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--jitter-s", type=float, default=0.004)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    driven = vehicle_run(given.cycle, given.policy, given.seconds, given.first)
    write_vehicle_bag(given.out, *driven, jitter_s=given.jitter_s, seed=given.seed)
