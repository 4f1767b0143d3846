"""A run as columns, and the hash that proves two transports drove the same one."""

import hashlib
from dataclasses import dataclass, fields
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

FloatArray: TypeAlias = NDArray[np.float64]
IntArray: TypeAlias = NDArray[np.int64]
BoolArray: TypeAlias = NDArray[np.bool_]


@dataclass(frozen=True)
class Trajectory:
    """T steps of one run; every column has shape (T,). The hash covers the first nine.

    Attributes:
        stamp_ns: t_k.
        power_demand_w: demand at the bus over step k.
        soc_observed: SOC at t_k with the wire's float32 resolution.
        command_battery_power_w, command_engine_power_w: the command as sent (NaN: no opinion).
        battery_power_w, engine_power_w: what was applied over step k.
        fuel_kg: fuel burnt over step k, start fuel included.
        engine_on: engine state during step k.
        shortfall_j, dissipated_j: undelivered demand and braked-away energy over step k.
        soc: exact plant SOC at t_k, or the observed one where only a bag is at hand.
        soc_final: SOC at t_T.
    """

    stamp_ns: IntArray
    power_demand_w: FloatArray
    soc_observed: FloatArray
    command_battery_power_w: FloatArray
    command_engine_power_w: FloatArray
    battery_power_w: FloatArray
    engine_power_w: FloatArray
    fuel_kg: FloatArray
    engine_on: BoolArray
    shortfall_j: FloatArray
    dissipated_j: FloatArray
    soc: FloatArray
    soc_final: float

    def __len__(self) -> int:
        return len(self.stamp_ns)


HASHED_COLUMNS = tuple(field.name for field in fields(Trajectory))[:9]


def trajectory_hash(trajectory: Trajectory) -> str:
    """SHA-256 over the unrounded hashed columns, little-endian, NaN canonical.

    Comparable for a batch of one on one thread of one machine: batched and single network
    outputs differ in the last bits.
    """
    digest = hashlib.sha256()
    for name in HASHED_COLUMNS:
        column = getattr(trajectory, name)
        if name == "stamp_ns":
            data = np.asarray(column, dtype="<i8")
        else:
            data = np.asarray(column, dtype="<f8") + 0.0  # folds -0.0 into 0.0
            data = np.where(np.isnan(data), np.nan, data).astype("<f8")
        digest.update(name.encode())
        digest.update(data.tobytes())
    return digest.hexdigest()
