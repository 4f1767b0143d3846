"""How fast the tabular agents learn at the paper's size, and what memory they take; a report.

python test/learning/benchmark_tabular.py [episodes]
"""

import resource
import sys
import time
from pathlib import Path

import numpy as np

from tractor_ems.learning.mdp import make_mdp
from tractor_ems.learning.rewards import RewardConfig, RewardKind
from tractor_ems.learning.tabular import (
    greedy_episode,
    make_agent,
    pairs_visited,
    sparse_state,
    table_study,
    train_episodes,
)
from tractor_sim.config import load_powertrain
from tractor_sim.duty_cycle.library import load_cycle

MIB = 2**20


def resident_mib() -> float:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / MIB


def report(double: bool, kind: RewardKind, episodes: int, interpolate: bool) -> None:
    params, demand_w = load_powertrain("paper"), load_cycle("planter").power_demand_w
    mdp = make_mdp(
        params,
        demand_w,
        RewardConfig(kind=kind),
        mapping="p_batt_grid",
        actions=1600,
        soc_initial=0.85,
        soc_target=0.836,
    )
    rng = np.random.default_rng(1)
    small = make_agent(mdp, double=double, soc_bins=1, demand_bins=1, interpolate=interpolate)
    train_episodes(small, mdp, np.ones(1), rng, gamma=0.99)  # compiles, or loads
    agent = make_agent(mdp, double=double, interpolate=interpolate)
    parts, rates = 4, []
    schedule = np.linspace(1.0, 0.01, episodes)  # also the share of greedy steps that is timed
    for part in np.array_split(schedule, parts):
        start_s = time.process_time()
        train_episodes(agent, mdp, part, rng, gamma=0.99)
        rates.append(len(part) * len(demand_w) / (time.process_time() - start_s))
    name = f"{'double Q' if double else 'Q':8s} {kind:10s} {'interpolated' * interpolate:12s}"
    quarters = " ".join(f"{rate / 1e3:5.0f}" for rate in rates)
    start_s = time.process_time()
    study = table_study(agent, mdp, rng)
    study_s = time.process_time() - start_s
    state_mib = sum(a.nbytes for a in sparse_state(agent).values()) / MIB
    print(
        f"{name} {quarters} k/s | RSS {resident_mib():5.0f} MiB | visited "
        f"{pairs_visited(agent) / study.pairs:.3f} of all, "
        f"{pairs_visited(agent) / study.pairs_feasible:.3f} of feasible | Pearson "
        f"{study.pearson:+.3f} | state {state_mib:.0f} MiB | study {study_s:.2f} s | greedy fuel "
        f"{greedy_episode(agent, mdp).fuel_kg.sum():.3f} kg"
    )


def main() -> None:
    episodes = int(sys.argv[1]) if len(sys.argv) > 1 else 3000
    print(f"50 x 766 x 1600, {episodes} episodes, epsilon 1 to 0.01, rates by quarter")
    for double in (False, True):
        report(double, "fuel", episodes, interpolate=False)
        report(double, "piecewise", episodes, interpolate=False)
        report(double, "fuel", episodes, interpolate=True)
    peak_mib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(f"peak RSS of all {peak_mib:.0f} MiB")


if __name__ == "__main__":
    main()
