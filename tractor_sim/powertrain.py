"""The series hybrid: bus balance, feasible battery power and one step of the plant.

P_dem = P_batt + P_gen(P_eng), P_batt > 0 discharges. Pure numpy with a leading batch axis: the
node, the evaluation, the DP roll-out and the learner all go through :func:`step`. No limit is
ever broken: demand that cannot be met is ``shortfall_j``, braking energy that cannot be stored
is ``dissipated_j``.

Feasible battery power (the paper's lb and ub, with t_s the step and E = Q_batt V_oc):

    lb = max(-(SOC_max - SOC) E / t_s, -P_b,max, P_dem - P_e,max)
    ub = min( (SOC - SOC_min) E / t_s,  P_b,max, P_dem)

The paper prints the last term of lb as P_e,max - P_dem; from P_ice <= P_e,max it is the
negative of that. ``ub = P_dem`` makes "engine off" (P_ice = 0 exactly) reachable from any fixed
grid of actions: an action above ub is clipped to it.
"""

from dataclasses import dataclass

import numpy as np

from tractor_msgs_py.errors import ConfigError
from tractor_msgs_py.trajectory import BoolArray, FloatArray
from tractor_sim import battery as _battery
from tractor_sim import engine as _engine
from tractor_sim import generator as _generator
from tractor_sim.battery import BatteryParams
from tractor_sim.engine import EngineParams
from tractor_sim.generator import GeneratorParams

ROUNDING_W = 1e-6
"""A bus imbalance below this is rounding: neither shortfall nor a reason to start the engine."""

DT_MAX_S = 60.0
AUX_MAX_W = 1e9


@dataclass(frozen=True)
class PowertrainParams:
    """One vehicle.

    Attributes:
        name: short name, for instance ``paper``.
        engine, generator, battery: its components.
        p_aux_w: auxiliary power added to a cycle's demand, >= 0 [W].
        dt_s: step length, 0 < dt_s <= 60 [s].
        soc_initial: SOC a run starts at unless told otherwise.
        soc_target: SOC a run should end at; None: where it started.

    Raises ConfigError where a value is out of range.
    """

    name: str
    engine: EngineParams
    generator: GeneratorParams
    battery: BatteryParams
    p_aux_w: float
    dt_s: float
    soc_initial: float
    soc_target: float | None = None

    def __post_init__(self) -> None:
        if not 0.0 < self.dt_s <= DT_MAX_S:
            raise ConfigError(f"dt_s: {self.dt_s}, allowed 0 < dt_s <= {DT_MAX_S:g}")
        if not 0.0 <= self.p_aux_w <= AUX_MAX_W:
            raise ConfigError(f"p_aux_w: {self.p_aux_w}, allowed 0..{AUX_MAX_W:g}")
        window = (self.battery.soc_min, self.battery.soc_max)
        for name in ("soc_initial", "soc_target"):
            soc = getattr(self, name)
            if soc is not None and not window[0] <= soc <= window[1]:
                raise ConfigError(f"{name}: {soc}, allowed {window[0]}..{window[1]}")


@dataclass(frozen=True)
class PlantState:
    """State of B plants, every array of shape (B,).

    Attributes:
        soc: fraction.
        engine_on: engine running.
        time_in_state_s: how long it has been so [s].
        engine_power_w: power at the bus over the last step [W], 0 when off.
    """

    soc: FloatArray
    engine_on: BoolArray
    time_in_state_s: FloatArray
    engine_power_w: FloatArray


@dataclass(frozen=True)
class Command:
    """What B policies ask for, shape (B,).

    ``engine_power_w`` of exactly 0 asks for "engine off"; NaN is no opinion.
    """

    battery_power_w: FloatArray
    engine_power_w: FloatArray


@dataclass(frozen=True)
class PowerLimits:
    """Present limits at the bus, magnitudes of shape (B,) [W].

    Attributes:
        charge_w, discharge_w: what the battery can take and give over the coming step.
        engine_w: most the engine can give; engine_least_w: least it can give while on.
        may_be_off: whether the engine may be off in the coming step.
    """

    charge_w: FloatArray
    discharge_w: FloatArray
    engine_w: FloatArray
    engine_least_w: FloatArray
    may_be_off: BoolArray


@dataclass(frozen=True)
class StepResult:
    """What one step applied, shape (B,); powers at the bus [W], energies [J], fuel [kg].

    ``refused`` marks commands that were not finite and were replaced by the fallback law.
    """

    battery_power_w: FloatArray
    engine_power_w: FloatArray
    fuel_kg: FloatArray
    engine_started: BoolArray
    shortfall_j: FloatArray
    dissipated_j: FloatArray
    refused: BoolArray


def initial_state(params: PowertrainParams, soc: FloatArray | float, batch: int = 1) -> PlantState:
    """B plants at ``soc`` with the engine off for long enough to be started."""
    return PlantState(
        soc=np.broadcast_to(np.asarray(soc, dtype=np.float64), (batch,)).copy(),
        engine_on=np.zeros(batch, dtype=bool),
        time_in_state_s=np.full(batch, max(params.engine.min_off_s, params.engine.min_on_s)),
        engine_power_w=np.zeros(batch),
    )


def power_limits(params: PowertrainParams, state: PlantState) -> PowerLimits:
    """Limits of battery and engine over the coming step."""
    charge_w, discharge_w = _battery.power_limits_w(params.battery, state.soc, params.dt_s)
    peak_w = params.engine.power_max_w
    crank_w = _generator.to_crank_w(params.generator, state.engine_power_w, peak_w)
    least_w, most_w, may_be_off = _engine.power_range_w(
        params.engine, state.engine_on, state.time_in_state_s, crank_w, params.dt_s
    )
    return PowerLimits(
        charge_w,
        discharge_w,
        _generator.to_bus_w(params.generator, most_w, peak_w),
        _generator.to_bus_w(params.generator, least_w, peak_w),
        may_be_off,
    )


def feasible_battery_power_w(
    limits: PowerLimits, power_demand_w: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """lb and ub of the module docstring, shape (B,). lb > ub means that no choice is left."""
    lb = np.maximum(-limits.charge_w, power_demand_w - limits.engine_w)
    engine_floor_w = np.where(limits.may_be_off, 0.0, limits.engine_least_w)
    ub = np.minimum(limits.discharge_w, power_demand_w - engine_floor_w)
    return lb, ub


def project(battery_power_w: FloatArray, lb: FloatArray, ub: FloatArray) -> FloatArray:
    """Nearest feasible battery power; a value that is not finite becomes the fallback law's zero
    battery power, projected. Where lb > ub the result is lb."""
    wanted = np.where(np.isfinite(battery_power_w), battery_power_w, 0.0)
    return np.minimum(np.maximum(wanted, lb), np.maximum(lb, ub))


def step(
    params: PowertrainParams, state: PlantState, power_demand_w: FloatArray, command: Command
) -> tuple[PlantState, StepResult]:
    """Drive B plants for one step of ``params.dt_s``; any command is survived.

    Args:
        power_demand_w: finite demand at the bus, auxiliaries included, shape (B,).
        command: projected on the feasible set; "off" wins where off is allowed.
    """
    dt_s, peak_w = params.dt_s, params.engine.power_max_w
    limits = power_limits(params, state)
    lb, ub = feasible_battery_power_w(limits, power_demand_w)
    wanted_w = np.where(command.engine_power_w == 0.0, power_demand_w, command.battery_power_w)
    refused = ~np.isfinite(wanted_w)
    engine_wanted_w = power_demand_w - project(wanted_w, lb, ub)

    can_run = limits.engine_w > 0.0
    off = (limits.may_be_off & (engine_wanted_w <= ROUNDING_W)) | ~can_run
    engine_w = np.where(
        off, 0.0, np.minimum(np.maximum(engine_wanted_w, limits.engine_least_w), limits.engine_w)
    )
    battery_w = np.clip(power_demand_w - engine_w, -limits.charge_w, limits.discharge_w)
    imbalance_w = power_demand_w - engine_w - battery_w
    imbalance_w = np.where(np.abs(imbalance_w) <= ROUNDING_W, 0.0, imbalance_w)

    started = ~off & ~state.engine_on
    crank_w = _generator.to_crank_w(params.generator, engine_w, peak_w)
    fuel_kg = _engine.fuel_rate_kg_per_s(params.engine, crank_w, ~off) * dt_s
    fuel_kg = fuel_kg + np.where(started, params.engine.start_fuel_kg, 0.0)

    next_state = PlantState(
        soc=_battery.soc_after(params.battery, state.soc, battery_w, dt_s),
        engine_on=~off,
        time_in_state_s=np.where(state.engine_on == ~off, state.time_in_state_s + dt_s, dt_s),
        engine_power_w=engine_w,
    )
    return next_state, StepResult(
        battery_power_w=battery_w,
        engine_power_w=engine_w,
        fuel_kg=fuel_kg,
        engine_started=started,
        shortfall_j=np.maximum(imbalance_w, 0.0) * dt_s,
        dissipated_j=np.maximum(-imbalance_w, 0.0) * dt_s,
        refused=refused,
    )


def battery_power_grid_w(params: PowertrainParams, actions: int = 1600) -> FloatArray:
    """The paper's action grid: ``actions`` battery powers evenly over -P_b,max..P_b,max [W].

    Projection on [lb, ub] maps every action above ub onto it, so "engine off" is always among
    them.
    """
    return np.linspace(-params.battery.power_max_w, params.battery.power_max_w, actions)
