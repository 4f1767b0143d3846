"""Plant steps per second: numpy, compiled, and as vectorised environment; a report, no test.

python test/sim/benchmark_plant.py [seconds per figure]
"""

import os
import sys
import time
from collections.abc import Callable

import numpy as np

from tractor_sim.batch import batch_plant, drive_batch, empty_result, step_batch
from tractor_sim.config import load_powertrain
from tractor_sim.powertrain import Command, PowertrainParams, initial_state, step

BATCH, STEPS, THREADS = 10_000, 50, 2


def report(label: str, run: Callable[[], None], steps: int, budget_s: float) -> None:
    """Million steps per second of the clock, best and middle of the rounds, and per second of
    CPU time, best: on a machine that does other work the clock counts that too."""
    run()
    clock_s, cpu_s, end_s = [], [], time.perf_counter() + budget_s
    while time.perf_counter() < end_s or len(clock_s) < 3:
        start_s, start_cpu_s = time.perf_counter(), time.process_time()
        run()
        clock_s.append(time.perf_counter() - start_s)
        cpu_s.append(time.process_time() - start_cpu_s)
    figures = (min(clock_s), float(np.median(clock_s)), min(cpu_s))
    print(f"  {label:38s}", *(f"{steps / 1e6 / figure:10.4g}" for figure in figures))


def work(params: PowertrainParams) -> tuple[np.ndarray, Command]:
    """Demand and commands without any pattern in time, three in ten of them off: the worst case
    for branch prediction."""
    rng, shape = np.random.default_rng(0), (STEPS, BATCH)
    reach_w = params.battery.power_max_w
    demand_w = rng.uniform(-0.2, 1.0, shape) * params.engine.power_max_w
    engine_w = np.where(rng.random(shape) < 0.3, 0.0, np.nan)
    return demand_w, Command(rng.uniform(-reach_w, reach_w, shape), engine_w)


def plants(name: str, budget_s: float) -> None:
    params = load_powertrain(name)
    demand_w, command = work(params)
    low, high = params.battery.soc_min, params.battery.soc_max
    soc = np.random.default_rng(1).uniform(low, high, BATCH)
    commands = [
        Command(*pair)
        for pair in zip(command.battery_power_w, command.engine_power_w, strict=True)
    ]
    plant, result = batch_plant(params), empty_result(BATCH)

    def in_numpy() -> None:
        state = initial_state(params, soc, BATCH)
        for k in range(STEPS):
            state, _ = step(params, state, demand_w[k], commands[k])

    def in_steps(threads: int) -> None:
        state = initial_state(params, soc, BATCH)
        for k in range(STEPS):
            step_batch(plant, state, demand_w[k], commands[k], result, threads=threads)

    def in_drives(threads: int) -> None:
        state = initial_state(params, soc, BATCH)
        drive_batch(plant, state, demand_w, command, threads=threads)

    print(f"{name}, {BATCH} plants x {STEPS} steps")
    every = BATCH * STEPS
    report("powertrain.step (numpy)", in_numpy, every, budget_s)
    report("step_batch, 1 thread", lambda: in_steps(1), every, budget_s)
    report(f"step_batch, {THREADS} threads", lambda: in_steps(THREADS), every, budget_s)
    report("drive_batch, 1 thread", lambda: in_drives(1), every, budget_s)
    report(f"drive_batch, {THREADS} threads", lambda: in_drives(THREADS), every, budget_s)


def environments(budget_s: float) -> None:
    try:
        import gymnasium

        from tractor_sim.gym import ENV_ID
    except ImportError:
        print("environments: left out, gymnasium is not installed")
        return
    print("SeriesHybrid-v0 on field, 21 actions, observation, mask and infos included")
    for count, threads in ((1, 1), (100, 1), (1000, 1), (10_000, THREADS)):
        env = gymnasium.make_vec(ENV_ID, num_envs=count, threads=threads, cycles="planter")
        env.reset(seed=0)
        actions = [env.action_space.sample() for _ in range(STEPS)]

        def run(env: gymnasium.vector.VectorEnv = env, actions: list = actions) -> None:
            for action in actions:
                env.step(action)

        label = f"{count} environments, {threads} thread{'s' if threads > 1 else ''}"
        report(label, run, count * STEPS, budget_s)


def main() -> None:
    budget_s = float(sys.argv[1]) if len(sys.argv) > 1 else 5.0
    print(f"load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores; million steps per second")
    print(f"  {'':38s} {'best':>10s} {'median':>10s} {'CPU s':>10s}")
    for name in ("field", "paper"):
        plants(name, budget_s)
    environments(budget_s)


if __name__ == "__main__":
    main()
