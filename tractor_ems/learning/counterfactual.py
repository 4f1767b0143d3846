"""Counterfactual targets: double Q-learning on a post-decision value, without driving.

Demand is exogenous and the plant is known, so one recorded pair of demands (P_k, P_k+1) teaches
the outcome of every action at any SOC and engine state. W(z, SOC' - SOC_target, on') is the cost
to come after a decision that led to SOC' and on'; z is what is known of demand by then. With a
the action at the next tick,

    Q(a) = running cost + start + Phi(SOC') - Phi(SOC'') - baseline(P_k+1) + gamma W(a)
    W   <- Q_target(argmin_a Q_online(a))

The baseline depends on demand only, so it changes no argmin; without it the action-independent
part of the cost, lambda P_dem, drowned the differences between actions and the policy drifted.
"""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from tractor_ems.learning.all_actions import (
    ActionSet,
    CostTable,
    build_cost_table,
    enumerate_actions,
)
from tractor_ems.learning.config import (
    CounterfactualConfig,
    learning_rate,
    step_discount,
    step_target_rate,
)
from tractor_ems.learning.networks import (
    Net,
    Resumable,
    copy_towards,
    to_numpy,
)
from tractor_ems.learning.rewards import RewardConfig, battery_price, running_cost, start_cost
from tractor_ems.learning.samples import DemandSamples
from tractor_ems.policies.mlp import Float32Array, Mlp
from tractor_ems.policies.q_policy import Normalisation, knot_parabola, knot_powers_w, soc_input
from tractor_msgs_py.errors import ConfigError
from tractor_msgs_py.trajectory import FloatArray, IntArray
from tractor_sim.battery import soc_after
from tractor_sim.powertrain import (
    PowertrainParams,
    feasible_battery_power_w,
    initial_state,
    power_limits,
)


@dataclass(frozen=True)
class Problem:
    """What a backup needs besides the networks.

    ``gamma`` is the discount per step; ``baseline`` has one entry per tick of ``samples``
    [cost units].
    """

    params: PowertrainParams
    reward: RewardConfig
    scaling: Normalisation
    gamma: float
    double: bool
    samples: DemandSamples
    table: CostTable
    baseline: FloatArray


def make_problem(
    params: PowertrainParams,
    reward: RewardConfig,
    scaling: Normalisation,
    config: CounterfactualConfig,
    samples: DemandSamples,
    actions: int,
) -> Problem:
    """Tables and baseline for one training run.

    Raises:
        ConfigError: the engine has a ramp limit or minimum times, whose state these targets do
            not carry, or the battery has losses.
    """
    engine = params.engine
    if np.isfinite(engine.ramp_w_per_s) or engine.min_on_s > 0 or engine.min_off_s > 0:
        raise ConfigError(
            f"targets counterfactual: powertrain {params.name} has a ramp limit or minimum on/off "
            "times: use preset field (targets run_or_stand)"
        )
    if not params.battery.lossless:
        raise ConfigError(
            f"targets counterfactual: powertrain {params.name} has a battery with losses, for "
            "which there is preset field (targets run_or_stand)"
        )
    demand_w = samples.power_demand_w
    table = build_cost_table(reward, params, actions, float(demand_w.min()), float(demand_w.max()))
    return Problem(
        params,
        reward,
        scaling,
        step_discount(config, params.dt_s),
        config.double,
        samples,
        table,
        demand_baseline(table, reward, params, demand_w),
    )


def demand_baseline(
    table: CostTable, reward: RewardConfig, params: PowertrainParams, power_demand_w: FloatArray
) -> FloatArray:
    """Best Hamiltonian over engine-on actions at every demand, shape (N,) [cost units].

    Battery energy at the target's price; zero where the engine cannot be on.
    """
    soc = np.full(len(power_demand_w), 0.5)  # cancels: both prices are at the target itself
    unit_w = params.battery.power_max_w
    per_unit = battery_price_at_target(reward, params, np.array([unit_w]))[0] / reward.cost_unit
    price = (per_unit * table.grid_w / unit_w).astype(np.float32)
    best = np.empty(len(power_demand_w))
    for begin in range(0, len(soc), 256):
        part = slice(begin, begin + 256)
        demand_w = power_demand_w[part]
        limit_w = np.full(len(demand_w), unit_w)
        lb = np.maximum(-limit_w, demand_w - table.engine_most_w)
        ub = np.minimum(limit_w, demand_w)
        actions = enumerate_actions(table, reward, params, demand_w, lb, ub)
        best[part] = np.min(actions.running + price, axis=1)
    return np.where(np.isfinite(best), best, 0.0)


def battery_price_at_target(
    reward: RewardConfig, params: PowertrainParams, battery_power_w: FloatArray
) -> FloatArray:
    """Price of a step's battery energy at the target SOC and its price there [kg]."""
    taken = battery_power_w * params.dt_s / params.battery.energy_j
    return battery_price(reward, params, 0.5 * taken, -0.5 * taken, np.zeros_like(taken))


@torch.no_grad()
def backup(
    problem: Problem,
    online: Net,
    target: Net,
    tick: IntArray,
    soc: FloatArray,
    soc_target: FloatArray,
) -> tuple[Float32Array, Float32Array]:
    """Targets of W at B post-decision states: the cost to come from ``tick`` on.

    Args:
        tick: index of the next demand, shape (B,).
        soc, soc_target: SOC after the decision, and the run's target, shape (B,).

    Returns:
        Targets with the engine on and off after the decision, shape (B,) [cost units].
    """
    params, reward = problem.params, problem.reward
    demand_w, inputs = problem.samples.power_demand_w[tick], problem.samples.inputs[tick]
    state = initial_state(params, soc, len(tick))
    limits = power_limits(params, state)
    lb, ub = feasible_battery_power_w(limits, demand_w)
    lb = np.minimum(
        lb, limits.discharge_w
    )  # demand beyond engine and battery: both give their most
    actions = enumerate_actions(problem.table, reward, params, demand_w, lb, ub)
    start = start_cost(reward, params) / reward.cost_unit

    # Online net: what follows an action is a parabola in P_batt, engine off stands apart.
    select = online if problem.double else target
    knots_w = knot_powers_w(lb, ub)
    price, w_on, w_off = _after(problem, select, inputs, soc, soc_target, knots_w)
    unit_w = params.battery.power_max_w
    coefficients = knot_parabola(knots_w, price + problem.gamma * w_on, unit_w)
    q_on, chosen = _best_action(actions, coefficients, unit_w)
    off_cost = float(running_cost(reward, params, np.zeros(1))[0]) / reward.cost_unit
    q_off = np.where(
        actions.off_feasible, off_cost + price[:, 2] + problem.gamma * w_off[:, 2], np.inf
    )

    # Target net: value of the two candidates at exactly the SOC they lead to.
    powers_w = np.stack((actions.power_w(chosen), actions.off_power_w), axis=1)
    price, w_on, w_off = _after(problem, target, inputs, soc, soc_target, powers_w)
    row = np.arange(len(tick))
    value_on = actions.running[row, chosen] + price[:, 0] + problem.gamma * w_on[:, 0]
    value_off = off_cost + price[:, 1] + problem.gamma * w_off[:, 1]
    after_on = np.where(q_off < q_on, value_off, value_on)
    after_off = np.where(q_off < q_on + start, value_off, value_on + start)
    baseline = problem.baseline[tick]
    return (after_on - baseline).astype(np.float32), (after_off - baseline).astype(np.float32)


def _best_action(
    actions: ActionSet, coefficients: FloatArray, unit_w: float
) -> tuple[FloatArray, IntArray]:
    """Least engine-on cost and its index: one product of (B, 3) by (3, actions)."""
    x = actions.grid_w / unit_w
    basis = torch.from_numpy(np.stack((np.ones_like(x), x, x * x)).astype(np.float32))
    c = torch.from_numpy(coefficients.astype(np.float32))
    q = torch.addmm(torch.from_numpy(actions.running), c, basis).numpy()
    index = np.argmin(q, axis=1)
    return q[np.arange(len(q)), index].astype(np.float64), index


def _after(
    problem: Problem,
    net: Net,
    inputs: Float32Array,
    soc: FloatArray,
    soc_target: FloatArray,
    battery_power_w: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Battery price, W_on and W_off after powers of shape (B, K) [cost units]."""
    params, reward = problem.params, problem.reward
    soc, soc_target = soc[:, None], soc_target[:, None]
    soc_next = soc_after(params.battery, soc, battery_power_w, params.dt_s)
    price = battery_price(reward, params, soc, soc_next, soc_target) / reward.cost_unit
    error = soc_input(problem.scaling, soc_next, soc_target)
    knots = battery_power_w.shape[1]
    rows = np.concatenate((np.repeat(inputs, knots, axis=0), error.reshape(-1, 1)), axis=1)
    start = start_cost(reward, params) / reward.cost_unit
    w_on, w_off = values(net, torch.from_numpy(rows), start)
    shape = battery_power_w.shape
    return price, w_on.double().numpy().reshape(shape), w_off.double().numpy().reshape(shape)


def values(net: Net, inputs: Tensor, start_units: float) -> tuple[Tensor, Tensor]:
    """W_on and W_off = W_on + start * sigmoid, shape (B,) each [cost units]."""
    outputs = net(inputs)
    w_on = outputs[:, 0]
    return w_on, w_on + start_units * torch.sigmoid(outputs[:, 1])


class CounterfactualLearner(Resumable):
    """Networks, optimiser and generators of one run; :meth:`update` is one gradient step."""

    def __init__(
        self,
        problem: Problem,
        config: CounterfactualConfig,
        init_rng: np.random.Generator,
        sample_rng: np.random.Generator,
    ) -> None:
        self.problem, self.config = problem, config
        self.rng = sample_rng
        self.step = 0
        self.target_rate = step_target_rate(config, problem.params.dt_s)
        sizes = (problem.samples.inputs.shape[1] + 1, *config.hidden, 2)
        self.online = Net(sizes, config.activation, init_rng)
        self.target = Net(sizes, config.activation, init_rng)
        copy_towards(self.target, self.online, 1.0)
        self.adam = torch.optim.Adam(self.online.parameters(), lr=config.learning_rate, fused=True)

    def update(self) -> dict[str, Tensor]:
        """Draw (bag, time), SOC and target; regress both engine states' values on the backup."""
        problem, config, batch = self.problem, self.config, self.config.batch
        window = (problem.params.battery.soc_min, problem.params.battery.soc_max)
        tick = self.rng.choice(problem.samples.steps, batch)
        soc = self.rng.uniform(*window, batch)
        soc_target = self.rng.uniform(*window, batch)
        y_on, y_off = backup(problem, self.online, self.target, tick + 1, soc, soc_target)

        error = soc_input(problem.scaling, soc, soc_target)
        inputs = np.concatenate((problem.samples.inputs[tick], error[:, None]), axis=1)
        start = start_cost(problem.reward, problem.params) / problem.reward.cost_unit
        w_on, w_off = values(self.online, torch.from_numpy(inputs), start)
        y = torch.from_numpy(np.concatenate((y_on, y_off)))
        w = torch.cat((w_on, w_off))
        loss = (
            torch.nn.functional.huber_loss(w, y)
            if config.loss == "huber"
            else torch.nn.functional.mse_loss(w, y)
        )
        self.adam.param_groups[0]["lr"] = learning_rate(config, self.step)
        self.adam.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]
        self.adam.step()
        copy_towards(self.target, self.online, self.target_rate)
        self.step += 1
        return {"losses/td_loss": loss.detach(), "losses/q_values": -w.detach().mean()}

    def network(self) -> Mlp:
        """The online network, for a policy."""
        return to_numpy(self.online)
