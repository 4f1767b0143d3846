"""The held-out study from nothing to one document of rows: record, train, drive, score, disturb,
transfer. Every finished piece is on disk, so the same call goes on where it was ended."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from tractor_ems.study.held_out_config import HeldOutConfig
from tractor_ems.study.held_out_drive import Driving, drive_all
from tractor_ems.study.held_out_policies import DP, Driver
from tractor_ems.study.held_out_record import Recorded, record, recordings_of
from tractor_ems.study.held_out_robustness import (
    Disturbing,
    drive_disturbed,
    optima_of,
    scored_rows,
)
from tractor_ems.study.held_out_score import Optima, optima, ratios, score, scored, scoring_of
from tractor_ems.study.held_out_train import Trained, Training, train, training_of
from tractor_ems.study.held_out_transfer import transfer
from tractor_ems.study.parallel import do_all
from tractor_msgs_py import __version__

Stage = Callable[[str, int], Callable[[int], None]]
"""Opens the progress of a stage of so many tasks; what it returns is told how many are done."""


def run_held_out(
    config: HeldOutConfig, out: Path, *, workers: int, stage: Stage
) -> dict[str, Any]:
    """Do all that is not done yet.

    Args:
        out: folder of the preset: bags, policy files, pieces.
        workers: processes, >= 1.
        stage: see :data:`Stage`.

    Returns:
        Everything the report is made of, as plain data without paths.

    Raises:
        KeyboardInterrupt: Ctrl-C; finished pieces stay.
        RunAborted: a run beat the optimum, a training diverged, a process was killed.
        TractorEmsError: bad input.
    """

    def do(heading: str, function: Callable[[Any], Any], tasks: Sequence[Any]) -> list[Any]:
        return do_all(function, tasks, workers=workers, progress=stage(heading, len(tasks)))

    settings, budget = config.settings, config.budget
    recordings = recordings_of(
        settings.powertrain, config.training, settings.recorders, 1.0, out / "bags"
    )
    recorded: list[Recorded] = do("record", record, recordings)
    main, curve = _trainings(config, recorded, out)
    trained: list[Trained] = do("train", train, [*main, *curve])
    drivers = _drivers(config, trained[: len(main)])
    driven = do("drive", drive_all, _drives(config, drivers, out))
    rows = [row for result in driven for row in result["rows"]]
    scores = do(
        "score", score, [scoring_of(row, settings.powertrain, out / "scores") for row in rows]
    )
    rows = [scored(row, found, settings.bars.bug) for row, found in zip(rows, scores, strict=True)]
    subjects = [item for item in drivers if item.name == settings.subject]
    transferred, anew = transfer(config, subjects[: budget.robust_seeds], out, do)
    return {
        "settings": config.to_json(),
        "package_version": __version__,
        "recorded": {
            "bags": len(recorded),
            "transitions": sum(item.steps for item in recorded),
            "cpu_s": round(sum(item.cpu_s for item in recorded), 1),
        },
        "training": [item.to_json() for item in (*trained[: len(main)], *anew)],
        "curve": _curve(config, trained, len(main), out, do),
        "rows": rows,
        "traces": _traces(config, drivers, driven),
        "robustness_rows": _robustness(config, drivers, out, do),
        "transfer_rows": transferred,
    }


def _trainings(
    config: HeldOutConfig, recorded: Sequence[Recorded], out: Path
) -> tuple[list[Training], list[Training]]:
    """Every policy of the study, and those of the learning curve besides."""
    settings, budget = config.settings, config.budget
    powertrain, folder = settings.powertrain, out / "policies"
    distinct = recorded[: len(config.training)]  # the first recorder's: every cycle once
    main = [
        training_of(
            learner.name,
            recorded,
            kind="learner",
            preset=learner.preset,
            powertrain=powertrain,
            seed=seed,
            updates=budget.updates,
            out=folder / f"{learner.name}_s{seed}.safetensors",
        )
        for learner in settings.learners
        for seed in range(budget.seeds)
    ]
    main += [
        training_of(
            table.name,
            recorded,
            kind="table",
            planned=table.planned,
            powertrain=powertrain,
            out=folder / f"{table.name}.safetensors",
        )
        for table in settings.tables
    ]
    return main, [
        training_of(
            learner.name,
            _some(distinct, count),
            kind="learner",
            preset=learner.preset,
            powertrain=powertrain,
            seed=seed,
            updates=budget.updates,
            out=folder / f"{learner.name}_of_{count}_s{seed}.safetensors",
        )
        for learner in settings.learners
        if learner.name == settings.subject
        for count in budget.curve_bags
        if count <= len(distinct)
        for seed in range(budget.curve_seeds)
    ]


def _some(recorded: Sequence[Recorded], count: int) -> list[Recorded]:
    """``count`` recordings spread evenly over them, so over operations."""
    return [recorded[(2 * n + 1) * len(recorded) // (2 * count)] for n in range(count)]


def _drivers(config: HeldOutConfig, trained: Sequence[Trained]) -> list[Driver]:
    made = [
        Driver(item.training.name, item.training.seed, item.training.out, item.file_sha256)
        for item in trained
    ]
    rules = [Driver(name) for name in config.settings.rules]
    # The optimum solves every cycle, which takes longest: it goes first.
    return sorted([*made, *rules], key=lambda driver: driver.name != DP)


def _drives(config: HeldOutConfig, drivers: Sequence[Driver], out: Path) -> list[Driving]:
    return [
        Driving(
            driver,
            config.settings.powertrain,
            tuple(config.scored),
            out / "drives" / f"{driver.label}.json",
            traces=config.budget.traces,
        )
        for driver in drivers
    ]


def _traces(
    config: HeldOutConfig, drivers: Sequence[Driver], driven: Sequence[dict[str, Any]]
) -> dict[str, Any]:
    """Traces of the subject's first seed, the never-stop rule and the optimum, by cycle."""
    shown = (config.settings.subject, config.settings.never_stop, DP)
    return {
        cycle: {
            driver.name: result["traces"][cycle]
            for driver, result in zip(drivers, driven, strict=True)
            if driver.name in shown and driver.seed in (None, 0)
        }
        for cycle in config.budget.traces
    }


def _robustness(
    config: HeldOutConfig, drivers: Sequence[Driver], out: Path, do: Any
) -> list[dict[str, Any]]:
    settings, budget = config.settings, config.budget
    cycles = tuple(config.subset(budget.robust_cycles))
    if not cycles or not settings.disturbances:
        return []
    tasks = [
        Disturbing(
            driver,
            settings.powertrain,
            cycles,
            settings.disturbances,
            out / "disturbed" / f"{driver.label}.json",
        )
        for driver in drivers
        if driver.name != DP and (driver.seed or 0) < budget.robust_seeds
    ]
    found = do("disturb", drive_disturbed, tasks)
    rows = [row for result in found for row in result]
    wanted, served = optima_of(rows, settings.powertrain, settings.disturbances, out / "optima")
    least = do("score disturbed", optima, wanted)
    return scored_rows(rows, served, least)


def _curve(
    config: HeldOutConfig, trained: Sequence[Trained], main: int, out: Path, do: Any
) -> list[dict[str, Any]]:
    """Points of the learning curve: what it learned from, and its scores on the dev cycles."""
    settings, budget = config.settings, config.budget
    points = [
        item
        for item in trained
        if item.training.name == settings.subject
        and (item.training.seed or 0) < budget.curve_seeds
    ]
    drives = [
        Driving(
            Driver(settings.subject, item.training.seed, item.training.out, item.file_sha256),
            settings.powertrain,
            budget.dev,
            out / "curve" / f"{item.training.out.stem}.json",
        )
        for item in points
    ]
    found = do("drive dev cycles", drive_all, drives)
    tasks = []
    for n, cycle in enumerate(budget.dev):
        ends = [result["rows"][n] for result in found]
        served = tuple(row["soc_final"] for row in ends if row["shortfall_j"] == 0.0)
        tasks.append(Optima(settings.powertrain, cycle, served, out / "optima"))
    solved = [iter(least) for least in do("score dev cycles", optima, tasks)]
    made = []
    for item, result in zip(points, found, strict=True):
        scores = []
        for row, least in zip(result["rows"], solved, strict=True):
            short = row["shortfall_j"] > 0.0
            scores += ratios([row], [0.0 if short else next(least)])
        errors = [abs(row["soc_final"] - row["soc_target"]) for row in result["rows"]]
        made.append({**item.to_json(), "dp_ratio": scores, "soc_error": errors})
    return made
