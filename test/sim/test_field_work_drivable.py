"""Generated cycles on the field vehicle, and the pictures and table of docs/duty-cycles.md."""

import numpy as np
import pytest

from tractor_ems import plots_cycles
from tractor_ems.drive import drive
from tractor_ems.policies.registry import make_rule
from tractor_sim.config import load_powertrain
from tractor_sim.duty_cycle.generate import MEASURED_JOBS, OPERATIONS, generate
from tractor_sim.resources import share_dir


@pytest.mark.slow
def test_an_engine_that_never_stops_delivers_every_cycle_within_the_battery():
    """A rule without foresight does it, so the cycles do not ask too much."""
    params = load_powertrain("field")
    names = [(name, seed) for name in OPERATIONS + MEASURED_JOBS for seed in range(1, 11)]
    demand_w = np.stack([generate(*name).power_demand_w for name in names]) + params.p_aux_w
    runs = drive(make_rule("never_stop_ecms", params), params, demand_w, 0.55, 0.55)
    for name, run in zip(names, runs, strict=True):
        # A first step from standstill may beat the engine's ramp by a second.
        assert run.shortfall_j.sum() < 1e-4 * np.maximum(run.power_demand_w, 0).sum(), name
        assert run.soc.min() > params.battery.soc_min + 0.05, name
        assert abs(run.soc_final - 0.55) < 0.1, name


@pytest.mark.slow
def test_both_pictures_are_written_and_small(tmp_path, monkeypatch):
    monkeypatch.setattr(plots_cycles, "SEEDS", range(1, 3))
    plots_cycles.plot_measured_jobs(tmp_path / "a.png")
    plots_cycles.plot_operations(tmp_path / "b.png")
    for name in ("a.png", "b.png"):
        data = (tmp_path / name).read_bytes()
        assert data.startswith(b"\x89PNG")
        assert len(data) < 150_000


@pytest.mark.slow
def test_the_table_of_operations_in_the_docs_is_todays():
    if not (share_dir() / "docs").is_dir():
        pytest.skip("docs are not installed")
    text = (share_dir() / "docs" / "duty-cycles.md").read_text(encoding="utf-8")
    assert plots_cycles.operation_table() in text
