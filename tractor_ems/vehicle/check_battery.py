"""Figures of a vehicle's battery, and findings: limits, losses, energy, and whether it bridges
the engine's ramp."""

import numpy as np

from tractor_ems.vehicle.curves import J_PER_KWH, battery_limits_w, round_trip_efficiency
from tractor_ems.vehicle.finding import Judge
from tractor_sim.battery import discharge_current_a, open_circuit_v
from tractor_sim.engine import fuel_rate_kg_per_s
from tractor_sim.generator import knots_w, to_bus_w, to_crank_w
from tractor_sim.powertrain import PowertrainParams

PASS_START = (0.13, 0.87, 0.29)
"""Measured field work: from the headland's 0.13 of rated power to the pass's 0.87, at up to 0.29
of rated power a second."""

LONGEST_BRIDGE_S, SHORTEST_STEP_S = 600.0, 0.1


def battery_figures(params: PowertrainParams) -> dict[str, float | None]:
    """Figures by name, SI but for those that say otherwise."""
    battery, soc = params.battery, params.soc_initial
    middle = np.array(soc)
    charge_w, discharge_w = (float(v) for v in battery_limits_w(battery, middle))
    current = float(discharge_current_a(battery, middle, np.array(discharge_w)))
    ocv_v = float(open_circuit_v(battery, middle))
    window = np.linspace(battery.soc_min, battery.soc_max, 201)
    voltage = open_circuit_v(battery, window)
    bridge_w, bridge_j = bridging(params)
    return {
        "battery_energy_kwh": battery.energy_j / J_PER_KWH,
        "battery_usable_kwh": float(voltage.mean())
        * battery.charge_c
        * (battery.soc_max - battery.soc_min)
        / J_PER_KWH,
        "battery_charge_ah": battery.charge_c / 3600.0,
        "battery_charge_limit_w": charge_w,
        "battery_discharge_limit_w": discharge_w,
        "battery_c_rate": max(charge_w, discharge_w) / battery.energy_j * 3600.0,
        "battery_ocv_v": ocv_v,
        "battery_mean_window_ocv_v": float(voltage.mean()),
        "battery_matched_load_w": (
            ocv_v**2 / (4.0 * battery.resistance_ohm) if battery.resistance_ohm > 0 else None
        ),
        "battery_loss_at_discharge_limit": battery.resistance_ohm * current / ocv_v,
        "battery_round_trip_at_half_power": float(
            round_trip_efficiency(battery, soc, np.array([discharge_w / 2.0]))[0]
        ),
        "bridging_power_w": bridge_w,
        "bridging_energy_kwh": bridge_j / J_PER_KWH,
    }


def bridging(params: PowertrainParams) -> tuple[float, float]:
    """Battery power [W] and energy [J] that a measured pass start asks for while the engine, off
    at first, follows the load as fast as its ramp allows; auxiliaries included."""
    engine, peak_w = params.engine, params.engine.power_max_w
    dt_s = max(params.dt_s, SHORTEST_STEP_S)
    rated_w = float(knots_w(params.generator, peak_w)[1][-1])
    low, high, rate = PASS_START
    missing_w, crank_w, elapsed_s = [], 0.0, 0.0
    while True:
        share = min(low + rate * elapsed_s, high)
        demand_w = min(rated_w * share + params.p_aux_w, rated_w)
        wanted_w = float(to_crank_w(params.generator, np.array(demand_w), peak_w))
        crank_w = min(wanted_w, crank_w + engine.ramp_w_per_s * dt_s)
        engine_w = float(to_bus_w(params.generator, np.array(crank_w), peak_w))
        missing_w.append(demand_w - engine_w)
        elapsed_s += dt_s
        done = share == high and crank_w == wanted_w
        if done or elapsed_s > LONGEST_BRIDGE_S:
            return max(missing_w), sum(missing_w) * dt_s


def judge_battery(
    judge: Judge, params: PowertrainParams, figures: dict[str, float | None]
) -> None:
    """Add the findings about the battery and what it has to bridge."""
    _judge_pack(judge, params, figures)
    _judge_losses(judge, params, figures)
    _judge_window(judge, params)
    _judge_bridging(judge, params, figures)


def _judge_pack(judge: Judge, params: PowertrainParams, figures: dict[str, float | None]) -> None:
    battery = params.battery
    judge.at_most(
        "warning",
        "battery: C-rate at the power limit",
        figures["battery_c_rate"],
        10.0,
        "a measured 75 Ah NMC cell already loses 11-14 % at 5 C (Kokam, 23 C, SOC 0.5)",
    )
    mean_v = figures["battery_mean_window_ocv_v"] or battery.voltage_v
    judge.between(
        "warning",
        "battery.voltage_v over mean OCV of the window",
        battery.voltage_v / mean_v,
        (0.95, 1.05),
        "energy_j / voltage_v is the charge that SOC counts: energy is off by this factor",
    )
    judge.between(
        "warning",
        "battery: OCV at soc_max over OCV at soc_min",
        float(
            open_circuit_v(battery, np.array(battery.soc_max))
            / open_circuit_v(battery, np.array(battery.soc_min))
        ),
        (1.0, 1.3),
        "from SOC 0.1 to 0.9 NMC 811 rises by 24 %, NMC 532 by 16 %, LFP by 11 %",
    )
    if not battery.ocv_v:
        judge.say("note", "battery.ocv_v", None, "at least 2 knots", "one voltage at every SOC")
    judge.say(
        "note",
        "battery: OCV per cell",
        None,
        "2.5..4.3 V",
        f"not checked, the file has no number of cells; {battery.voltage_v:g} V would be "
        f"{battery.voltage_v / 3.7:.0f} NMC or {battery.voltage_v / 3.3:.0f} LFP cells in series",
    )


def _judge_losses(
    judge: Judge, params: PowertrainParams, figures: dict[str, float | None]
) -> None:
    battery = params.battery
    matched_w = figures["battery_matched_load_w"]
    if matched_w is not None and battery.power_max_w > matched_w:
        judge.say(
            "error",
            "battery.power_max_w",
            battery.power_max_w,
            f"<= {matched_w:.4g}",
            "above OCV^2 / 4R at soc_initial: the resistance lets no such power through",
        )
    if battery.resistance_ohm == 0.0:
        judge.say(
            "warning",
            "battery.resistance_ohm",
            0.0,
            "> 0",
            "a lossless battery makes every detour of energy free: fuel comes out too low",
        )
    judge.at_most(
        "warning",
        "battery: loss at the discharge limit",
        figures["battery_loss_at_discharge_limit"],
        0.15,
        "R I / OCV at soc_initial; a measured 75 Ah NMC cell loses 14 % at 5 C (Kokam, 23 C)",
    )
    lost = figures["battery_round_trip_at_half_power"]
    if battery.resistance_ohm > 0.0:
        judge.between(
            "warning",
            "battery: round-trip efficiency at half power",
            lost,
            (0.85, 0.995),
            "a measured 75 Ah NMC cell: 0.957 at 1 C, 0.87 at 3 C (Kokam, 23 C)",
        )
    limits = (figures["battery_charge_limit_w"], figures["battery_discharge_limit_w"])
    for name, limit in zip(("charge", "discharge"), limits, strict=True):
        if limit is not None and limit < 0.999 * battery.power_max_w:
            judge.say(
                "note",
                f"battery.current_max_{name}_a",
                getattr(battery, f"current_max_{name}_a"),
                "",
                f"at soc_initial the limit is {limit / 1e3:.4g} kW, power_max_w is never reached",
            )


def _judge_window(judge: Judge, params: PowertrainParams) -> None:
    battery = params.battery
    judge.between(
        "warning",
        "battery.soc_max - battery.soc_min",
        battery.soc_max - battery.soc_min,
        (0.1, 0.9),
        "a narrow window leaves nothing to manage, a wide one ages the cells",
    )
    if battery.soc_min < 0.05 or battery.soc_max > 0.97:
        judge.say(
            "warning",
            "battery.soc_min, battery.soc_max",
            battery.soc_min if battery.soc_min < 0.05 else battery.soc_max,
            "0.05..0.97",
            "at the ends of SOC the cells' voltage limits bind before these do",
        )
    for name in ("soc_initial", "soc_target"):
        soc = getattr(params, name)
        if soc is not None and not battery.soc_min + 0.02 <= soc <= battery.soc_max - 0.02:
            judge.say(
                "warning",
                name,
                soc,
                f"{battery.soc_min + 0.02:g}..{battery.soc_max - 0.02:g}",
                "at the edge of the window the battery can only do one of charge and discharge",
            )


def _judge_bridging(
    judge: Judge, params: PowertrainParams, figures: dict[str, float | None]
) -> None:
    """Even a conventional policy needs the battery while the engine ramps up."""
    low, high, rate = PASS_START
    what = (
        f"pass start from {low:g} to {high:g} of rated power at {rate:g} a second (measured) with "
        "the engine off before: what the ramp leaves open, the battery must give, or work fails"
    )
    judge.at_most(
        "error",
        "bridging power [W] over the battery's limit",
        figures["bridging_power_w"],
        figures["battery_discharge_limit_w"] or 0.0,
        what,
    )
    battery = params.battery
    above = (params.soc_initial - battery.soc_min) * battery.energy_j / J_PER_KWH
    judge.at_most(
        "error",
        "bridging energy [kWh] over the energy above soc_min",
        figures["bridging_energy_kwh"],
        above,
        what,
    )
    best_w = best_bus_w(params)
    charge_w = figures["battery_charge_limit_w"] or 0.0
    if best_w - params.p_aux_w > charge_w:
        judge.say(
            "note",
            "battery: charge limit under the engine's best power",
            charge_w,
            f">= {best_w:.4g}",
            "at standstill the engine cannot run at its best point into the battery",
        )


def best_bus_w(params: PowertrainParams) -> float:
    """Bus power of the engine's best efficiency, generator included [W]."""
    peak_w = params.engine.power_max_w
    bus_w = np.linspace(0.0, float(knots_w(params.generator, peak_w)[1][-1]), 500)[1:]
    crank_w = to_crank_w(params.generator, bus_w, peak_w)
    return float(bus_w[int(np.argmin(fuel_rate_kg_per_s(params.engine, crank_w) / bus_w))])
