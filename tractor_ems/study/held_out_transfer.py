"""Sixth stage of the held-out study: the learned policy on other vehicles, as it is, with the
right plant model, and trained anew, beside rules that were made for nobody."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from tractor_ems.study.held_out_config import HeldOutConfig, Vehicle
from tractor_ems.study.held_out_drive import Driving, drive_all
from tractor_ems.study.held_out_policies import Driver
from tractor_ems.study.held_out_record import record, recordings_of
from tractor_ems.study.held_out_score import Optima, optima, ratios
from tractor_ems.study.held_out_train import Trained, Training, train, training_of

AS_IS = "as it is"
NEW_LIMITS = "right plant model"
ANEW = "trained anew"
RULE = "rule"

Do = Callable[[str, Callable[[Any], Any], Sequence[Any]], list[Any]]
"""Does a function over tasks on all cores, under a heading."""


def transfer(
    config: HeldOutConfig, drivers: Sequence[Driver], out: Path, do: Do
) -> tuple[list[dict[str, Any]], list[Trained]]:
    """Rows of every vehicle, way and policy on scaled cycles, and the trainings anew.

    Args:
        drivers: the subject's policy files on its own powertrain.
        out: folder of the study.
    """
    cycles = tuple(config.subset(config.budget.transfer_cycles))
    vehicles = config.settings.vehicles
    if not cycles or not vehicles:
        return [], []
    trained = _trained(config, out, do)
    drives = [
        (way, task)
        for vehicle in vehicles
        for way, task in _drives(config, vehicle, drivers, trained, cycles, out)
    ]
    found = do("drive other vehicles", drive_all, [task for _, task in drives])
    rows = [
        {"vehicle": task.powertrain, "scale": task.scale, "way": way, **row}
        for (way, task), result in zip(drives, found, strict=True)
        for row in result["rows"]
    ]
    return _scored(rows, out, do), trained


def _trained(config: HeldOutConfig, out: Path, do: Do) -> list[Trained]:
    settings, recordings = config.settings, []
    learner = next((x for x in settings.learners if x.name == settings.subject), None)
    if learner is None:
        return []
    for vehicle in settings.vehicles:
        recordings += recordings_of(
            vehicle.powertrain,
            config.transfer_training,
            settings.recorders[:1],
            vehicle.scale,
            out / "transfer" / vehicle.powertrain / "bags",
        )
    recorded = do("record other vehicles", record, recordings)
    tasks: list[Training] = []
    for vehicle in settings.vehicles:
        own = [
            item
            for task, item in zip(recordings, recorded, strict=True)
            if task.powertrain == vehicle.powertrain
        ]
        tasks.append(
            training_of(
                learner.name,
                own,
                kind="learner",
                preset=learner.preset,
                powertrain=vehicle.powertrain,
                updates=config.budget.updates,
                seed=0,
                out=out / "transfer" / vehicle.powertrain / f"{learner.name}_s0.safetensors",
            )
        )
    return do("train for other vehicles", train, tasks)


def _drives(
    config: HeldOutConfig,
    vehicle: Vehicle,
    drivers: Sequence[Driver],
    trained: Sequence[Trained],
    cycles: tuple[str, ...],
    out: Path,
) -> list[tuple[str, Driving]]:
    ways = [(way, driver) for way in (AS_IS, NEW_LIMITS) for driver in drivers]
    for item in trained:
        task = item.training
        if task.powertrain == vehicle.powertrain:
            ways.append((ANEW, Driver(task.name, task.seed, task.out, item.file_sha256)))
    rules = [name for name in config.settings.opponents if name in config.settings.rules]
    ways += [(RULE, Driver(name)) for name in rules]
    folder = out / "transfer" / vehicle.powertrain
    return [
        (
            way,
            Driving(
                driver,
                vehicle.powertrain,
                cycles,
                folder / f"{way.replace(' ', '_')}_{driver.label}.json",
                scale=vehicle.scale,
                refit=way == NEW_LIMITS,
            ),
        )
        for way, driver in ways
    ]


def _scored(rows: Sequence[dict[str, Any]], out: Path, do: Do) -> list[dict[str, Any]]:
    places: dict[tuple[str, float, str], list[int]] = {}
    for number, row in enumerate(rows):
        places.setdefault((row["vehicle"], row["scale"], row["cycle"]), []).append(number)
    tasks = [
        Optima(
            powertrain,
            cycle,
            tuple(rows[n]["soc_final"] for n in numbers if rows[n]["shortfall_j"] == 0.0),
            out / "optima",
            scale=scale,
            exact=True,
        )
        for (powertrain, scale, cycle), numbers in places.items()
    ]
    found = do("score other vehicles", optima, tasks)
    made = [{**row, "dp_ratio": None} for row in rows]
    for numbers, least in zip(places.values(), found, strict=True):
        finished = [n for n in numbers if rows[n]["shortfall_j"] == 0.0]
        for number, ratio in zip(
            finished, ratios([rows[n] for n in finished], least), strict=True
        ):
            made[number]["dp_ratio"] = ratio
    return made
