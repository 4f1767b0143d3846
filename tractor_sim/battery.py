"""Battery: how much power it can give and take, and what that does to its SOC.

Terminal power is P = (OCV(SOC) - R I) I with I > 0 discharging, and SOC counts the current:
SOC' = SOC - I dt / Q. Constant voltage and R = 0 make the paper's lossless battery,
SOC' = SOC - P dt / E with E = Q_batt V_oc. Every function takes and returns arrays of one shape.
"""

import math
from dataclasses import dataclass

import numpy as np

from tractor_msgs_py.errors import ConfigError
from tractor_msgs_py.trajectory import FloatArray
from tractor_sim.knots import check_entries, check_rising


@dataclass(frozen=True)
class BatteryParams:
    """A battery of open-circuit voltage and resistance; lossless unless told otherwise.

    Attributes:
        energy_j: E = Q_batt V_oc at the nominal voltage, from SOC 0 to 1 [J].
        voltage_v: nominal open-circuit voltage [V]; the charge is energy_j / voltage_v.
        power_max_w: largest charge and discharge power at the terminals [W].
        soc_min, soc_max: operating window, 0 <= soc_min < soc_max <= 1.
        ocv_soc, ocv_v: knots of the open-circuit voltage over SOC, SOC increasing and covering
            the window, voltage > 0 and never falling; empty: ``voltage_v`` at every SOC.
        resistance_ohm: of the pack, >= 0 [ohm].
        current_max_charge_a, current_max_discharge_a: magnitudes, inf for none [A].
    """

    energy_j: float
    voltage_v: float
    power_max_w: float
    soc_min: float
    soc_max: float
    ocv_soc: tuple[float, ...] = ()
    ocv_v: tuple[float, ...] = ()
    resistance_ohm: float = 0.0
    current_max_charge_a: float = float("inf")
    current_max_discharge_a: float = float("inf")

    def __post_init__(self) -> None:
        for name in ("energy_j", "voltage_v", "power_max_w"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0):
                raise ConfigError(f"battery.{name}: {value}, allowed > 0")
        if not 0.0 <= self.soc_min < self.soc_max <= 1.0:
            raise ConfigError(
                f"battery.soc_min, soc_max: {self.soc_min}, {self.soc_max}, "
                "allowed 0 <= soc_min < soc_max <= 1"
            )
        if not (np.isfinite(self.resistance_ohm) and self.resistance_ohm >= 0):
            raise ConfigError(
                f"battery.resistance_ohm: {self.resistance_ohm}, allowed finite and >= 0"
            )
        for name in ("current_max_charge_a", "current_max_discharge_a"):
            value = getattr(self, name)
            if not value > 0:
                raise ConfigError(f"battery.{name}: {value}, allowed > 0")
        self._check_ocv()

    def _check_ocv(self) -> None:
        soc, volts = np.array(self.ocv_soc), np.array(self.ocv_v)
        if len(soc) != len(volts) or len(soc) == 1:
            raise ConfigError(
                f"battery.ocv_soc, ocv_v: {len(soc)} SOC, {len(volts)} voltages, allowed none or "
                "at least 2 of each in equal number"
            )
        if not len(soc):
            return
        check_rising("battery.ocv_soc", soc)
        if soc[0] > self.soc_min or soc[-1] < self.soc_max:
            raise ConfigError(
                f"battery.ocv_soc: {soc[0]}..{soc[-1]}, allowed what covers the window soc_min.."
                f"soc_max, {self.soc_min}..{self.soc_max}"
            )
        good = np.isfinite(volts) & (volts > 0)
        check_entries("battery.ocv_v", volts, good, "finite and > 0")
        check_rising("battery.ocv_v", volts, level=True)

    @property
    def charge_c(self) -> float:
        """Charge from SOC 0 to 1 [C]."""
        return self.energy_j / self.voltage_v

    @property
    def lossless(self) -> bool:
        """Constant voltage, no resistance, no current limit: the paper's battery."""
        limit_a = min(self.current_max_charge_a, self.current_max_discharge_a)
        return not self.ocv_soc and self.resistance_ohm == 0.0 and math.isinf(limit_a)


def open_circuit_v(params: BatteryParams, soc: FloatArray) -> FloatArray:
    """Open-circuit voltage [V]; beyond the outermost knots it stays what it is there."""
    if not params.ocv_soc:
        return np.full(np.shape(soc), params.voltage_v)
    return np.interp(soc, params.ocv_soc, params.ocv_v)


def power_limits_w(
    params: BatteryParams, soc: FloatArray, dt_s: float
) -> tuple[FloatArray, FloatArray]:
    """Largest charge and discharge power over one step, magnitudes >= 0 [W].

    The least of the power limit, the current limit, what takes the SOC to the end of its window
    in one step and, discharging, the most that the resistance lets through, OCV^2 / 4R.
    """
    if params.lossless:
        charge = np.minimum((params.soc_max - soc) * params.energy_j / dt_s, params.power_max_w)
        discharge = np.minimum((soc - params.soc_min) * params.energy_j / dt_s, params.power_max_w)
        return np.maximum(charge, 0.0), np.maximum(discharge, 0.0)
    ocv_v, ohm, per_s = open_circuit_v(params, soc), params.resistance_ohm, params.charge_c / dt_s
    in_a = np.clip((params.soc_max - soc) * per_s, 0.0, params.current_max_charge_a)
    out_a = np.clip((soc - params.soc_min) * per_s, 0.0, params.current_max_discharge_a)
    if ohm > 0.0:
        out_a = np.minimum(out_a, ocv_v / (2.0 * ohm))
    charge_w = np.minimum((ocv_v + ohm * in_a) * in_a, params.power_max_w)
    discharge_w = np.minimum((ocv_v - ohm * out_a) * out_a, params.power_max_w)
    return charge_w, discharge_w


def discharge_current_a(params: BatteryParams, soc: FloatArray, power_w: FloatArray) -> FloatArray:
    """Current of a terminal power, > 0 discharging [A].

    The smaller root of P = (OCV - R I) I, in the form that does not cancel; power above
    OCV^2 / 4R, which no current gives, counts as that.
    """
    ocv_v, ohm = open_circuit_v(params, soc), params.resistance_ohm
    if ohm > 0.0:
        power_w = np.minimum(power_w, ocv_v**2 / (4.0 * ohm))
    root_v = np.sqrt(np.maximum(ocv_v**2 - 4.0 * ohm * power_w, 0.0))
    current: FloatArray = 2.0 * power_w / (ocv_v + root_v)
    return current


def soc_after(
    params: BatteryParams, soc: FloatArray, power_w: FloatArray, dt_s: float
) -> FloatArray:
    """SOC after ``power_w`` (> 0 discharges) for one step.

    Rounding is not allowed to carry a SOC out of the window it was in.
    """
    if params.lossless:
        after = soc - power_w * dt_s / params.energy_j
    else:
        after = soc - discharge_current_a(params, soc, power_w) * dt_s / params.charge_c
    return np.clip(after, np.minimum(params.soc_min, soc), np.maximum(params.soc_max, soc))


def terminal_v(params: BatteryParams, soc: FloatArray, power_w: FloatArray) -> FloatArray:
    """Voltage at the terminals under ``power_w`` [V]."""
    if params.lossless:
        return np.full(np.shape(soc), params.voltage_v)
    drop_v = params.resistance_ohm * discharge_current_a(params, soc, power_w)
    return open_circuit_v(params, soc) - drop_v


def current_a(params: BatteryParams, soc: FloatArray, power_w: FloatArray) -> FloatArray:
    """Battery current [A], negative when discharging (the convention of BatteryState)."""
    if params.lossless:
        return -power_w / params.voltage_v
    return -discharge_current_a(params, soc, power_w)
