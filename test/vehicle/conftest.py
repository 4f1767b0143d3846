"""Recordings that several tests read."""

from pathlib import Path

import numpy as np
import pytest
from vehicle.recordings import samples, varied, write


@pytest.fixture(scope="session")
def varied_field_bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Ten minutes of the field tractor all over its map."""
    out = tmp_path_factory.mktemp("field") / "bag"
    return write(out, samples("field", *varied(7, 600, 253e3)))


@pytest.fixture(scope="session")
def varied_paper_bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The paper's vehicle: lossless battery, efficiency curve, no start fuel."""
    out = tmp_path_factory.mktemp("paper") / "bag"
    return write(out, samples("paper", *varied(8, 400, 275e3)))


@pytest.fixture(scope="session")
def steady_bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two minutes of 90 kW, all of it from the engine."""
    out = tmp_path_factory.mktemp("steady") / "bag"
    return write(out, samples("field", np.full(120, 90e3), np.full(120, 90e3)))
