"""One run of the plant, tick by tick: what its sensors say, what a command does, and the record.

Pure and without a clock: ``lockstep`` and ``real_time`` decide when a command is applied, the
node only carries samples. The physics is ``powertrain.step``, as everywhere else.
"""

import uuid
from typing import Literal

import numpy as np

from tractor_msgs_py import __version__
from tractor_msgs_py.codec import wire_soc
from tractor_msgs_py.errors import ConfigError, CycleError
from tractor_msgs_py.trajectory import FloatArray, Trajectory
from tractor_msgs_py.types import (
    DEFAULT_T0_NS,
    BatteryPowerCommand,
    PowerDemand,
    RunInfo,
    Sample,
)
from tractor_sim.config import load_powertrain
from tractor_sim.duty_cycle.cycle import cycle_hash
from tractor_sim.duty_cycle.library import load_cycle
from tractor_sim.powertrain import (
    Command,
    PowertrainParams,
    StepResult,
    feasible_battery_power_w,
    initial_state,
    power_limits,
    step,
)
from tractor_sim.powertrain_json import powertrain_hash
from tractor_sim.readings import battery_reading, powertrain_reading

UNSET_SOC = -1.0
"""What a SOC parameter says to mean "the default": ROS parameters have no null."""


class PlantRun:
    """State of one run and everything it applied; T steps, batch of one.

    Attributes:
        params, info: the vehicle and the run.
        power_demand_w: demand at the bus, auxiliaries included, shape (T,) [W].
        k: the tick that waits for its command; T when the run is done.
    """

    def __init__(
        self, params: PowertrainParams, info: RunInfo, power_demand_w: FloatArray
    ) -> None:
        self.params = params
        self.info = info
        self.power_demand_w = power_demand_w
        self.k = 0
        self._state = initial_state(params, info.soc_initial)
        self._last: StepResult | None = None
        self._rows: list[tuple[float, ...]] = []

    @property
    def done(self) -> bool:
        """True after the last step."""
        return self.k >= self.info.steps

    @property
    def stamp_ns(self) -> int:
        """Stamp of the present tick [ns]."""
        return self.info.stamp_ns(self.k)

    def samples(self) -> tuple[Sample, ...]:
        """What the plant publishes at the present tick; the final state comes without demand."""
        state = (
            battery_reading(self.params, self._state, self._last, self.stamp_ns),
            powertrain_reading(self.params, self._state, self._last, self.stamp_ns),
        )
        if self.done:
            return state
        return (PowerDemand(self.stamp_ns, float(self.power_demand_w[self.k])), *state)

    def closing_samples(self) -> tuple[Sample, ...]:
        """The end of a finished run as it is repeated until everyone has acknowledged it."""
        last = self.info.steps - 1
        demand = PowerDemand(self.info.stamp_ns(last), float(self.power_demand_w[last]))
        return (demand, *self.samples())

    def feasible_w(self) -> tuple[float, float]:
        """lb and ub of battery power at the present tick [W]."""
        demand_w = self.power_demand_w[self.k : self.k + 1]
        lb, ub = feasible_battery_power_w(power_limits(self.params, self._state), demand_w)
        return float(lb[0]), float(ub[0])

    def apply(self, command: BatteryPowerCommand) -> StepResult:
        """Drive the present step with ``command`` (projected, whatever it holds); go on."""
        demand_w = self.power_demand_w[self.k : self.k + 1]
        before = self._state
        asked = Command(np.array([command.battery_power_w]), np.array([command.engine_power_w]))
        self._state, result = step(self.params, before, demand_w, asked)
        self._rows.append(
            (
                float(demand_w[0]),
                float(wire_soc(before.soc[0])),
                command.battery_power_w,
                command.engine_power_w,
                float(result.battery_power_w[0]),
                float(result.engine_power_w[0]),
                float(result.fuel_kg[0]),
                float(self._state.engine_on[0]),
                float(result.shortfall_j[0]),
                float(result.dissipated_j[0]),
                float(before.soc[0]),
            )
        )
        self._last = result
        self.k += 1
        return result

    def trajectory(self) -> Trajectory:
        """The steps driven so far, from the plant's own data. Call after at least one step."""
        columns = np.array(self._rows, dtype=np.float64).T
        stamps = self.info.t0_ns + self.info.dt_ns * np.arange(self.k, dtype=np.int64)
        return Trajectory(
            stamp_ns=stamps,
            power_demand_w=columns[0],
            soc_observed=columns[1],
            command_battery_power_w=columns[2],
            command_engine_power_w=columns[3],
            battery_power_w=columns[4],
            engine_power_w=columns[5],
            fuel_kg=columns[6],
            engine_on=columns[7] != 0.0,
            shortfall_j=columns[8],
            dissipated_j=columns[9],
            soc=columns[10],
            soc_final=float(self._state.soc[0]),
        )


def prepare_run(
    powertrain: str,
    cycle: str,
    soc_initial: float = UNSET_SOC,
    soc_target: float = UNSET_SOC,
    mode: Literal["lockstep", "real_time"] = "lockstep",
    expected_recorders: int = 0,
    command_line: str = "",
) -> PlantRun:
    """A run from names or files, with a run id of its own.

    Args:
        powertrain: name or YAML file.
        cycle: name or CSV file.
        soc_initial: fraction; :data:`UNSET_SOC` is the powertrain's.
        soc_target: fraction; :data:`UNSET_SOC` is the powertrain's, or where the run starts.
        mode: whether the plant waits for the answer to each tick.
        expected_recorders: recorders that must be matched before the first tick.
        command_line: what started the plant, for the record.

    Raises:
        ConfigError: unknown or malformed powertrain, or a SOC outside its window.
        CycleError: unknown or malformed cycle, or one of another step length.
    """
    params = load_powertrain(powertrain)
    duty = load_cycle(cycle)
    if abs(duty.dt_s - params.dt_s) > 1e-9:
        raise CycleError(
            f"cycle {duty.name}: dt_s {duty.dt_s}, powertrain {params.name} needs {params.dt_s} "
            f"(ems cycle import --dt {params.dt_s:g} resamples)"
        )
    initial = params.soc_initial if soc_initial == UNSET_SOC else soc_initial
    target = params.soc_target if soc_target == UNSET_SOC else soc_target
    target = initial if target is None else target
    low, high = params.battery.soc_min, params.battery.soc_max
    for name, value in (("soc_initial", initial), ("soc_target", target)):
        if not low <= value <= high:
            raise ConfigError(
                f"parameter {name}: {value}, allowed {low}..{high} of powertrain {params.name}, "
                f"or {UNSET_SOC} for its default"
            )
    info = RunInfo(
        run_id=uuid.uuid4().hex,
        cycle=duty.name,
        cycle_hash=cycle_hash(duty),
        powertrain=params.name,
        powertrain_hash=powertrain_hash(params),
        t0_ns=DEFAULT_T0_NS,
        dt_s=params.dt_s,
        steps=len(duty),
        p_aux_w=params.p_aux_w,
        soc_initial=initial,
        soc_target=target,
        lockstep=mode == "lockstep",
        expected_recorders=expected_recorders,
        package_version=__version__,
        command_line=command_line,
    )
    return PlantRun(params, info, duty.power_demand_w + params.p_aux_w)
