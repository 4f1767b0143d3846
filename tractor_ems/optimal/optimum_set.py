"""The optima of many cycles on all cores, rows in the order they were asked for."""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any, cast

from tractor_ems.evaluate_set import FailedRun, Options, Run, evaluate_all
from tractor_ems.optimal.optimum import find_optimum
from tractor_ems.scenario import Scenario
from tractor_msgs_py.errors import TractorEmsError


@dataclass(frozen=True)
class OptimumRow:
    """One cycle's optimum in figures.

    Attributes:
        cycle, operation, split, powertrain: what was solved.
        soc_initial, soc_target: from where to where.
        fuel_kg: the reference of the score, see ``Optimum.reference_kg``.
        driven_kg: fuel of its run on the real plant, which ends at ``driven_soc_final``.
        starts, stops: of the engine in the optimum.
        certificate: plain data, None where not asked for or not found.
        note: why there is none of all this, else None.
    """

    cycle: str
    operation: str
    split: str | None
    powertrain: str
    soc_initial: float
    soc_target: float
    fuel_kg: float | None = None
    driven_kg: float | None = None
    driven_soc_final: float | None = None
    starts: int | None = None
    stops: int | None = None
    certificate: dict[str, Any] | None = None
    note: str | None = None

    def to_json(self) -> dict[str, Any]:
        """Plain data."""
        return asdict(self)


def find_optima(
    scenarios: Sequence[Scenario],
    *,
    certified: bool,
    jobs: int,
    progress: Callable[[int], None] = lambda done: None,
) -> list[OptimumRow]:
    """Solve every scenario in ``jobs`` processes, >= 1; one that fails is a row that says so.

    Raises:
        KeyboardInterrupt: Ctrl-C; no process is left behind.
    """
    runs = [Run("dp", scenario) for scenario in scenarios]
    make = certified_row if certified else solved_row
    # The pool hands on whatever ``make`` returns; only its own failures are of its own type.
    found = cast(
        list[OptimumRow | FailedRun],
        evaluate_all(runs, Options(), jobs=jobs, progress=progress, make=cast(Any, make)),
    )
    return [
        _empty(row.run.scenario, row.reason) if isinstance(row, FailedRun) else row
        for row in found
    ]


def certified_row(run: Run, options: Options) -> OptimumRow:
    """The optimum with its certificate; whatever it raises is its row."""
    return _row(run.scenario, certified=True)


def solved_row(run: Run, options: Options) -> OptimumRow:
    """The optimum without a certificate; whatever it raises is its row."""
    return _row(run.scenario, certified=False)


def _row(scenario: Scenario, *, certified: bool) -> OptimumRow:
    try:
        optimum = find_optimum(
            scenario.params,
            scenario.power_demand_w,
            scenario.soc_initial,
            scenario.soc_target,
            certified=certified,
        )
    except TractorEmsError as error:
        return _empty(scenario, str(error))
    except Exception as error:
        return _empty(scenario, f"{type(error).__name__}: {error}")
    certificate = optimum.certificate
    empty = _empty(scenario, None)
    return OptimumRow(
        **{
            **empty.to_json(),
            "fuel_kg": optimum.reference_kg,
            "driven_kg": float(optimum.trajectory.fuel_kg.sum()),
            "driven_soc_final": optimum.trajectory.soc_final,
            "starts": optimum.starts,
            "stops": optimum.stops,
            "certificate": None if certificate is None else certificate.to_json(),
        }
    )


def _empty(scenario: Scenario, note: str | None) -> OptimumRow:
    cycle = scenario.cycle
    return OptimumRow(
        cycle=cycle.name,
        operation=cycle.operation,
        split=cycle.split,
        powertrain=scenario.params.name,
        soc_initial=scenario.soc_initial,
        soc_target=scenario.soc_target,
        note=None if note is None else " ".join(note.split()),
    )
