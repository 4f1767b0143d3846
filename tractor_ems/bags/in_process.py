"""In-process runs as bags: the plant's and the policy's samples through the same codec, writer
and finaliser as a recording of the nodes, without ROS.

Equal runs of one command line give equal bytes: times are the stamps, and the run id follows
from the content.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path

from tractor_ems.bags.rosbags_messages import RosbagsMessages, serialize
from tractor_ems.bags.write import BagWriter
from tractor_ems.drive import drive
from tractor_ems.policies.protocol import Policy
from tractor_ems.scenario import Scenario
from tractor_msgs_py import __version__, topics
from tractor_msgs_py.codec import encode
from tractor_msgs_py.errors import BagError
from tractor_msgs_py.provenance import command_line
from tractor_msgs_py.trajectory import FloatArray, IntArray, Trajectory, trajectory_hash
from tractor_msgs_py.types import BatteryPowerCommand, PowerDemand, RunInfo, Sample
from tractor_sim.duty_cycle.cycle import cycle_hash
from tractor_sim.plant_run import PlantRun
from tractor_sim.powertrain import PowertrainParams
from tractor_sim.powertrain_json import powertrain_hash


def record_in_process(policy: Policy, scenario: Scenario, out: Path) -> Trajectory:
    """Drive ``policy`` over ``scenario`` and record the run into the new bag ``out``.

    The bag names the command line of this process.

    Raises:
        BagError: ``out`` exists already or cannot be created.
        RunAborted: writing it failed midway.
        PolicyError: the policy was made for another step length.
    """
    trajectory = drive(
        policy,
        scenario.params,
        scenario.power_demand_w[None, :],
        scenario.soc_initial,
        scenario.soc_target,
    )[0]
    info = run_info_of(scenario, trajectory, policy.name, command_line())
    write_trajectory_bag(out, scenario.params, info, trajectory, policy.name)
    return trajectory


def run_info_of(
    scenario: Scenario, trajectory: Trajectory, policy: str, command_line: str = ""
) -> RunInfo:
    """What a plant would announce for this run; the run id names policy, cycle and trajectory."""
    return RunInfo(
        run_id=f"{policy}-{scenario.cycle.name}-{trajectory_hash(trajectory)[:16]}",
        cycle=scenario.cycle.name,
        cycle_hash=cycle_hash(scenario.cycle),
        powertrain=scenario.params.name,
        powertrain_hash=powertrain_hash(scenario.params),
        t0_ns=int(trajectory.stamp_ns[0]),
        dt_s=scenario.params.dt_s,
        steps=len(scenario.cycle),
        p_aux_w=scenario.params.p_aux_w,
        soc_initial=scenario.soc_initial,
        soc_target=scenario.soc_target,
        package_version=__version__,
        command_line=command_line,
    )


def write_trajectory_bag(
    out: Path,
    params: PowertrainParams,
    info: RunInfo,
    trajectory: Trajectory,
    policy: str = "",
) -> None:
    """Write a run that was driven in-process as a bag.

    Raises:
        BagError: ``out`` exists already or cannot be written, or ``params`` do not reproduce
            the trajectory.
    """
    samples, again = samples_of(params, info, trajectory)
    if trajectory_hash(again) != trajectory_hash(trajectory):
        raise BagError(f"{out}: powertrain {params.name} does not reproduce the trajectory")
    provenance = {"recorder": "in_process", "command_line": info.command_line}
    write_samples_bag(out, samples, {**provenance, f"policy:{info.run_id}": policy})


def samples_of(
    params: PowertrainParams, info: RunInfo, trajectory: Trajectory
) -> tuple[list[Sample], Trajectory]:
    """Everything plant and policy say during a run, in order, and the trajectory once more.

    The commands are driven on the plant again: messages hold more of its state than a
    trajectory does.
    """
    run = PlantRun(params, info, trajectory.power_demand_w)
    samples: list[Sample] = [info]
    for battery_power_w, engine_power_w in zip(
        trajectory.command_battery_power_w.tolist(),
        trajectory.command_engine_power_w.tolist(),
        strict=True,
    ):
        command = BatteryPowerCommand(run.stamp_ns, battery_power_w, engine_power_w)
        samples += [*run.samples(), command]
        run.apply(command)
    return [*samples, *run.samples()], run.trajectory()


def write_demand_bag(
    out: Path, stamp_ns: IntArray, power_demand_w: FloatArray, namespace: str = ""
) -> None:
    """Write a recording of demand alone, both of shape (T,), as a vehicle without the stack
    would leave it.

    Raises:
        BagError: ``out`` exists already or cannot be written.
    """
    pairs = zip(stamp_ns.tolist(), power_demand_w.tolist(), strict=True)
    samples: list[Sample] = [PowerDemand(stamp, power_w) for stamp, power_w in pairs]
    write_samples_bag(out, samples, {"recorder": "in_process"}, namespace)


def write_samples_bag(
    out: Path, samples: Sequence[Sample], provenance: Mapping[str, str], namespace: str = ""
) -> None:
    """Write samples in the given order, which readers keep: each is logged at its stamp, or with
    the one before it where stamps go back, as they do at the start of a second run.

    Args:
        namespace: of the topics, for instance ``/tractor1``.

    Raises:
        BagError: ``out`` exists already or cannot be written.
    """
    factory = RosbagsMessages()
    encoded = [(sample, *encode(sample, factory)) for sample in samples]
    used = {topic.name for _, topic, _ in encoded}
    channels = {f"{namespace}/{t.name}": t for t in topics.RECORDED if t.name in used}
    sequence = dict.fromkeys(channels, 0)
    log_time_ns = min(s.stamp_ns for s in samples if not isinstance(s, RunInfo))
    with BagWriter(out, channels, provenance) as bag:
        for sample, topic, message in encoded:
            name = f"{namespace}/{topic.name}"
            sequence[name] += 1
            if not isinstance(sample, RunInfo):
                log_time_ns = max(log_time_ns, sample.stamp_ns)
            data = serialize(message, topic.type)
            bag.write(name, data, log_time_ns, log_time_ns, sequence[name])
