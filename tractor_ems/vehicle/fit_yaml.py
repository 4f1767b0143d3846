"""A fit as a powertrain file that ``load_powertrain`` accepts, every value with its origin.

What the recording did not identify comes from the powertrain that was named, and the file says
so; without one a fit that lacks something is refused rather than filled in.
"""

import re
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from tractor_ems.vehicle.fit import DIESEL_LHV_J_PER_KG, VehicleFit
from tractor_msgs_py.atomic import write_bytes
from tractor_msgs_py.errors import ConfigError
from tractor_msgs_py.trajectory import FloatArray
from tractor_sim.battery import BatteryParams, open_circuit_v
from tractor_sim.config import load_powertrain
from tractor_sim.generator import GeneratorParams, knots_w, to_bus_w, to_crank_w
from tractor_sim.powertrain import PowertrainParams
from tractor_sim.powertrain_json import params_to_json

Origins = dict[str, str]


def check_out(out: Path, force: bool) -> None:
    """Refuse a file that exists, before minutes go into the fit that would replace it.

    Raises:
        ConfigError: ``out`` is a folder, or exists and ``force`` is not set.
    """
    if out.is_dir():
        raise ConfigError(f"{out}: is a folder, give the powertrain file to write")
    if out.exists() and not force:
        raise ConfigError(f"{out}: exists already (--force replaces it)")


def write_fit(found: VehicleFit, out: Path) -> Origins:
    """Write the powertrain file; returns where each part of it comes from.

    Raises:
        ConfigError: something is missing and no powertrain was named, the named one does not fit
            the recording, the result is impossible, or ``out`` cannot be written.
    """
    missing = missing_parts(found)
    if missing and found.base is None:
        raise ConfigError(
            f"{found.bag}: does not identify {', '.join(missing)}; name a powertrain to take "
            "that from with --powertrain"
        )
    document, origins = powertrain_document(found)
    lines = [f"# Fitted to {Path(found.bag).name}: {len(found.recorded)} steps."]
    lines += [f"# {name}: {origin}" for name, origin in origins.items()]
    body = yaml.safe_dump(document, sort_keys=False, default_flow_style=None, width=95)
    data = ("\n".join(lines) + "\n" + body).encode()
    with tempfile.TemporaryDirectory() as folder:
        trial = Path(folder, "fitted.yaml")
        trial.write_bytes(data)
        try:
            load_powertrain(trial)
        except ConfigError as error:
            reason = str(error).partition("fitted.yaml: ")[2]
            raise ConfigError(f"{found.bag}: the fit is no possible vehicle: {reason}") from None
    write_bytes(out, data)
    return origins


def missing_parts(found: VehicleFit) -> list[str]:
    """What a powertrain file needs and the recording does not identify."""
    missing = [] if found.fuel.identified else ["engine: fuel curve"]
    missing += [
        item.name
        for item in found.fuel.estimates
        if item.name == "engine.start_fuel_kg" and item.verdict != "identified"
    ]
    battery = found.battery
    missing += [] if battery.charge_c is not None else ["battery: charge"]
    missing += [] if len(battery.ocv_v) else ["battery.ocv_v", "battery.resistance_ohm"]
    return missing


def powertrain_document(found: VehicleFit) -> tuple[dict[str, Any], Origins]:
    """The powertrain as its file's document, and the origin of each part."""
    base, info = found.base, found.recorded.info
    origins: Origins = {}
    battery = _battery(found, origins)
    window = battery["soc_min"], battery["soc_max"]
    engine, generator = _engine(found, origins)
    origins["p_aux_w, dt_s, soc_initial, soc_target"] = "announced in the recording"
    document = {
        "name": "fitted_" + re.sub(r"[^A-Za-z0-9_.-]+", "_", info.powertrain),
        "dt_s": info.dt_s,
        "p_aux_w": info.p_aux_w,
        "soc_initial": float(np.clip(info.soc_initial, *window)),
        "soc_target": float(np.clip(info.soc_target, *window)),
        "engine": engine,
        "generator": generator,
        "battery": battery,
    }
    if base is not None:
        origins["generator, heating value"] = f"powertrain {base.name}"
    return document, origins


def _engine(found: VehicleFit, origins: Origins) -> tuple[dict[str, Any], dict[str, Any]]:
    base, fuel, recorded = found.base, found.fuel, found.recorded
    if base is None:
        generator = GeneratorParams()
        peak_w = float(recorded.engine_limit_w.max())
        engine: dict[str, Any] = {
            "power_max_w": peak_w,
            "fuel_lhv_j_per_kg": DIESEL_LHV_J_PER_KG,
        }
        origins["engine.power_max_w"] = "largest limit published; power at the bus"
        origins["engine.fuel_lhv_j_per_kg"] = "assumed"
        origins["generator"] = "none: its losses are inside the fuel curve"
        origins["engine.min_on_s, min_off_s, ramp_w_per_s"] = "none assumed, see the bounds"
    else:
        generator, peak_w = base.generator, base.engine.power_max_w
        engine = _engine_of(base)
        origins["engine: what is not named here"] = f"powertrain {base.name}"
    bus_max_w = float(to_bus_w(generator, np.array(peak_w), peak_w))
    reached_w = float(recorded.engine_w.max())
    if reached_w > bus_max_w * (1.0 + 1e-6):
        raise ConfigError(
            f"{found.bag}: the engine gave {reached_w:.6g} W at the bus, powertrain "
            f"{'' if base is None else base.name} allows {bus_max_w:.6g}"
        )
    if fuel.identified:
        for name in ("curve_power_w", "curve_efficiency", "curve_fuel_kg_per_s"):
            engine.pop(name, None)
        bus_w = np.concatenate(([0.0], fuel.bus_w[fuel.bus_w < bus_max_w], [bus_max_w]))
        crank_w = np.concatenate(
            (to_crank_w(generator, bus_w, peak_w), knots_w(generator, peak_w)[0])
        )
        crank_w = np.unique(np.round(crank_w, 1))
        crank_w[-1] = peak_w
        rate = np.maximum(fuel.fuel_at(to_bus_w(generator, crank_w, peak_w)), 0.0)
        engine["idle_fuel_kg_per_s"] = float(rate[0])
        engine["curve"] = "fitted"
        engine["curves"] = {"fitted": _pairs(crank_w, rate)}
        origins["engine.curves"] = (
            f"fitted over {fuel.bus_w[0] / 1e3:.1f}..{fuel.bus_w[-1] / 1e3:.1f} kW at the bus, "
            f"residual {fuel.rms_kg_per_s * 1e3:.3g} g/s; straight lines beyond"
        )
    start = next(e for e in fuel.estimates if e.name == "engine.start_fuel_kg")
    if start.verdict == "identified" and start.value is not None and start.error is not None:
        engine["start_fuel_kg"] = start.value
        origins["engine.start_fuel_kg"] = f"fitted, +- {start.error:.2g} kg"
    return engine, {
        "load_fraction": list(generator.load_fraction),
        "curve_efficiency": list(generator.curve_efficiency),
    }


def _engine_of(base: PowertrainParams) -> dict[str, Any]:
    """The named powertrain's engine in the terms of a file."""
    engine: dict[str, Any] = params_to_json(base)["engine"]
    engine = {key: list(v) if isinstance(v, tuple) else v for key, v in engine.items()}
    rates = engine.pop("curve_fuel_kg_per_s", None)
    if rates:
        power = engine.pop("curve_power_w")
        engine.pop("curve_efficiency")
        engine["curve"] = "named"
        engine["curves"] = {"named": {"power_w": power, "fuel_kg_per_s": rates}}
    return engine


def _battery(found: VehicleFit, origins: Origins) -> dict[str, Any]:
    base, fitted, recorded = found.base, found.battery, found.recorded
    if base is None:
        battery: dict[str, Any] = {
            "power_max_w": float(
                max(recorded.charge_limit_w.max(), recorded.discharge_limit_w.max())
            ),
            "soc_min": float(min(recorded.soc.min(), recorded.soc_before.min())),
            "soc_max": float(max(recorded.soc.max(), recorded.soc_before.max())),
        }
        origins["battery.power_max_w"] = "largest limit published"
        origins["battery.soc_min, soc_max"] = "visited; the true window is at least that"
    else:
        battery = {
            key: list(value) if isinstance(value, tuple) else value
            for key, value in params_to_json(base)["battery"].items()
        }
        origins["battery: what is not named here"] = f"powertrain {base.name}"
    if len(fitted.ocv_v):
        soc, volts = _over_window(
            fitted.ocv_soc,
            fitted.ocv_v,
            (battery["soc_min"], battery["soc_max"]),
            None if base is None else base.battery,
        )
        nominal_v = float(np.mean(fitted.ocv_v))
        battery["ocv_soc"], battery["ocv_v"] = soc.tolist(), volts.tolist()
        battery["resistance_ohm"] = fitted.resistance_ohm
        if fitted.charge_c is None and base is not None:  # the same charge at another voltage
            battery["energy_j"] = base.battery.charge_c * nominal_v
        battery["voltage_v"] = nominal_v
        origins["battery.ocv_v, resistance_ohm"] = (
            f"fitted over SOC {fitted.ocv_soc[0]:.4f}..{fitted.ocv_soc[-1]:.4f}, residual "
            f"{fitted.rms_v:.2g} V; beyond that "
            + ("a straight line" if base is None else f"as powertrain {base.name} goes on")
        )
    if fitted.charge_c is not None:
        battery["energy_j"] = fitted.charge_c * battery["voltage_v"]
        origins["battery.energy_j"] = (
            f"fitted: {fitted.charge_c / 3600.0:.4g} Ah at {battery['voltage_v']:.5g} V"
        )
    return battery


def _over_window(
    soc: FloatArray,
    volts: FloatArray,
    window: tuple[float, float],
    base: BatteryParams | None,
) -> tuple[FloatArray, FloatArray]:
    """Fitted OCV carried on to the window's ends."""
    slope = (volts[-1] - volts[0]) / (soc[-1] - soc[0]) if len(soc) > 1 else 0.0

    def beyond(at: FloatArray, edge: int) -> FloatArray:
        if base is None or not base.ocv_v:
            line: FloatArray = volts[edge] + slope * (at - soc[edge])
            return line
        shift = volts[edge] - open_circuit_v(base, soc[edge])
        return np.asarray(open_circuit_v(base, at) + shift, dtype=np.float64)

    named = np.array([] if base is None else base.ocv_soc, dtype=np.float64)
    ends = np.array(window)
    candidates = np.unique(np.concatenate((named, ends)))
    low = candidates[(candidates >= ends[0]) & (candidates < soc[0] - 1e-6)]
    high = candidates[(candidates <= ends[1]) & (candidates > soc[-1] + 1e-6)]
    whole = np.concatenate((low, soc, high))
    values = np.concatenate((beyond(low, 0), volts, beyond(high, -1)))
    whole[0], whole[-1] = min(whole[0], ends[0]), max(whole[-1], ends[1])
    return np.clip(whole, 0.0, 1.0), np.maximum.accumulate(values)


def _pairs(power_w: FloatArray, rate: FloatArray) -> dict[str, list[float]]:
    return {"power_w": power_w.tolist(), "fuel_kg_per_s": [float(f"{r:.8e}") for r in rate]}
