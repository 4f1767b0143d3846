"""How long the solver and the score take, in CPU seconds after compilation; a report, no test.

python test/optimal/benchmark_dp.py
"""

import time
from collections.abc import Callable

from tractor_ems.drive import drive
from tractor_ems.optimal.certificate import certify
from tractor_ems.optimal.dp import solve
from tractor_ems.optimal.rollout import roll_out
from tractor_ems.optimal.score import dp_ratio
from tractor_ems.policies.rules import RuleBased
from tractor_sim.config import load_powertrain
from tractor_sim.duty_cycle.library import load_cycle


def report(label: str, run: Callable[[], object], repeats: int = 3) -> None:
    best_s = float("inf")
    for _ in range(repeats):
        start_s = time.process_time()
        run()
        best_s = min(best_s, time.process_time() - start_s)
    print(f"{label:58s} {best_s:6.3f} s")


def main() -> None:
    params, demand_w = load_powertrain("paper"), load_cycle("planter").power_demand_w
    solve(params, demand_w[:3], 0.85, soc_initial=0.85)  # compiles, or loads what was compiled
    print(f"planter, {len(demand_w)} steps, 0.85 to 0.836")
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


if __name__ == "__main__":
    main()
