"""The table that tuning scores by is the optimum."""

import numpy as np
import pytest

from tractor_ems.optimal.engine_dp import solve_engine
from tractor_ems.tuning.reference import Reference
from tractor_sim.config import load_powertrain

FIELD = load_powertrain("field")
SHORT = np.where(np.arange(240) % 90 < 60, 30e3, 120e3)


@pytest.mark.slow
def test_interpolated_ends_are_the_solved_ones(tmp_path):
    reference = Reference(FIELD, SHORT, 0.55, tmp_path / "short.json")
    for soc in (0.541, 0.557):
        solved = solve_engine(FIELD, SHORT, 0.55, soc).lower_bound_kg
        assert reference.fuel_kg(soc) == pytest.approx(solved, rel=3e-3)
    again = Reference(FIELD, SHORT, 0.55, tmp_path / "short.json")
    assert again._fuel_kg == reference._fuel_kg


def test_an_end_that_cannot_be_reached_on_both_sides_is_solved_itself():
    reference = Reference(FIELD, SHORT[:20], 0.55)
    exact = solve_engine(FIELD, SHORT[:20], 0.55, 0.5505).lower_bound_kg
    assert reference.fuel_kg(0.5505) == pytest.approx(exact, rel=1e-9)
