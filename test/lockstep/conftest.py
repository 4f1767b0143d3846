"""A short run of the paper powertrain for the state machines of both sides."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from tractor_sim.plant_run import PlantRun, prepare_run

DEMAND_W = (60e3, 150e3, 200e3, 90e3, 20e3, 180e3)


@pytest.fixture
def make_run(tmp_path: Path) -> Callable[..., PlantRun]:
    """A new run over ``DEMAND_W``; keyword arguments go to ``prepare_run``."""
    cycle = tmp_path / "short.csv"
    rows = "".join(f"{k},{power_w}\n" for k, power_w in enumerate(DEMAND_W))
    cycle.write_text("time_s,power_demand_w\n" + rows)

    def make(run_id: str = "", **settings) -> PlantRun:
        run = prepare_run("paper", str(cycle), **settings)
        if run_id:
            run.info = replace(run.info, run_id=run_id)
        return run

    return make
