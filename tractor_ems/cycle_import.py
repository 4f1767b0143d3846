"""Recordings of demand, CSV or bag, to duty cycles in CSV with an account of every repair."""

from pathlib import Path

import numpy as np

from tractor_msgs_py.errors import BagError, ConfigError
from tractor_sim.duty_cycle.cycle import DutyCycle
from tractor_sim.duty_cycle.cycle_csv import read_rows, write_cycle_csv
from tractor_sim.duty_cycle.resample import Account, ImportSettings, Samples, resample


def import_cycle(
    source: Path, out: Path, settings: ImportSettings, *, force: bool = False
) -> tuple[list[Path], Account]:
    """Read, clean, resample and write a recording.

    Args:
        source: CSV with ``time_s,power_demand_w``, or a bag of one run.
        out: CSV to write; several pieces are numbered, ``OUT_1.csv`` and so on.
        settings: what to repair.
        force: replace files that exist.

    Returns:
        The files written and the account.

    Raises:
        CycleError: see ``resample``, or the file is malformed.
        BagError: the bag cannot be read, or holds several runs.
        ConfigError: ``out`` is no CSV name, exists, or cannot be written.
    """
    check_out(out, force)
    samples = _from_csv(source) if source.suffix.lower() == ".csv" else _from_bag(source)
    pieces, account = resample(samples, settings)
    paths = [out]
    if len(pieces) > 1:
        paths = [out.with_name(f"{out.stem}_{n}{out.suffix}") for n in range(1, len(pieces) + 1)]
    for path in paths:
        check_out(path, force)
    for path, demand_w in zip(paths, pieces, strict=True):
        write_cycle_csv(path, DutyCycle(path.stem, demand_w, settings.dt_s, "csv"))
    return paths, account


def check_out(out: Path, force: bool) -> None:
    """Refuse a name that no reader would take for a cycle, or that stands for a file already.

    Raises:
        ConfigError: so.
    """
    if out.suffix != ".csv":
        raise ConfigError(f"{out}: a cycle is written as .csv")
    if out.exists() and not force:
        raise ConfigError(f"{out}: exists already (--force replaces it)")


def _from_csv(path: Path) -> Samples:
    lines, rows = read_rows(path)
    cells = np.array([[_number(cell) for cell in row] for row in rows]).reshape(-1, 2)
    return Samples(str(path), np.array(lines, dtype=np.int64), cells[:, 0], cells[:, 1])


def _number(cell: str) -> float:
    try:
        return float(cell)
    except ValueError:
        return float("nan")


def _from_bag(path: Path) -> Samples:
    """Demand of the bag's only run, less the auxiliaries that its plant added."""
    from tractor_ems.bags.read import read_bag

    runs = [run for run in read_bag(path) if run.demand]
    if len(runs) != 1:
        raise BagError(f"{path}: {len(runs)} runs with a power demand, a cycle needs exactly one")
    run = runs[0]
    stamp_ns = np.array(list(run.demand), dtype=np.int64)
    p_aux_w = 0.0 if run.info is None else run.info.p_aux_w
    demand_w = np.array([sample.power_w for sample in run.demand.values()]) - p_aux_w
    refused = dict(run.refusals)
    if run.duplicates:
        refused["repeated stamp"] = run.duplicates
    return Samples(
        str(path),
        np.arange(1, len(stamp_ns) + 1),
        (stamp_ns - stamp_ns[0]) * 1e-9,
        demand_w,
        place_name="message",
        refused=tuple(sorted(refused.items())),
    )
