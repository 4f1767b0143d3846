"""Battery: how much power it can give and take, and what that does to its SOC.

The paper's battery is lossless: SOC' = SOC - P dt / E with E = Q_batt V_oc. Every function
takes and returns shape (B,).
"""

from dataclasses import dataclass

import numpy as np

from tractor_msgs_py.errors import ConfigError
from tractor_msgs_py.trajectory import FloatArray


@dataclass(frozen=True)
class BatteryParams:
    """A lossless battery of constant voltage.

    Attributes:
        energy_j: E = Q_batt V_oc, energy from SOC 0 to 1 [J].
        voltage_v: open-circuit voltage [V].
        power_max_w: largest charge and discharge power [W].
        soc_min, soc_max: operating window, 0 <= soc_min < soc_max <= 1.
    """

    energy_j: float
    voltage_v: float
    power_max_w: float
    soc_min: float
    soc_max: float

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


def power_limits_w(
    params: BatteryParams, soc: FloatArray, dt_s: float
) -> tuple[FloatArray, FloatArray]:
    """Largest charge and discharge power over one step, magnitudes >= 0 [W]."""
    charge = np.minimum((params.soc_max - soc) * params.energy_j / dt_s, params.power_max_w)
    discharge = np.minimum((soc - params.soc_min) * params.energy_j / dt_s, params.power_max_w)
    return np.maximum(charge, 0.0), np.maximum(discharge, 0.0)


def soc_after(
    params: BatteryParams, soc: FloatArray, power_w: FloatArray, dt_s: float
) -> FloatArray:
    """SOC after ``power_w`` (> 0 discharges) for one step.

    Rounding is not allowed to carry a SOC out of the window it was in.
    """
    after = soc - power_w * dt_s / params.energy_j
    return np.clip(after, np.minimum(params.soc_min, soc), np.maximum(params.soc_max, soc))


def current_a(params: BatteryParams, power_w: FloatArray) -> FloatArray:
    """Battery current [A], negative when discharging (the convention of BatteryState)."""
    return -power_w / params.voltage_v
