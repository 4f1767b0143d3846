"""``ems study``: reproduce the paper; compare policies on held-out cycles."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from tractor_ems.cli.output import NOTES, JsonFlag, print_json, print_table
from tractor_msgs_py.errors import ConfigError

app = typer.Typer(no_args_is_help=True, help="Studies that are reproduced as a whole.")


@app.callback()
def studies() -> None:
    """Studies that are reproduced as a whole."""


@app.command()
def paper(
    preset: Annotated[
        str, typer.Option(help="Budget: smoke (minutes), standard (over an hour), full (days).")
    ] = "standard",
    out: Annotated[
        Path, typer.Option(help="Folder of bags, runs, checkpoints, report; kept and reused.")
    ] = Path("out/study/paper"),
    report: Annotated[
        Path | None, typer.Option(help="Markdown report; default OUT/PRESET/reproduction.md.")
    ] = None,
    settings: Annotated[
        str, typer.Option(help="config/study name or YAML file with every choice.")
    ] = "paper",
    workers: Annotated[
        int | None, typer.Option(min=1, help="Processes; default one per core.")
    ] = None,
    json: JsonFlag = False,
) -> None:
    """Train every agent of the paper, make its tables and figures, and write the report.

    Ctrl-C leaves checkpoints; the same command goes on from them and from finished runs.
    """
    from tractor_ems.study.config import load_study
    from tractor_ems.study.report import write_report
    from tractor_ems.study.schedule import workers_of
    from tractor_ems.study.study import run_study
    from tractor_ems.study.tables import build_tables, to_json

    target = report or out / preset / "reproduction.md"
    if target.suffix != ".md" or target.is_dir():
        raise ConfigError(f"{target}: the report must be a file that ends in .md")
    config = load_study(settings, preset)
    with _stages() as stage:
        results = run_study(config, out, workers=workers_of(workers), stage=stage)
    NOTES.print(f"tables and figures: {target}")
    write_report(results, target, target.with_suffix(""))
    tables = build_tables(results)
    if json:
        print_json({"report": str(target), "tables": [to_json(table) for table in tables]})
        return
    for table in tables:
        print_table(table.title, table.columns, table.rows)


@app.command("held-out")
def held_out(
    preset: Annotated[
        str, typer.Option(help="Budget: smoke (minutes, means nothing) or full.")
    ] = "smoke",
    out: Annotated[
        Path, typer.Option(help="Folder of bags, policies, pieces, report; kept and reused.")
    ] = Path("out/study/held-out"),
    report: Annotated[
        Path | None, typer.Option(help="Markdown report; default OUT/PRESET/held_out.md.")
    ] = None,
    source: Annotated[
        Path | None,
        typer.Option("--from", help="Results to make the report of again; nothing is run."),
    ] = None,
    settings: Annotated[
        str, typer.Option(help="config/study name or YAML file with every choice.")
    ] = "held_out",
    workers: Annotated[
        int | None, typer.Option(min=1, help="Processes; default one per core.")
    ] = None,
    json: JsonFlag = False,
) -> None:
    """Train on recorded runs, then score every policy on cycles that no training saw.

    Ctrl-C loses what is under way; the same command goes on from what is finished. The report's
    results are in data/STEM.json beside it, its figures in the folder STEM.
    """
    from tractor_ems.study.held_out import run_held_out
    from tractor_ems.study.held_out_config import load_held_out
    from tractor_ems.study.held_out_report import write_report
    from tractor_ems.study.held_out_results import read_results, results_of
    from tractor_ems.study.schedule import workers_of

    target = report or out / preset / "held_out.md"
    if target.suffix != ".md" or target.is_dir():
        raise ConfigError(f"{target}: the report must be a file that ends in .md")
    if source is not None:
        results = read_results(source)
    else:
        config = load_held_out(settings, preset)
        with _stages() as bars:

            def stage(name: str, jobs: int) -> Callable[[int], None]:
                bar = bars(name, jobs)
                return lambda done: bar(done, [float(done)])

            found = run_held_out(config, out / preset, workers=workers_of(workers), stage=stage)
        results = results_of(found)
    data = write_report(results, target)
    NOTES.print(f"report: {target}")
    verdicts = results["verdicts"]
    if json:
        print_json({"report": str(target), "results": str(data), "verdicts": verdicts})
        return
    rows = [
        (item["bar"], item["wanted"], item["found"], "met" if item["met"] else "missed")
        for item in verdicts
    ]
    print_table("held-out study", ("bar", "wanted", "found", "verdict"), rows)


@contextmanager
def _stages() -> Iterator["StageBars"]:
    with Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.fields[done]}/{task.fields[jobs]}"),
        TimeElapsedColumn(),
        TimeRemainingColumn(elapsed_when_finished=True),
        console=NOTES,
        disable=not NOTES.is_terminal,
    ) as bar:
        yield StageBars(bar)


class StageBars:
    """One line per stage, over all processes."""

    def __init__(self, bar: Progress) -> None:
        self.bar = bar

    def __call__(self, name: str, jobs: int) -> "StageBar":
        """A new line; nothing to do gives none."""
        if jobs and not NOTES.is_terminal:
            NOTES.print(f"{name}: {jobs}")
        task = self.bar.add_task(name, total=float(jobs), done=0, jobs=jobs, visible=jobs > 0)
        return StageBar(self.bar, task)


class StageBar:
    """Progress of one stage."""

    def __init__(self, bar: Progress, task: int) -> None:
        self.bar, self.task = bar, task

    def __call__(self, done: int, shares: Sequence[float]) -> None:
        """Finished jobs are counted, running ones move the bar."""
        from rich.progress import TaskID

        self.bar.update(TaskID(self.task), completed=sum(shares), done=done)
