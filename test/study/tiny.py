"""The study's settings, cut down to what a test can wait for."""

from dataclasses import replace
from typing import Any

from tractor_ems.study.config import StudyConfig, load_study
from tractor_ems.study.rows import Row


def tiny(row_id: str, *, episodes: int = 4, seeds: int = 1, **changes: Any) -> StudyConfig:
    """One row of the study (its last SOC_min) with a small network or table."""
    config = load_study("paper", "smoke")
    row = replace([row for row in config.rows if row.id == row_id][-1], **changes)
    budget = replace(
        config.budget,
        seeds=seeds,
        network_episodes=episodes,
        network_eval_every=1,
        steps_per_update=8,
        table_episodes=episodes,
        table_eval_every=1,
        replay_capacity=4000,
    )
    networks = replace(config.networks, hidden=(8,), warm_up=500, batch=16)
    tables = replace(config.tables, soc_bins=10, demand_bins=20)
    return replace(config, rows=(row,), budget=budget, networks=networks, tables=tables)


def row_of(config: StudyConfig) -> Row:
    """Its only row."""
    (row,) = config.rows
    return row
