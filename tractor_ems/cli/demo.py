"""``ems demo``: the main job end to end, in minutes."""

from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from tractor_ems.cli.output import NOTES, JsonFlag, print_json, print_table


def demo(
    out: Annotated[Path, typer.Option(help="Folder for bags, policies, plots, summary.json.")] = (
        Path("out/demo")
    ),
    seed: Annotated[int, typer.Option(min=0, help="Seed of the training.")] = 0,
    json: JsonFlag = False,
) -> None:
    """Record experts to MCAP through the nodes, learn from the bags, drive unseen cycles."""
    from tractor_ems.demo import DemoConfig, run_demo

    document = run_demo(out, DemoConfig(seed=seed), NOTES.print)
    if json:
        print_json(document)
        return
    _print_summary(document["results"])
    print(f"bags, policies, plots and summary.json are in {out}")


def _print_summary(results: list[dict[str, Any]]) -> None:
    """One row per policy over all unseen cycles, the best median dp_ratio first."""
    by_policy: dict[str, list[dict[str, Any]]] = {}
    for result in results:
        by_policy.setdefault(result["policy"], []).append(result)
    rows = []
    for policy, runs in by_policy.items():
        ratios = [run["dp_ratio"] for run in runs if run["dp_ratio"] is not None]
        complete = len(ratios) == len(runs)  # undelivered work must not score
        gaps = [abs(run["soc_final"] - run["soc_target"]) * 100 for run in runs]
        rows.append(
            (
                policy,
                float(np.median(ratios)) if complete else None,
                min(ratios) if complete else None,
                float(np.mean([run["fuel_gal"] for run in runs])),
                max(gaps),
                float(np.mean([run["engine_starts"] for run in runs])),
                sum(run["violations"] for run in runs),
            )
        )
    rows.sort(key=lambda row: -(row[1] or 0.0))
    cycles = len({run["cycle"] for run in results})
    columns = ("policy", "dp_ratio", "worst", "gal", "SOC gap", "starts", "violations")
    print_table(
        f"{cycles} unseen cycles: median and worst dp_ratio, mean fuel, worst SOC gap "
        "to the target in points",
        columns,
        rows,
    )
