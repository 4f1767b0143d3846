"""Tractor, implement and soil of one draw, and the bus power they need at a speed."""

from dataclasses import dataclass

import numpy as np

from tractor_msgs_py.trajectory import FloatArray
from tractor_sim.duty_cycle.field_work.draft import draft_n, draft_params
from tractor_sim.duty_cycle.field_work.params import FieldWork, Vehicle
from tractor_sim.duty_cycle.field_work.powers import GRAVITY_M_PER_S2, Driveline
from tractor_sim.duty_cycle.field_work.traction import Wheels, wheels


def driveline(vehicle: Vehicle) -> Driveline:
    """The electric drives of a vehicle."""
    return Driveline(
        vehicle.motor_power_w,
        vehicle.motor_load_fraction,
        vehicle.motor_efficiency,
        vehicle.gear_efficiency,
        vehicle.pto_efficiency,
        vehicle.hydraulic_efficiency,
        vehicle.regeneration_max_w,
    )


_SOIL_MIN = 0.4
"""Below this share of its mean draft, an implement is on its way up or down."""


@dataclass(frozen=True)
class Setup:
    """Tractor, implement and soil of one draw.

    Attributes:
        work: the operation.
        slip_max: draft control eases the implement beyond this slip [-].
        drive: bus to wheels, PTO and oil.
        wheels: traction on this soil.
        units: implement width in its own unit [m, tools or rows].
        width_m: worked width, overlap taken off [m].
        depth_cm: ignored where the implement has none.
        texture: of the soil.
        speed_m_per_s: aimed at.
        tractor_kg: with ballast.
        crop_kg_per_m2: 0 where there is no PTO.
    """

    work: FieldWork
    slip_max: float
    drive: Driveline
    wheels: Wheels
    units: float
    width_m: float
    depth_cm: float
    texture: str
    speed_m_per_s: float
    tractor_kg: float
    crop_kg_per_m2: float

    def demand_w(
        self,
        speed_m_per_s: FloatArray,
        soil: FloatArray,
        crop: FloatArray,
        grade: FloatArray,
        acceleration_m_per_s2: FloatArray,
    ) -> FloatArray:
        """Bus power at work, any shape [W].

        Args:
            speed_m_per_s: ground speed.
            soil, crop: draft and crop over their means, 0 with the implement lifted [-].
            grade: rise over run [-].
            acceleration_m_per_s2: of tractor and implement.
        """
        work = self.work
        mass = self.tractor_kg + work.implement_kg + work.cart_kg
        rolls_kg = np.full_like(soil, work.implement_kg + work.cart_kg)
        if work.d497 is not None:
            # The standard's draft holds the implement's own rolling resistance.
            rolls_kg = rolls_kg - work.implement_kg * np.minimum(soil / _SOIL_MIN, 1.0)
        pull = rolls_kg * GRAVITY_M_PER_S2 * work.rolling + mass * (
            GRAVITY_M_PER_S2 * grade + acceleration_m_per_s2
        )
        if work.d497 is not None:
            draft = soil * draft_n(
                draft_params(work.d497), self.texture, self.units, self.depth_cm, speed_m_per_s
            )
            spare = np.maximum(self.wheels.pull_limit_n(self.slip_max) - pull, 0.0)
            pull = pull + np.minimum(draft, spare)
        axle = self.wheels.axle_power_w(pull, speed_m_per_s)
        power = self.drive.axle_to_bus_w(axle)
        power = power + work.hydraulic_w / self.drive.hydraulic_efficiency
        if work.pto is not None:
            throughput = crop * self.crop_kg_per_m2 * self.width_m * speed_m_per_s
            shaft = work.pto.idle_w + work.pto.energy_j_per_kg * throughput
            power = power + shaft / self.drive.pto_efficiency
        bus: FloatArray = power
        return bus


def draw_setup(
    rng: np.random.Generator, vehicle: Vehicle, work: FieldWork, depth_cm: float | None
) -> Setup:
    """Width, depth, soil and speed of one draw."""
    units = float(rng.choice(work.units))
    drawn_depth = float(rng.uniform(*work.depth_cm)) if work.depth_cm else 1.0
    texture = str(rng.choice(work.textures))
    if work.d497 is not None:
        units = wider_in_light_soil(work, units, texture)
    speed = float(rng.uniform(*work.speed_km_h)) / 3.6
    numeric = float(rng.uniform(*work.wheel_numeric))
    crop = float(rng.uniform(*work.pto.crop_kg_per_m2)) if work.pto else 0.0
    return make_setup(
        vehicle,
        work,
        units=units,
        depth_cm=drawn_depth if depth_cm is None else depth_cm,
        texture=texture,
        speed_m_per_s=speed,
        wheel_numeric=numeric,
        crop_kg_per_m2=crop,
    )


def wider_in_light_soil(work: FieldWork, units: float, texture: str) -> float:
    """Width x F^-0.5: who farms sand buys a wider implement; whole tools (assumed)."""
    assert work.d497 is not None
    wider = units * draft_params(work.d497).texture_factor[texture] ** -0.5
    return wider if work.unit_width_m == 1.0 else float(round(wider))


def make_setup(
    vehicle: Vehicle,
    work: FieldWork,
    *,
    units: float,
    depth_cm: float,
    texture: str,
    speed_m_per_s: float,
    wheel_numeric: float,
    crop_kg_per_m2: float = 0.0,
) -> Setup:
    """A ``Setup`` from chosen values."""
    tractor_kg = vehicle.weight_kg + work.ballast_kg
    return Setup(
        work,
        vehicle.slip_max,
        driveline(vehicle),
        wheels(tractor_kg * GRAVITY_M_PER_S2, wheel_numeric),
        units,
        units * work.unit_width_m * (1.0 - work.overlap),
        depth_cm,
        texture,
        speed_m_per_s,
        tractor_kg,
        crop_kg_per_m2,
    )
