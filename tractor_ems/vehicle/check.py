"""Is a vehicle's file plausible: figures of its curves, and findings where one is out of range.

A finding says what a maker should look at again; it forbids nothing. What is physically
impossible has already been refused by ``load_powertrain``.
"""

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from tractor_ems.vehicle.check_battery import battery_figures, judge_battery
from tractor_ems.vehicle.curves import (
    FuelCurves,
    Vehicle,
    bsfc_g_per_kwh,
    efficiency_of,
    fuel_curves,
    load_vehicle,
)
from tractor_ems.vehicle.finding import Finding, Judge, Severity
from tractor_sim.fuel import DENSITY_KG_PER_L
from tractor_sim.generator import knots_w


@dataclass(frozen=True)
class Hull:
    """How far the driven fuel curve lies below the data.

    Attributes:
        largest, at_crank_w, at_bus_w: largest departure as a fraction of the data, and where.
        largest_kg_per_s: largest departure in fuel.
        beyond_1_percent_bus_w: bus power range in which it is more than 1 %; None: nowhere.
        mean_light, mean_heavy: mean departure below and above a third of rated power.
        driven: False where the file gives an efficiency curve, which is driven as it is.
    """

    largest: float
    at_crank_w: float
    at_bus_w: float
    largest_kg_per_s: float
    beyond_1_percent_bus_w: tuple[float, float] | None
    mean_light: float
    mean_heavy: float
    driven: bool


@dataclass(frozen=True)
class VehicleCheck:
    """What ``ems vehicle check`` reports: figures by name, the hull, findings, worst first."""

    powertrain: str
    figures: dict[str, float | None]
    hull: Hull
    findings: tuple[Finding, ...]

    def to_json(self) -> dict[str, Any]:
        """Plain data without infinities."""
        return asdict(self)


def check(name_or_path: str) -> tuple[VehicleCheck, Vehicle]:
    """Judge a vehicle by name or file.

    Raises:
        ConfigError: it cannot be read, or a value is impossible.
    """
    vehicle = load_vehicle(name_or_path)
    curves = fuel_curves(vehicle)
    hull = hull_departure(vehicle, curves)
    figures = {**_engine_figures(vehicle, curves), **battery_figures(vehicle.params)}
    judge = Judge()
    _judge_engine(judge, vehicle, figures)
    _judge_hull(judge, vehicle, hull)
    _judge_generator(judge, vehicle)
    judge_battery(judge, vehicle.params, figures)
    return VehicleCheck(vehicle.params.name, figures, hull, judge.worst_first()), vehicle


def hull_departure(vehicle: Vehicle, curves: FuelCurves) -> Hull:
    """The hull's distance from the data, in words of :class:`Hull`."""
    part = curves.departure
    worst = int(np.argmax(part))
    beyond = np.flatnonzero(part > 0.01)
    light = curves.crank_w < vehicle.params.engine.power_max_w / 3.0

    def mean(where: Any) -> float:
        x, y = curves.crank_w[where], part[where]
        return float(np.sum((y[1:] + y[:-1]) / 2.0 * np.diff(x)) / (x[-1] - x[0]))

    return Hull(
        largest=float(part[worst]),
        at_crank_w=float(curves.crank_w[worst]),
        at_bus_w=float(curves.bus_w[worst]),
        largest_kg_per_s=float(np.max(curves.data_kg_per_s - curves.hull_kg_per_s)),
        beyond_1_percent_bus_w=(
            (float(curves.bus_w[beyond[0]]), float(curves.bus_w[beyond[-1]]))
            if len(beyond)
            else None
        ),
        mean_light=mean(light),
        mean_heavy=mean(~light),
        driven=not vehicle.from_efficiency,
    )


def _engine_figures(vehicle: Vehicle, curves: FuelCurves) -> dict[str, float | None]:
    engine = vehicle.params.engine
    eta = efficiency_of(curves.crank_w, curves.data_kg_per_s, engine.fuel_lhv_j_per_kg)
    best = int(np.argmax(eta))
    _, bus_w = knots_w(vehicle.params.generator, engine.power_max_w)
    idle = float(curves.data_kg_per_s[0])
    full_s = engine.power_max_w / engine.ramp_w_per_s
    return {
        "engine_power_max_w": engine.power_max_w,
        "engine_bus_power_max_w": float(bus_w[-1]),
        "engine_peak_efficiency": float(eta[best]),
        "engine_best_power_w": float(curves.crank_w[best]),
        "engine_least_bsfc_g_per_kwh": float(
            np.min(bsfc_g_per_kwh(curves.crank_w, curves.data_kg_per_s)[1:])
        ),
        "engine_efficiency_at_full_power": float(eta[-1]),
        "engine_idle_l_per_h": idle * 3600.0 / DENSITY_KG_PER_L,
        "engine_idle_share_of_full": idle / float(curves.data_kg_per_s[-1]),
        "engine_seconds_to_full_power": full_s if np.isfinite(engine.ramp_w_per_s) else None,
        "generator_peak_efficiency": max(vehicle.params.generator.curve_efficiency),
    }


def _judge_engine(judge: Judge, vehicle: Vehicle, figures: dict[str, float | None]) -> None:
    engine, params = vehicle.params.engine, vehicle.params
    judge.between(
        "warning",
        "engine: peak efficiency",
        figures["engine_peak_efficiency"],
        (0.30, 0.48),
        "published maps of 200-330 kW diesels reach 0.39 (FASTSim, class 8), 0.415 (Cat 3126E), "
        "0.42 (FASTSim, heavy duty), 0.445 (Detroit Diesel Series 60)",
    )
    judge.between(
        "warning",
        "engine: least BSFC [g/kWh]",
        figures["engine_least_bsfc_g_per_kwh"],
        (175.0, 280.0),
        "the same in makers' units; tractor tests give 225-237 at the PTO and rated speed "
        "(John Deere 9.0 L), the Series 60 map 190 at its best point",
    )
    judge.between(
        "warning",
        "engine.fuel_lhv_j_per_kg",
        engine.fuel_lhv_j_per_kg,
        (41e6, 44.5e6),
        "diesel 42.5-43 MJ/kg; an upper heating value is about 45.5",
    )
    best_w = figures["engine_best_power_w"] or 0.0
    judge.between(
        "warning",
        "engine: power of best efficiency over rated",
        best_w / engine.power_max_w,
        (0.3, 0.95),
        "the measured maps have it at 0.78-0.87 (Series 60, Cat 3126E)",
    )
    judge.between(
        "warning",
        "engine: idle fuel over fuel at rated power",
        figures["engine_idle_share_of_full"],
        (0.01, 0.08),
        "the Series 60 map extends to 1.7 % at low idle and 7 % held at 1800 rpm; where idling "
        "is free no policy has a reason to stop",
    )
    judge.between(
        "warning",
        "engine: seconds to full power",
        figures["engine_seconds_to_full_power"],
        (1.0, 10.0),
        "by engine.ramp_w_per_s; measured pass starts load a tractor by 0.23-0.29 of rated power "
        "a second, which is 3.4-4.3 s",
        absent="no ramp limit: the engine takes any load within one step",
    )
    judge.at_most(
        "warning",
        "engine.start_fuel_kg",
        engine.start_fuel_kg,
        0.1,
        "studies use 0-60 g",
    )
    if engine.start_fuel_kg == 0.0 and engine.min_on_s == 0.0 and engine.min_off_s == 0.0:
        judge.say(
            "warning",
            "engine.start_fuel_kg",
            0.0,
            "> 0, or minimum times > 0",
            "starts are free: a policy may start the engine hundreds of times an hour",
        )
    for name in ("min_on_s", "min_off_s"):
        judge.at_most(
            "warning",
            f"engine.{name}",
            getattr(engine, name),
            60.0,
            "the shipped vehicles have 5 s; a longer one outlasts a headland turn (31-40 s)",
        )
    judge.at_most(
        "warning",
        "p_aux_w over rated engine power",
        params.p_aux_w / engine.power_max_w,
        0.10,
        "the shipped vehicles have 1.5-3 % (assumed)",
    )
    if params.p_aux_w == 0.0:
        judge.say("note", "p_aux_w", 0.0, "> 0", "auxiliaries are in the cycle, or forgotten")


def _judge_hull(judge: Judge, vehicle: Vehicle, hull: Hull) -> None:
    where = f"at {hull.at_bus_w / 1e3:.1f} kW at the bus"
    if not hull.driven:
        if hull.largest > 1e-6:
            judge.at_most(
                "warning",
                "engine: fuel above its convex hull",
                hull.largest,
                0.0,
                f"{where}; fuel over bus power is not convex and is driven as it is, so an "
                "optimum may jump between two powers each second",
            )
        return
    text = f"{where}; the hull is what is driven: fuel there is understated by as much"
    severity: Severity = "error" if hull.largest > 0.20 else "warning"
    judge.at_most(severity, "engine: hull below the data", hull.largest, 0.02, text)


def _judge_generator(judge: Judge, vehicle: Vehicle) -> None:
    generator = vehicle.params.generator
    if generator.ideal:
        judge.say(
            "warning",
            "generator.curve_efficiency",
            1.0,
            "0.85..0.98",
            "no losses between crankshaft and bus; right only if the fuel curve is over bus power",
        )
        return
    judge.between(
        "warning",
        "generator: peak efficiency",
        max(generator.curve_efficiency),
        (0.85, 0.98),
        "with rectifier: 0.88 (Sachs 63 kW, 230 V, measured), 0.94 (large machine, FASTSim)",
    )
    judge.at_most(
        "warning",
        "generator: efficiency at least load",
        generator.curve_efficiency[0],
        0.95,
        "excitation and rectifier losses remain without load",
    )
