"""From axle, PTO and hydraulic power to electric power at the bus, and back when braking."""

from dataclasses import dataclass

import numpy as np

from tractor_msgs_py.trajectory import FloatArray

GRAVITY_M_PER_S2 = 9.81


@dataclass(frozen=True)
class Driveline:
    """Electric drives of axle, PTO and hydraulics.

    Attributes:
        motor_power_w: rated power of the traction motor [W].
        motor_load_fraction, motor_efficiency: motor with inverter against load, shape (K,).
        gear_efficiency: motor to axle [-].
        pto_efficiency: bus to PTO shaft: motor, inverter and gear [-].
        hydraulic_efficiency: bus to oil: motor, inverter and pump [-].
        regeneration_max_w: most that braking gives back to the bus [W].
    """

    motor_power_w: float
    motor_load_fraction: tuple[float, ...]
    motor_efficiency: tuple[float, ...]
    gear_efficiency: float
    pto_efficiency: float
    hydraulic_efficiency: float
    regeneration_max_w: float

    def axle_to_bus_w(self, axle_w: FloatArray) -> FloatArray:
        """Bus power of an axle power, losses either way, any shape [W].

        Braking beyond ``regeneration_max_w`` goes into the friction brakes.
        """
        motor_w = np.where(
            axle_w > 0, axle_w / self.gear_efficiency, axle_w * self.gear_efficiency
        )
        load = np.abs(motor_w) / self.motor_power_w
        efficiency = np.interp(load, self.motor_load_fraction, self.motor_efficiency)
        bus = np.where(motor_w > 0, motor_w / efficiency, motor_w * efficiency)
        limited: FloatArray = np.maximum(bus, -self.regeneration_max_w)
        return limited
