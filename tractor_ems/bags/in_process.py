"""In-process runs as bags: the plant's and the policy's samples through the same codec, writer
and finaliser as a recording of the nodes, without ROS.

Equal runs give equal bytes: times are the stamps, and the run id follows from the content.
"""

from pathlib import Path

from tractor_ems.bags.rosbags_messages import RosbagsMessages, serialize
from tractor_ems.bags.write import BagWriter
from tractor_ems.drive import drive
from tractor_ems.policies.protocol import Policy
from tractor_ems.scenario import Scenario
from tractor_msgs_py import __version__, topics
from tractor_msgs_py.codec import encode
from tractor_msgs_py.errors import BagError
from tractor_msgs_py.trajectory import Trajectory, trajectory_hash
from tractor_msgs_py.types import BatteryPowerCommand, RunInfo, Sample
from tractor_sim.duty_cycle.cycle import cycle_hash
from tractor_sim.plant_run import PlantRun
from tractor_sim.powertrain import PowertrainParams
from tractor_sim.powertrain_json import powertrain_hash

_CHANNELS = {f"/{topic.name}": topic for topic in topics.RECORDED}


def record_in_process(
    policy: Policy, scenario: Scenario, out: Path, command_line: str = ""
) -> Trajectory:
    """Drive ``policy`` over ``scenario`` and record the run into the new bag ``out``.

    Raises:
        BagError: ``out`` exists already or cannot be written.
        PolicyError: the policy was made for another step length.
    """
    trajectory = drive(
        policy,
        scenario.params,
        scenario.power_demand_w[None, :],
        scenario.soc_initial,
        scenario.soc_target,
    )[0]
    info = run_info_of(scenario, trajectory, policy.name, command_line)
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
    written_steps: int | None = None,
) -> None:
    """Write a run that was driven in-process as a bag.

    The commands are driven on the plant once more, because the messages hold more of its state
    than a trajectory does. ``written_steps`` stops early, as an aborted run does.

    Raises:
        BagError: ``out`` exists already or cannot be written, or ``params`` do not reproduce
            the trajectory.
    """
    run = PlantRun(params, info, trajectory.power_demand_w)
    steps = len(trajectory) if written_steps is None else written_steps
    pairs = zip(
        trajectory.command_battery_power_w.tolist(),
        trajectory.command_engine_power_w.tolist(),
        strict=True,
    )
    sent: list[Sample] = [info]
    for battery_power_w, engine_power_w in [*pairs][:steps]:
        command = BatteryPowerCommand(run.stamp_ns, battery_power_w, engine_power_w)
        sent += [*run.samples(), command]
        run.apply(command)
    sent += run.samples()
    again = run.trajectory()
    if steps == len(trajectory) and trajectory_hash(again) != trajectory_hash(trajectory):
        raise BagError(f"{out}: powertrain {params.name} does not reproduce the trajectory")
    write_samples_bag(
        out,
        sent,
        {
            "recorder": "in_process",
            "command_line": info.command_line,
            f"policy:{info.run_id}": policy,
        },
    )


def write_samples_bag(out: Path, samples: list[Sample], provenance: dict[str, str]) -> None:
    """Write samples in the given order, each logged at its stamp, run_info at that before it.

    Raises:
        BagError: ``out`` exists already or cannot be written.
    """
    factory = RosbagsMessages()
    encoded = [(sample, *encode(sample, factory)) for sample in samples]
    used = {topic.name for _, topic, _ in encoded}
    channels = {name: topic for name, topic in _CHANNELS.items() if topic.name in used}
    sequence = dict.fromkeys(channels, 0)
    log_time_ns = min(s.stamp_ns for s in samples if not isinstance(s, RunInfo))
    with BagWriter(out, channels, provenance) as bag:
        for sample, topic, message in encoded:
            name = f"/{topic.name}"
            sequence[name] += 1
            if not isinstance(sample, RunInfo):
                log_time_ns = sample.stamp_ns
            data = serialize(message, topic.type)
            bag.write(name, data, log_time_ns, log_time_ns, sequence[name])
