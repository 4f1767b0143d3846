"""One run of the plant, tick by tick: what its sensors say, what a command does, and the record.

Pure and without a clock: ``lockstep`` and ``real_time`` decide when a command is applied, the
node only carries samples. The physics is ``powertrain.step``, as everywhere else.
"""

import uuid
from collections import Counter
from typing import Literal

import numpy as np

from tractor_msgs_py import __version__
from tractor_msgs_py.codec import wire_soc
from tractor_msgs_py.errors import ConfigError, CycleError
from tractor_msgs_py.trajectory import FloatArray, Trajectory
from tractor_msgs_py.types import (
    DEFAULT_T0_NS,
    BatteryPowerCommand,
    DutyCycleInfo,
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
        power_demand_w: demand at the bus, auxiliaries included, shape (T,) [W]; NaN where it comes
            from a topic and has not come yet.
        k: the tick that waits for its command; T when the run is done.
        held: the present tick is driven with an older demand, because its own has not come.
        demand_counters: what happened to demand from a topic; empty for a cycle of the plant's.
    """

    def __init__(
        self, params: PowertrainParams, info: RunInfo, power_demand_w: FloatArray
    ) -> None:
        self.params = params
        self.info = info
        self.power_demand_w = power_demand_w
        self.k = 0
        self.held = False
        self.demand_counters: Counter[str] = Counter()
        self._held: set[int] = set()
        self._newest = (-1, 0.0)
        self._state = initial_state(params, info.soc_initial)
        self._last: StepResult | None = None
        self._rows: list[tuple[float, ...]] = []

    @property
    def done(self) -> bool:
        """True after the last step."""
        return self.k >= self.info.steps

    @property
    def ready(self) -> bool:
        """The demand of the present tick is there, or none is needed any more."""
        return self.done or bool(np.isfinite(self.power_demand_w[self.k]))

    def take_demand(self, k: int, power_w: float) -> None:
        """Demand of step ``k``, 0..T-1, from a topic, without auxiliaries [W]; the first counts.

        One that comes after its tick was driven is what later ticks hold if theirs fail to come.
        """
        demand_w = power_w + self.params.p_aux_w
        if np.isnan(self.power_demand_w[k]):
            self.power_demand_w[k] = demand_w
        elif k in self._held:
            self._held.remove(k)
            self.demand_counters["demand_late"] += 1
            self._newest = max(self._newest, (k, demand_w))
        else:
            self.demand_counters["demand_repeated"] += 1

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
        if not self.held:
            self._newest = (self.k, float(demand_w[0]))
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
        self.held = not self.ready and not self.info.lockstep
        if self.held:
            self.power_demand_w[self.k] = self._newest[1]
            self._held.add(self.k)
            self.demand_counters["demand_held"] += 1
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
    cycle: str | DutyCycleInfo,
    soc_initial: float = UNSET_SOC,
    soc_target: float = UNSET_SOC,
    mode: Literal["lockstep", "real_time"] = "lockstep",
    expected_recorders: int = 0,
    command_line: str = "",
) -> PlantRun:
    """A run from names or files, with a run id of its own.

    Args:
        powertrain: name or YAML file.
        cycle: name or CSV file; or what a player announced, whose demand is still to come.
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
    duty = cycle if isinstance(cycle, DutyCycleInfo) else load_cycle(cycle)
    name = duty.cycle if isinstance(duty, DutyCycleInfo) else duty.name
    if abs(duty.dt_s - params.dt_s) > 1e-9:
        raise CycleError(
            f"cycle {name}: dt_s {duty.dt_s}, powertrain {params.name} needs {params.dt_s} "
            f"(ems cycle import --dt {params.dt_s:g} resamples)"
        )
    initial = params.soc_initial if soc_initial == UNSET_SOC else soc_initial
    target = params.soc_target if soc_target == UNSET_SOC else soc_target
    target = initial if target is None else target
    low, high = params.battery.soc_min, params.battery.soc_max
    for parameter, value in (("soc_initial", initial), ("soc_target", target)):
        if not low <= value <= high:
            raise ConfigError(
                f"parameter {parameter}: {value}, allowed {low}..{high} of powertrain "
                f"{params.name}, or {UNSET_SOC} for its default"
            )
    if isinstance(duty, DutyCycleInfo):
        demand_w, digest, t0_ns = np.full(duty.steps, np.nan), duty.cycle_hash, duty.t0_ns
    else:
        demand_w, digest = duty.power_demand_w + params.p_aux_w, cycle_hash(duty)
        t0_ns = DEFAULT_T0_NS
    info = RunInfo(
        run_id=uuid.uuid4().hex,
        cycle=name,
        cycle_hash=digest,
        powertrain=params.name,
        powertrain_hash=powertrain_hash(params),
        t0_ns=t0_ns,
        dt_s=params.dt_s,
        steps=len(demand_w),
        p_aux_w=params.p_aux_w,
        soc_initial=initial,
        soc_target=target,
        lockstep=mode == "lockstep",
        expected_recorders=expected_recorders,
        package_version=__version__,
        command_line=command_line,
    )
    return PlantRun(params, info, demand_w)
