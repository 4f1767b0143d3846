"""``ems demo``: the main job end to end, in minutes."""

from pathlib import Path
from typing import Annotated

import typer

from tractor_ems.cli.output import (
    NOTES,
    RESULT_COLUMNS,
    JsonFlag,
    print_json,
    print_table,
    result_row,
)


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
    rows = sorted(document["results"], key=lambda row: (row["cycle"], -(row["dp_ratio"] or 0.0)))
    print_table("held-out cycles", RESULT_COLUMNS, [result_row(row) for row in rows])
    print(f"bags, policies, plots and summary.json are in {out}")
