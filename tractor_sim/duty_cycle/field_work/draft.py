"""Draft of a tillage or seeding implement by ASABE D497, from the shipped parameter table."""

import csv
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from tractor_msgs_py.errors import ConfigError
from tractor_msgs_py.trajectory import FloatArray
from tractor_sim.resources import resource_path


@dataclass(frozen=True)
class DraftParams:
    """One row of the table.

    Attributes:
        a, b, c: of draft per width unit and cm of depth, with speed in km/h.
        texture_factor: F by soil texture, ``fine``, ``medium`` and ``coarse``.
        has_depth: whether draft grows with depth; if not, depth counts as 1.
    """

    a: float
    b: float
    c: float
    texture_factor: dict[str, float]
    has_depth: bool


@lru_cache(maxsize=1)
def draft_table() -> dict[str, DraftParams]:
    """Every implement of the shipped table by its name."""
    path = resource_path("data", "cycle", "asabe_d497_draft_parameters.csv")
    with path.open(newline="", encoding="utf-8") as file:
        return {
            row["implement"]: DraftParams(
                float(row["A"]),
                float(row["B"]),
                float(row["C"]),
                {name: float(row[f"F_{name}"]) for name in ("fine", "medium", "coarse")},
                row["depth_unit_cm"] == "1",
            )
            for row in csv.DictReader(file)
        }


def draft_params(implement: str) -> DraftParams:
    """The row of one implement.

    Raises:
        ConfigError: the table has no such implement.
    """
    table = draft_table()
    if implement not in table:
        raise ConfigError(f"d497: {implement!r} is not in the table, one of {', '.join(table)}")
    return table[implement]


def draft_n(
    params: DraftParams, texture: str, units: float, depth_cm: float, speed_m_per_s: FloatArray
) -> FloatArray:
    """D = F (A + B S + C S^2) W T of ASABE D497, any shape [N].

    Args:
        params: row of the implement.
        texture: fine, medium or coarse.
        units: W, in the table's width unit (m, tools or rows).
        depth_cm: T, ignored where the implement has none [cm].
        speed_m_per_s: S before its change to km/h, any shape [m/s].
    """
    s = 3.6 * np.asarray(speed_m_per_s)
    t = depth_cm if params.has_depth else 1.0
    draft: FloatArray = (
        params.texture_factor[texture] * units * t * (params.a + s * (params.b + s * params.c))
    )
    return draft
