"""Brixius traction: how much axle power a pull costs on soil, slip included."""

from dataclasses import dataclass

import numpy as np

from tractor_msgs_py.trajectory import FloatArray

_SLIP_LIMIT = 0.30
_SLIP_POINTS = 601


def gross_traction_ratio(slip: FloatArray, wheel_numeric: float) -> FloatArray:
    """GTR = 0.88 (1 - e^(-0.1 Bn)) (1 - e^(-7.5 s)) + 0.04 (Brixius 1987), any shape [-].

    Slip below zero (braking wheels) mirrors the curve about 0.04: assumed, the equation is for
    driven wheels only.
    """
    bite = 1.0 - np.exp(-7.5 * np.abs(slip))
    ratio: FloatArray = 0.88 * (1.0 - np.exp(-0.1 * wheel_numeric)) * np.sign(slip) * bite + 0.04
    return ratio


def motion_resistance_ratio(slip: FloatArray, wheel_numeric: float) -> FloatArray:
    """MRR = 1/Bn + 0.04 + 0.5 s / sqrt(Bn) (Brixius 1987), any shape [-]."""
    ratio: FloatArray = 1.0 / wheel_numeric + 0.04 + 0.5 * np.abs(slip) / np.sqrt(wheel_numeric)
    return ratio


def tractive_efficiency(slip: FloatArray, wheel_numeric: float) -> FloatArray:
    """TE = (1 - s) (GTR - MRR) / GTR for 0 < s < 1, any shape [-]."""
    gross = gross_traction_ratio(slip, wheel_numeric)
    net = gross - motion_resistance_ratio(slip, wheel_numeric)
    efficiency: FloatArray = (1.0 - slip) * net / gross
    return efficiency


@dataclass(frozen=True)
class Wheels:
    """The curve of one tractor on one soil, tabulated over slip from -0.30 to 0.30.

    All wheels are driven and share the weight; weight transfer is left out.

    Attributes:
        net_ratio: pull over weight, increasing, shape (K,).
        effort_ratio: axle power over (weight x ground speed), shape (K,).
        slip: shape (K,).
        weight_n: on the driven wheels [N].
    """

    net_ratio: FloatArray
    effort_ratio: FloatArray
    slip: FloatArray
    weight_n: float

    def slip_of(self, pull_n: FloatArray) -> FloatArray:
        """Slip that gives a pull, held within the table, any shape [-]."""
        slip: FloatArray = np.interp(pull_n / self.weight_n, self.net_ratio, self.slip)
        return slip

    def axle_power_w(self, pull_n: FloatArray, speed_m_per_s: FloatArray) -> FloatArray:
        """GTR W v / (1 - s), that is pull x speed / TE; below zero when the wheels brake [W]."""
        effort = np.interp(pull_n / self.weight_n, self.net_ratio, self.effort_ratio)
        power: FloatArray = effort * self.weight_n * speed_m_per_s
        return power

    def pull_limit_n(self, slip_max: float) -> float:
        """The pull at a slip [N]."""
        return float(np.interp(slip_max, self.slip, self.net_ratio)) * self.weight_n


def wheels(weight_n: float, wheel_numeric: float) -> Wheels:
    """Table of ``Wheels`` for a weight and a wheel numeric Bn (20 soft ... 80 firm)."""
    slip = np.linspace(-_SLIP_LIMIT, _SLIP_LIMIT, _SLIP_POINTS)
    gross = gross_traction_ratio(slip, wheel_numeric)
    net = gross - motion_resistance_ratio(slip, wheel_numeric)
    return Wheels(net, gross / (1.0 - slip), slip, weight_n)
