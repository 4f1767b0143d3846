"""Recordings of demand, CSV or bag, to duty cycles in CSV with an account of every repair."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from tractor_msgs_py.errors import BagError, ConfigError, CycleError
from tractor_msgs_py.signals import SignalMap
from tractor_msgs_py.topics import POWER_DEMAND
from tractor_msgs_py.trajectory import FloatArray
from tractor_msgs_py.types import PowerDemand, RunInfo
from tractor_sim.duty_cycle.cycle import DutyCycle
from tractor_sim.duty_cycle.cycle_csv import read_rows, write_cycle_csv
from tractor_sim.duty_cycle.resample import Account, ImportSettings, Samples, resample


def import_cycle(
    source: Path,
    out: Path,
    settings: ImportSettings,
    *,
    force: bool = False,
    signals: SignalMap | None = None,
    namespace: str | None = None,
) -> tuple[list[Path], Account]:
    """Read, clean, resample and write a recording.

    Args:
        source: CSV with ``time_s,power_demand_w``, or a bag of one run.
        out: CSV to write; several pieces are numbered, ``OUT_1.csv`` and so on.
        settings: what to repair.
        force: replace files that exist.
        signals: the map of a vehicle, if the source is its bag.
        namespace: of the map's relative topics; None: the only one that fits.

    Returns:
        The files written and the account.

    Raises:
        CycleError: see ``resample``, the file is malformed, or auxiliaries were given for a
            recording that announces its own.
        BagError: the bag cannot be read, or holds several runs.
        ConfigError: ``out`` is no CSV name, exists, or cannot be written.
    """
    check_out(out, force)
    if source.suffix.lower() == ".csv":
        if signals is not None:
            raise ConfigError(f"{source}: --signals is for bags, a CSV has its own columns")
        samples = _from_csv(source, settings.aux_w)
    elif signals is not None:
        samples = _from_vehicle(source, settings.aux_w, signals, namespace)
    else:
        samples = _from_bag(source, settings.aux_w)
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


def _from_csv(path: Path, aux_w: float | None) -> Samples:
    lines, rows = read_rows(path)
    time_s: FloatArray = np.array([_number(row[0]) for row in rows], dtype=np.float64)
    power_w: FloatArray = np.array([_number(row[1]) for row in rows], dtype=np.float64)
    place = np.array(lines, dtype=np.int64)
    samples = Samples(str(path), place, time_s, power_w, cells=rows)
    if aux_w is None:
        return replace(samples, auxiliaries="none expected in a CSV, not removed")
    return _less(samples, aux_w, "--aux-w")


def _number(cell: str) -> float:
    try:
        return float(cell)
    except ValueError:
        return float("nan")


def _from_bag(path: Path, aux_w: float | None) -> Samples:
    """Every demand message of the bag's only run, less the auxiliaries that its plant added."""
    from tractor_ems.bags.read import read_bag
    from tractor_msgs_py.refusal import refusal

    runs = [run for run in read_bag(path) if run.demand]
    if len(runs) != 1:
        raise BagError(f"{path}: {len(runs)} runs with a power demand, a cycle needs exactly one")
    info = runs[0].info
    demand = demand_messages(path, runs[0].namespace)
    reasons = [refusal(sample, info) or "" for sample in demand]
    # What is no number or too large has a place of its own in the account.
    refused = ["" if r in ("not_finite", "demand_out_of_range") else r for r in reasons]
    stamp_ns = np.array([sample.stamp_ns for sample in demand], dtype=np.int64)
    time_s: FloatArray = (stamp_ns - next(iter(runs[0].demand))).astype(np.float64) * 1e-9
    samples = Samples(
        str(path),
        np.arange(1, len(demand) + 1),
        time_s,
        np.array([sample.power_w for sample in demand]),
        place_name="message",
        refused=refused,
    )
    if info is not None:
        return _less_announced(samples, aux_w, info)
    if aux_w is not None:
        return _less(samples, aux_w, "--aux-w")
    return replace(samples, auxiliaries="unknown, not removed")


def _from_vehicle(
    path: Path, aux_w: float | None, signals: SignalMap, namespace: str | None
) -> Samples:
    """Every value of the demand in a vehicle's bag, less its auxiliaries."""
    from tractor_ems.bags.sampled import series_of

    series = series_of(path, signals, "power_demand_w", namespace)
    if series.runs > 1:
        raise BagError(
            f"{path}: {series.runs} runs with a power demand, a cycle needs exactly one"
        )
    stamp_ns = series.stamp_ns
    samples = Samples(
        str(path),
        np.arange(1, len(stamp_ns) + 1),
        (stamp_ns - stamp_ns[0]).astype(np.float64) * 1e-9,
        series.value,
        place_name="value",
        refused=["" if stamp > 0 else "zero_stamp" for stamp in stamp_ns.tolist()],
    )
    if series.info is not None:
        return _less_announced(samples, aux_w, series.info)
    if aux_w is not None:
        return _less(samples, aux_w, "--aux-w")
    return _less(samples, signals.p_aux_w, "of the signal map")


def _less_announced(samples: Samples, aux_w: float | None, info: RunInfo) -> Samples:
    """Samples without the auxiliaries that their recording announces; no other word counts."""
    if aux_w is not None:
        raise CycleError(
            f"--aux-w: {aux_w:g} W, but {samples.source} announces auxiliaries of "
            f"{info.p_aux_w:g} W; allowed only for a recording that announces none"
        )
    return _less(samples, info.p_aux_w, "announced by the recording")


def _less(samples: Samples, aux_w: float, known_from: str) -> Samples:
    """Samples without a constant auxiliary power."""
    return replace(
        samples,
        power_demand_w=samples.power_demand_w - aux_w,
        auxiliaries=f"{aux_w:g} W removed ({known_from})",
        auxiliaries_removed_w=aux_w,
    )


def demand_messages(path: Path, namespace: str) -> list[PowerDemand]:
    """The demand of one tractor in the order of its reception, refused samples and repeats too.

    The bag has been read once before: it is readable and its topics are the contract's.
    """
    from rosbags.rosbag2 import Reader

    from tractor_ems.bags.read import decode, storage_file

    topic = f"{namespace.rstrip('/')}/{POWER_DEMAND.name}"
    found: list[PowerDemand] = []
    whole = path if (path / "metadata.yaml").is_file() else storage_file(path)
    with Reader(whole) as reader:
        wanted = [c for c in reader.connections if c.topic == topic]
        for _, _, data in reader.messages(connections=wanted):
            sample = decode(POWER_DEMAND.name, bytes(data))
            assert isinstance(sample, PowerDemand)
            found.append(sample)
    return found
