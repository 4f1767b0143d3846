"""What the study shows beside every learner: drives that learn nothing, on the learner's plant
and counted in the learner's reward. ``outcome_of`` judges learners by the same rule.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from tractor_ems.drive import drive
from tractor_ems.learning.rewards import (
    RewardConfig,
    RewardKind,
    battery_price,
    running_cost,
    step_reward,
)
from tractor_ems.optimal.reward_dp import roll_out_reward, solve_reward
from tractor_ems.optimal.score import dp_ratio
from tractor_ems.policies.action_grid import feasible_range
from tractor_ems.policies.dp import solve_policy
from tractor_ems.policies.protocol import ANY_RUN, Policy, limits_of
from tractor_ems.policies.rules import BestPoint, Conventional, RuleBased
from tractor_ems.study.results import Baseline, Outcome
from tractor_msgs_py.errors import TractorEmsError
from tractor_msgs_py.observation import Observation, ObservationSpec
from tractor_msgs_py.trajectory import FloatArray, Trajectory
from tractor_sim.battery import soc_after
from tractor_sim.figures import run_figures
from tractor_sim.generator import to_crank_w
from tractor_sim.powertrain import (
    ROUNDING_W,
    Command,
    PowertrainParams,
    battery_power_grid_w,
    feasible_battery_power_w,
    project,
)

REWARDS: tuple[RewardKind, ...] = ("fuel", "piecewise", "piecewise_corrected")
SOC_MINS = (0.70, 0.836)
SOC_INITIAL, SOC_TARGET = 0.85, 0.836
"""Of every run of the study: the start that the tables imply, and the SOC that DP ends at."""

LOW_POWER_W = 60e3
"""The paper says that without shaping the engine runs below this."""

OPTIMUM_SOC_CELL = 2.5e-4
"""Node spacing of ``optimum``, 166 kJ on "paper". Halving it changes what the roll-out earns by
less than 0.001 %."""

DpRatio = tuple[float | None, str | None]
"""The matched-SOC DP ratio of a drive; None with the reason why there is none."""


def reward_config(kind: RewardKind) -> RewardConfig:
    """A reward as the study uses it: no price per start, which [P_dem, SOC] could not tell."""
    return RewardConfig(kind=kind, start_price_kg=0.0)


def outcome_of(
    trajectory: Trajectory,
    params: PowertrainParams,
    reward: RewardConfig,
    *,
    soc_target: float = SOC_TARGET,
    ratio: DpRatio | None = None,
) -> Outcome:
    """Judge one drive, a learner's or a baseline's.

    Args:
        trajectory: of the whole cycle.
        params: the plant that was driven.
        reward: that ``reward_sum`` counts, from what was applied.
        soc_target: prices battery energy where the reward does.
        ratio: :func:`ratio_of` this drive where it is known already; None computes it, which
            takes a second or two.
    """
    figures = run_figures(trajectory, params)
    crank_w = to_crank_w(params.generator, trajectory.engine_power_w, params.engine.power_max_w)
    on = trajectory.engine_on
    score, note = ratio_of(trajectory, params) if ratio is None else ratio
    return Outcome(
        fuel_kg=figures["fuel_kg"],
        efficiency=figures["efficiency"],
        soc_initial=float(trajectory.soc[0]),
        soc_final=trajectory.soc_final,
        engine_starts=figures["engine_starts"],
        engine_on_s=float(np.count_nonzero(on)) * params.dt_s,
        below_60kw_share=float(np.mean(crank_w[on] < LOW_POWER_W)) if on.any() else None,
        shortfall_j=figures["shortfall_j"],
        reward_sum=reward_sum(trajectory, params, reward, soc_target),
        dp_ratio=score,
        dp_note=note,
        trajectory=trajectory,
    )


def reward_sum(
    trajectory: Trajectory, params: PowertrainParams, reward: RewardConfig, soc_target: float
) -> float:
    """Undiscounted sum of a reward over a drive, in the units a learner sees."""
    on = trajectory.engine_on
    rewards = step_reward(
        reward,
        params,
        fuel_kg=trajectory.fuel_kg,
        engine_power_w=trajectory.engine_power_w,
        engine_on=on,
        engine_started=on & ~np.concatenate(([False], on[:-1])),
        soc=trajectory.soc,
        soc_next=np.append(trajectory.soc[1:], trajectory.soc_final),
        soc_target=np.full(len(trajectory), soc_target),
    )
    return float(rewards.sum()) / reward.cost_unit


def ratio_of(trajectory: Trajectory, params: PowertrainParams) -> DpRatio:
    """The matched-SOC DP ratio of a drive; a reason where there is none, never an exception."""
    shortfall_j = float(trajectory.shortfall_j.sum())
    if shortfall_j > 0.0:
        return None, f"{shortfall_j:.0f} J of demand unmet"
    try:
        ratio = dp_ratio(
            params,
            trajectory.power_demand_w,
            float(trajectory.soc[0]),
            trajectory.soc_final,
            float(trajectory.fuel_kg.sum()),
        )
    except TractorEmsError as error:
        return None, str(error)
    return ratio, None


def make_baselines(
    params_by_soc_min: Mapping[float, PowertrainParams],
    power_demand_w: FloatArray,
    rng: np.random.Generator,
    *,
    rewards: Sequence[RewardKind] = REWARDS,
    soc_initial: float = SOC_INITIAL,
    soc_target: float = SOC_TARGET,
) -> tuple[Baseline, ...]:
    """Every baseline for every SOC_min and reward.

    Args:
        params_by_soc_min: the plants.
        power_demand_w: (T,), demand at the bus, auxiliaries included [W].
        rng: of ``random_feasible``, which draws the same numbers on every plant.
        rewards: that are counted; ``myopic`` and ``optimum`` are one drive each per reward, the
            others one drive per plant.
        soc_initial: of every drive.
        soc_target: where ``dp`` ends, and what prices battery energy.

    Returns:
        By plant, then reward, then ``conventional``, ``dp``, ``rule_based`` (without the SOC
        guard, which the paper does not have and which would rule from SOC_min + 0.01 on),
        ``best_point``, ``random_feasible``, ``myopic``, ``optimum``.
    """
    draws = rng.random(len(power_demand_w))
    baselines = []
    for soc_min, params in params_by_soc_min.items():
        battery = params.battery
        policies: dict[str, Policy] = {
            "conventional": Conventional(),
            "dp": solve_policy(params, power_demand_w, soc_initial, soc_target),
            "rule_based": RuleBased(params, soc_guard=False),
            "best_point": BestPoint(params),
            "random_feasible": RandomFeasible(params, draws),
        }
        shared = {
            name: drive(policy, params, power_demand_w[None, :], soc_initial, soc_target)[0]
            for name, policy in policies.items()
        }
        ratios = {name: ratio_of(run, params) for name, run in shared.items()}
        for kind in rewards:
            reward = reward_config(kind)
            myopic = Myopic(params, reward)
            solution = solve_reward(
                params,
                power_demand_w,
                reward,
                soc_initial=soc_initial,
                soc_target=soc_target,
                soc_points=round((battery.soc_max - battery.soc_min) / OPTIMUM_SOC_CELL) + 1,
            )
            demand = power_demand_w[None, :]
            runs = shared | {
                "myopic": drive(myopic, params, demand, soc_initial, soc_target)[0],
                "optimum": roll_out_reward(solution, params),
            }
            baselines += [
                Baseline(
                    id=name,
                    reward=kind,
                    soc_min=soc_min,
                    outcome=outcome_of(
                        run, params, reward, soc_target=soc_target, ratio=ratios.get(name)
                    ),
                )
                for name, run in runs.items()
            ]
    return tuple(baselines)


@dataclass(frozen=True)
class RandomFeasible:
    """Uniform over the feasible actions of the battery grid, the two ends lb and ub among them.

    Attributes:
        powertrain: whose grid.
        draws: one number in [0, 1) per tick, shape (T,); the state is the tick.
        actions: size of the grid.
    """

    powertrain: PowertrainParams
    draws: FloatArray
    actions: int = 1600
    name: str = "random_feasible"
    spec: ObservationSpec = ANY_RUN

    def init(self, batch: int) -> int:
        """Tick 0."""
        return 0

    def act(self, observation: Observation, state: int) -> tuple[Command, int]:
        """The drawn action of the feasible range."""
        demand_w = observation.power_demand_w
        lb, ub = feasible_battery_power_w(limits_of(observation), demand_w)
        grid_w = battery_power_grid_w(self.powertrain, self.actions)
        first, last = feasible_range(grid_w, lb, ub)
        index = first + (self.draws[state] * (last - first + 1)).astype(np.int64)
        battery_w = project(grid_w[index], lb, ub)
        return _command(battery_w, demand_w), state + 1


@dataclass(frozen=True)
class Myopic:
    """Greedy on the reward of the present step, nothing of the future.

    The best of the grid clipped to [lb, ub]; of equal rewards the least battery power, whichever
    its sign, then the lower one.
    """

    powertrain: PowertrainParams
    reward: RewardConfig
    actions: int = 1600
    name: str = "myopic"
    spec: ObservationSpec = ANY_RUN
    grid_w: FloatArray = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        grid_w = battery_power_grid_w(self.powertrain, self.actions)
        object.__setattr__(self, "grid_w", grid_w)

    def init(self, batch: int) -> None:
        """No memory."""
        return None

    def act(self, observation: Observation, state: None) -> tuple[Command, None]:
        """Search the action grid."""
        params, demand_w = self.powertrain, observation.power_demand_w
        lb, ub = feasible_battery_power_w(limits_of(observation), demand_w)
        candidates_w = project(self.grid_w[None, :], lb[:, None], ub[:, None])
        engine_w = np.maximum(demand_w[:, None] - candidates_w, 0.0)
        engine_w = np.where(engine_w <= ROUNDING_W, 0.0, engine_w)
        soc = observation.soc[:, None]
        after = soc_after(params.battery, soc, candidates_w, params.dt_s)
        target = observation.soc_target[:, None]
        cost = running_cost(self.reward, params, engine_w)
        cost = cost + battery_price(self.reward, params, soc, after, target)
        least = cost <= np.min(cost, axis=1, keepdims=True)
        chosen = np.argmin(np.where(least, np.abs(candidates_w), np.inf), axis=1)
        battery_w = candidates_w[np.arange(len(chosen)), chosen]
        return _command(battery_w, demand_w), state


def _command(battery_power_w: FloatArray, power_demand_w: FloatArray) -> Command:
    return Command(battery_power_w, np.where(battery_power_w >= power_demand_w, 0.0, np.nan))
