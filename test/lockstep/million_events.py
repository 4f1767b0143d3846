"""Any number of random events against both sides of the safety core; a report, and a slow test.

python test/lockstep/million_events.py [events] [seed]

One event is one command, one step of the plant's time, one silence, one observation with the
policy's answer, or one restart. The first violation ends it with its seed.
"""

import math
import sys
import time
from collections import Counter
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from lockstep.safety_events import PlantSide, PolicySide

EPISODE = 400
"""Events until plant, powertrain and settings are drawn anew."""

ODD_W = (math.nan, math.inf, -math.inf, 1e308, -1e308, 1e12, -1e12, 0.0, -0.0, 5e-324)
KINDS = (
    ["good"] * 24
    + ["wild"] * 4
    + ["future", "other_run", "zero_stamp", "fallback_mode", "shutdown_mode", "two_publishers"]
)


def power_w(rng: np.random.Generator, odd: float) -> float:
    """A power, an odd one with probability ``odd`` [W]."""
    if rng.random() < odd:
        return ODD_W[rng.integers(len(ODD_W))]
    return float(rng.uniform(-3e5, 3e5))


def demand_w(rng: np.random.Generator, steps: int) -> np.ndarray:
    """Demand that holds for some steps, now and then beyond what the powertrain can do [W]."""
    levels = rng.uniform(-2e5, 5e5, steps) * rng.choice([1.0, 0.2, 10.0], steps, p=[0.6, 0.3, 0.1])
    return np.repeat(levels, rng.integers(1, 9, steps))[:steps]


def plant_events(rng: np.random.Generator, events: int, totals: Counter[str]) -> int:
    """One plant's episode of at least ``events`` events; returns how many there were."""
    period_s = float(rng.choice([0.1, 0.5, 1.0]))
    side = PlantSide(
        ("paper", "field")[rng.integers(2)],
        demand_w(rng, 150),
        period_s,
        timeout_s=period_s * float(rng.choice([0.7, 1.5, 2.0, 3.3])),
        recover=int(rng.choice([1, 1, 2, 3])),
        ramp_w_per_s=float(rng.choice([0.0, 2e4, 6e4, 2e5])),
    )
    done = 1
    while done < events:
        draw = rng.random()
        if draw < 0.45:
            late_s = 0.0 if rng.random() < 0.9 else float(rng.uniform(0.0, 5.0)) * period_s
            side.tick(late_s, publishers=1 if rng.random() < 0.97 else 2)
        elif draw < 0.995:
            kind = KINDS[rng.integers(len(KINDS))]
            back = int(rng.choice([0, 1, 2, 5], p=[0.7, 0.15, 0.1, 0.05]))
            repeats = 1 if rng.random() < 0.99 else 40
            for _ in range(repeats):
                odd = 0.5 if kind == "wild" else 0.0
                engine_w = ODD_W[rng.integers(len(ODD_W))] if kind == "wild" else math.nan
                engine_w = 0.0 if rng.random() < 0.2 else engine_w
                side.say(kind, power_w(rng, odd), engine_w, back)
            done += repeats - 1
            side.now_s += float(rng.uniform(-1e-9, 0.2 * period_s))
        else:
            side.restart()
        done += 1
    totals.update({f"plant {name}": count for name, count in side.counts.items()})
    return done


def policy_events(rng: np.random.Generator, events: int, totals: Counter[str]) -> int:
    """One policy's episode of ``events`` events: plausible observations with odd ones between."""
    ramp = float(rng.choice([0.0, 2e4, 2e5]))
    side = PolicySide(("paper", "field")[rng.integers(2)], ramp, float(rng.choice([0.1, 1.0])))
    odd = float(rng.choice([0.0, 0.02, 0.3]))
    soc, demands_w = 0.75, demand_w(rng, events)
    for k in range(1, events):
        if rng.random() < 0.03:
            side.silence(int(rng.integers(1, 5)))
            continue
        soc = float(np.clip(soc + rng.normal(0.0, 0.003), 0.0, 1.0))
        values = {
            "power_demand_w": float(demands_w[k]),
            "soc": soc,
            "time_in_state_s": float(rng.uniform(0.0, 60.0)),
            "engine_power_w": max(float(rng.uniform(-1e5, 275e3)), 0.0),
            "charge_limit_w": math.inf if rng.random() < 0.3 else float(rng.uniform(0.0, 2e5)),
            "discharge_limit_w": float(rng.choice([0.0, 1e5, math.inf])),
            "engine_limit_w": math.inf if rng.random() < 0.3 else float(rng.uniform(0.0, 3e5)),
        }
        for name in values:
            if rng.random() < odd:
                values[name] = ODD_W[rng.integers(len(ODD_W))]
        if rng.random() < odd:
            values["soc"] = float(rng.choice([75.0, 0.2, 1.0, 0.0]))
        engine_w = 0.0 if rng.random() < 0.2 else ODD_W[rng.integers(len(ODD_W))]
        side.observe(values, power_w(rng, 0.2), engine_w)
    totals.update({f"policy {name}": count for name, count in side.counts.items()})
    return events


def run_events(events: int, seed: int) -> Counter[str]:
    """At least ``events`` events, 60 % on the plant's side; returns what happened.

    Raises AssertionError at the first violation, with the episode's seed in a note.
    """
    totals: Counter[str] = Counter()
    episode = 0
    while totals["events"] < events:
        rng = np.random.Generator(np.random.PCG64([seed, episode]))
        side = plant_events if episode % 5 < 3 else policy_events
        try:
            totals["events"] += side(rng, EPISODE, totals)
        except AssertionError as error:
            raise AssertionError(f"seed {seed}, episode {episode}: {error}") from error
        episode += 1
    totals["episodes"] = episode
    return totals


def main() -> None:
    """Drive the events and print every count."""
    events = int(sys.argv[1]) if len(sys.argv) > 1 else 1_000_000
    seed = int(sys.argv[2]) if len(sys.argv) > 2 else 0
    start_s, start_cpu_s = time.perf_counter(), time.process_time()
    totals = run_events(events, seed)
    clock_s, cpu_s = time.perf_counter() - start_s, time.process_time() - start_cpu_s
    for name, count in sorted(totals.items()):
        print(f"{name:32s}{count:>10d}")
    print(f"no violation in {totals['events']} events, {clock_s:.0f} s, {cpu_s:.0f} s of CPU")


if __name__ == "__main__":
    main()
