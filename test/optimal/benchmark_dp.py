"""Error against time of the dynamic programmes, in CPU seconds after compilation; a report, no
test. What it prints stands in docs/benchmarks.md.

python test/optimal/benchmark_dp.py [FIGURE.png]
"""

import resource
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from tractor_ems.drive import drive
from tractor_ems.optimal.certificate import certify
from tractor_ems.optimal.dp import solve
from tractor_ems.optimal.engine_dp import REFINEMENT, solve_engine
from tractor_ems.optimal.rollout import roll_out
from tractor_ems.optimal.score import dp_ratio
from tractor_ems.policies.rules import RuleBased
from tractor_sim.config import load_powertrain
from tractor_sim.duty_cycle.library import load_cycle

T = TypeVar("T")
CYCLES = ("rotary_hoe_2003", "loader_2010", "tandem_disk_1009", "moldboard_plow_2002")
CELLS_KJ = (640, 320, 160, 80, 40, 20)
REFERENCE_KJ = 10


def timed(run: Callable[[], T], repeats: int = 3) -> tuple[float, T]:
    best_s = float("inf")
    for _ in range(repeats):
        start_s = time.process_time()
        found = run()
        best_s = min(best_s, time.process_time() - start_s)
    return best_s, found


def report(label: str, run: Callable[[], object], repeats: int = 3) -> None:
    print(f"{label:58s} {timed(run, repeats)[0]:6.3f} s")


def paper() -> None:
    params, demand_w = load_powertrain("paper"), load_cycle("planter").power_demand_w
    solve(params, demand_w[:3], 0.85, soc_initial=0.85)  # compiles, or loads what was compiled
    print(f"paper: planter, {len(demand_w)} steps, 0.85 to 0.836")
    for points, actions in ((401, 1600), (801, 3199), (201, 101)):
        solution = solve(
            params, demand_w, 0.836, soc_initial=0.85, soc_points=points, actions=actions
        )
        report(
            f"solve, {points} SOC points x {actions} actions",
            lambda n=points, a=actions: solve(
                params, demand_w, 0.836, soc_initial=0.85, soc_points=n, actions=a
            ),
        )
        report("  its roll-out on the plant", lambda s=solution: roll_out(s, params))
    report("certify from 401 x 1600", lambda: certify(params, demand_w, 0.85, 0.836), 1)
    run = drive(RuleBased(params), params, demand_w[None, :], 0.85, 0.85)[0]
    fuel_kg = float(run.fuel_kg.sum())
    report("dp_ratio", lambda: dp_ratio(params, demand_w, 0.85, run.soc_final, fuel_kg))


def field() -> dict[str, list[tuple[float, float]]]:
    """Prints the table; returns (CPU s, relative error) of every cell size by cycle."""
    params = load_powertrain("field")
    certify(params, load_cycle(CYCLES[0]).power_demand_w[:60], 0.55, 0.55)  # compiles
    print("\nfield: half an hour of 1 s steps, 0.55 to 0.55, cells of the first / second pass")
    print("| cycle | cells kJ | CPU s | fuel kg | error | certificate s | dp_ratio s |")
    print("|---|---|---|---|---|---|---|")
    curves: dict[str, list[tuple[float, float]]] = {}
    for name in CYCLES:
        demand_w = load_cycle(name).power_demand_w + params.p_aux_w
        exact = solve_engine(params, demand_w, 0.55, 0.55, cell_j=1e3 * REFERENCE_KJ)
        for cell_kj in CELLS_KJ:
            cpu_s, found = timed(
                lambda d=demand_w, c=cell_kj: solve_engine(params, d, 0.55, 0.55, cell_j=1e3 * c)
            )
            error = found.lower_bound_kg / exact.lower_bound_kg - 1.0
            curves.setdefault(name, []).append((cpu_s, abs(error)))
            more = "| |"
            if cell_kj == 80:
                certificate_s, _ = timed(lambda d=demand_w: certify(params, d, 0.55, 0.55), 1)
                ratio_s, _ = timed(lambda d=demand_w: dp_ratio(params, d, 0.55, 0.55, 9.0), 1)
                more = f"{certificate_s:.2f} | {ratio_s:.2f} |"
            print(
                f"| {name} | {cell_kj} / {cell_kj / REFINEMENT:g} | {cpu_s:.2f} | "
                f"{found.lower_bound_kg:.5f} | {100.0 * error:+.4f} % | {more}",
                flush=True,
            )
    memory_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
    print(f"largest memory of the process {memory_mb:.0f} MB")
    return curves


def plot(path: Path, curves: dict[str, list[tuple[float, float]]]) -> None:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(figsize=(6.0, 3.6), layout="constrained")
    for name, points in curves.items():
        axes.loglog(
            [x for x, _ in points], [max(100.0 * y, 1e-5) for _, y in points], "o-", label=name
        )
    axes.axhline(0.05, color="0.5", linestyle="--", linewidth=1.0)
    axes.text(axes.get_xlim()[0] * 1.1, 0.055, "certificate's limit", color="0.4", fontsize=8)
    axes.set_xticks([0.1, 0.2, 0.5, 1.0, 2.0], ["0.1", "0.2", "0.5", "1", "2"])
    axes.minorticks_off()
    axes.set_xlabel("CPU time of one solution [s]")
    axes.set_ylabel("error of the fuel [%]")
    axes.legend(fontsize=8, frameon=False)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)


def main() -> None:
    paper()
    curves = field()
    if len(sys.argv) > 1:
        plot(Path(sys.argv[1]), curves)


if __name__ == "__main__":
    main()
