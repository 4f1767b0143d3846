"""Offline double DQN over "off" and knots of engine power, from recorded transitions alone.

    y = sum_k gamma^k r_{t+k} + gamma^n max_a Q(s_{t+n}, a)     a feasible, chosen by the other net
    loss = (Q(s_t, a_t) - y)^2 + conservative [T lse(Q / T) - Q(s, a_DP)]_feasible + margin

A stop decided second by second is worth 0.2 g, less than any network's error, so returns span
several seconds of what the data did. The conservative term keeps choices to those seen; at full
weight and without the first term it is imitation.
"""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from tractor_ems.learning.config import learning_rate
from tractor_ems.learning.knot_samples import KnotSamples, running_baseline_kg
from tractor_ems.learning.knots_config import KnotsConfig
from tractor_ems.learning.networks import (
    Net,
    Resumable,
    copy_towards,
    to_numpy,
)
from tractor_ems.learning.rewards import RewardConfig, battery_price, start_cost
from tractor_ems.policies.knot_q import OFF, STATE_INPUTS, Feasible, knot_inputs
from tractor_ems.policies.mlp import Float32Array, Mlp
from tractor_ems.policies.q_policy import Normalisation
from tractor_msgs_py.errors import ConfigError
from tractor_msgs_py.trajectory import FloatArray, IntArray
from tractor_sim.powertrain import PowertrainParams

BASELINE_POINTS = 33
"""Knots of the running cost over demand."""

NEAR_END_SHARE = 0.25
"""Of the planned ends that are drawn within the last minutes, where values change fastest."""

NEAR_END_STEPS = 240

REACH_PER_S = 6e-4
"""SOC that a second of running or standing moves, roughly: errors beyond it are not drawn near
the end, where nobody gets."""

LANDING = 0.04
"""Half width of the errors drawn at the end itself."""


@dataclass(frozen=True)
class Returns:
    """n-step returns of B samples, shape (B,) unless said.

    Attributes:
        reward: discounted sum of measured rewards, the terminal one included [reward units].
        discount: of the value of the state after them; 0 where the run had ended.
        tick: that state's tick (any where it had ended).
        error, left_s: its SOC error and time to the planned end [s].
    """

    reward: FloatArray
    discount: FloatArray
    tick: IntArray
    error: FloatArray
    left_s: FloatArray


@dataclass(frozen=True)
class MeasuredCost:
    """What steps cost, apart from what depends on the run's target.

    Attributes:
        step_kg: fuel, start and price of battery energy less the baseline, (N,).
        start_kg: what of this is a start, (N,).
        soc, soc_next, after: see ``KnotSamples``.
    """

    step_kg: FloatArray
    start_kg: FloatArray
    soc: FloatArray
    soc_next: FloatArray
    after: IntArray


def measured_cost(
    samples: KnotSamples, params: PowertrainParams, reward: RewardConfig
) -> MeasuredCost:
    """Equivalent fuel of every recorded step, less the mean of a running engine's at its demand.

    The price of battery energy is taken at the target: what SOC is worth away from it is for the
    terminal cost to say.
    """
    on = samples.action != OFF
    started = on & ~samples.engine_on
    start_kg, burnt_kg = start_cost(reward, params), params.engine.start_fuel_kg
    target = np.zeros(len(samples))
    mean = 0.5 * (samples.soc + samples.soc_next)
    price_kg = battery_price(reward, params, samples.soc - mean, samples.soc_next - mean, target)
    running_kg = samples.cost_kg + price_kg - np.where(started, burnt_kg, 0.0)
    low_w, high_w = np.min(samples.power_demand_w), np.max(samples.power_demand_w)
    points_w = np.linspace(low_w, max(high_w, low_w + 1.0), BASELINE_POINTS)
    base_kg = running_baseline_kg(samples.power_demand_w, running_kg, points_w, on & ~started)
    starts_kg = np.where(started, start_kg, 0.0)
    step_kg = running_kg + starts_kg - base_kg
    return MeasuredCost(step_kg, starts_kg, samples.soc, samples.soc_next, samples.after)


def n_step_returns(
    cost: MeasuredCost,
    config: KnotsConfig,
    unit_kg: float,
    dt_s: float,
    tick: IntArray,
    target: FloatArray,
    left: IntArray,
) -> Returns:
    """Rewards from ``tick`` (B,) on for ``n_step`` steps, or to the planned end ``left`` steps
    away (1 or more, at most the recording's own end where that is nearer than ``n_step``)."""
    gamma = config.gamma**dt_s
    steps, over = np.minimum(left, config.n_step), left <= config.n_step
    if np.any(steps > cost.after[tick] - np.where(over, 0, 1)):
        raise ConfigError("n_step: a return reaches beyond its recording")
    index = np.arange(config.n_step)
    inside = index < steps[:, None]
    place = tick[:, None] + np.where(inside, index, 0)
    error = cost.soc_next[place] - target[:, None]
    wall_kg = config.wall_kg * dt_s * np.minimum(np.abs(error / config.soc_width), 1.2) ** 16
    step_kg = (cost.step_kg[place] + wall_kg) * np.where(inside, gamma**index, 0.0)
    end = tick + steps - 1
    error_end = cost.soc_next[end] - target
    total_kg = step_kg.sum(axis=1) - cost.start_kg[tick]
    final_kg = config.end_kg_per_soc2 * error_end**2
    total_kg = total_kg + np.where(over, gamma**steps * final_kg, 0.0)
    return Returns(
        reward=-total_kg / unit_kg,
        discount=np.where(over, 0.0, gamma**steps),
        tick=np.where(over, tick, end + 1),
        error=error_end,
        left_s=(left - steps) * np.float64(dt_s),
    )


def conservative_gap(q: Tensor, mask: Tensor, action: Tensor, temperature: float) -> Tensor:
    """T log sum_a exp(Q_a / T) over feasible actions less Q of the data's, (B,), >= 0."""
    feasible = torch.where(mask, q, torch.full_like(q, -torch.inf))
    soft = temperature * torch.logsumexp(feasible / temperature, dim=1)
    return soft - q.gather(1, action[:, None])[:, 0]


def margin_excess(q: Tensor, mask: Tensor, action: Tensor, margin: float) -> Tensor:
    """max_a [Q(s, a) + margin d(a, a_DP)] - Q(s, a_DP) over feasible actions, (B,), >= 0; d is
    the distance of two knots as a share of all, and 1 between off and any knot."""
    outputs = q.shape[1]
    index = torch.arange(outputs)
    distance = (index - action[:, None]).abs() / (outputs - 1)
    apart = (index == OFF) != (action[:, None] == OFF)
    distance = torch.where(apart, torch.ones_like(distance), distance)
    raised = torch.where(mask, q + margin * distance, torch.full_like(q, -torch.inf))
    return raised.amax(dim=1) - q.gather(1, action[:, None])[:, 0]


def best_value(chooser: Tensor, judge: Tensor, mask: Tensor) -> Tensor:
    """Value by ``judge`` of the feasible action that ``chooser`` likes best, (B,)."""
    best = torch.where(mask, chooser, torch.full_like(chooser, -torch.inf)).argmax(dim=1)
    return judge.gather(1, best[:, None])[:, 0]


class KnotLearner(Resumable):
    """Networks, optimiser and generator of one run; :meth:`update` is one gradient step."""

    def __init__(
        self,
        samples: KnotSamples,
        params: PowertrainParams,
        reward: RewardConfig,
        scaling: Normalisation,
        config: KnotsConfig,
        init_rng: np.random.Generator,
        sample_rng: np.random.Generator,
    ) -> None:
        self.samples, self.config, self.scaling = samples, config, scaling
        self.dt_s, self.unit_kg = params.dt_s, reward.cost_unit
        self.start_units = start_cost(reward, params) / self.unit_kg
        self.cost = measured_cost(samples, params, reward)
        self.demos = np.flatnonzero(samples.expert & samples.planned)
        if not len(self.demos) and config.demo_share > 0.0:
            raise ConfigError(
                "targets sampled: no recording of DP from first step to last to learn from"
            )
        self.mask = Feasible(samples.off, samples.first, samples.last).mask(config.knots)
        self.rng, self.step = sample_rng, 0
        extra = 1 if config.dueling else 0
        inputs = samples.demand.shape[1] + STATE_INPUTS
        sizes = (inputs, *config.hidden, 1 + config.knots + extra)
        self.online = Net(sizes, config.activation, init_rng)
        self.target = Net(sizes, config.activation, init_rng)
        copy_towards(self.target, self.online, 1.0)
        self.adam = torch.optim.Adam(self.online.parameters(), lr=config.learning_rate, fused=True)

    def draw(self) -> tuple[IntArray, FloatArray, IntArray, int]:
        """Ticks, targets and steps to the planned end of a batch; the first so many of it are
        demonstrations with their own target and end."""
        c, s = self.config, self.samples
        demos = round(c.demo_share * c.batch)
        tick = np.concatenate(
            (
                self.demos[self.rng.integers(0, max(len(self.demos), 1), demos)],
                self.rng.integers(0, len(s), c.batch - demos),
            )
        )
        target, left = s.soc_target[tick].copy(), s.after[tick].copy()
        # A piece of an optimal run is optimal for where it led and when.
        share = self.rng.random((3, demos))
        span = np.where(
            share[1] < NEAR_END_SHARE, np.minimum(left[:demos], NEAR_END_STEPS), left[:demos]
        )
        ends = 1 + (share[2] * span).astype(np.int64)
        other = share[0] < c.hindsight
        left[:demos] = np.where(other, ends, left[:demos])
        reached = s.soc_next[tick[:demos] + left[:demos] - 1]
        target[:demos] = np.where(other, reached, target[:demos])
        if c.relabel:
            rest = slice(demos, None)
            horizon = round(c.horizon_s / self.dt_s)
            share = self.rng.random((3, c.batch - demos))
            near = share[0] < NEAR_END_SHARE
            span = np.where(near, min(NEAR_END_STEPS, horizon), horizon)
            drawn = 1 + (share[1] * span).astype(np.int64)
            short = (s.after[tick[rest]] <= c.n_step) & (drawn > s.after[tick[rest]])
            left[rest] = np.where(short, s.after[tick[rest]], drawn)
            width = np.minimum(c.soc_width, LANDING + REACH_PER_S * left[rest] * self.dt_s)
            target[rest] = s.soc[tick[rest]] - (2.0 * share[2] - 1.0) * width
        return tick, target, left, demos

    def inputs(self, tick: IntArray, error: FloatArray, left_s: FloatArray) -> Float32Array:
        """Network inputs of recorded states under other targets and ends."""
        s = self.samples
        return knot_inputs(
            self.scaling,
            s.demand[tick],
            error,
            left_s,
            self.config.horizon_s,
        )

    def start_from(self, tick: IntArray) -> Tensor:
        """What running costs more than the network says, where the engine is off, (B, 1 + K)."""
        units = np.zeros((len(tick), 1 + self.config.knots), np.float32)
        units[:, 1:] = np.where(self.samples.engine_on[tick], 0.0, self.start_units)[:, None]
        return torch.from_numpy(units)

    def q(self, net: Net, inputs: Float32Array) -> Tensor:
        """Q of every output as if the engine were on."""
        values = net(torch.from_numpy(inputs))
        return values[:, :-1] + VALUE_SCALE * values[:, -1:] if self.config.dueling else values

    @torch.no_grad()
    def aims(self, tick: IntArray, target: FloatArray, left: IntArray) -> Tensor:
        """What Q of the recorded actions should be, (B,)."""
        returns = n_step_returns(
            self.cost, self.config, self.unit_kg, self.dt_s, tick, target, left
        )
        after = self.inputs(returns.tick, returns.error, returns.left_s)
        mask, start = torch.from_numpy(self.mask[returns.tick]), self.start_from(returns.tick)
        value = best_value(
            self.q(self.online, after) - start, self.q(self.target, after) - start, mask
        )
        then = value * torch.from_numpy(returns.discount.astype(np.float32))
        return torch.from_numpy(returns.reward.astype(np.float32)) + then

    def update(self) -> dict[str, float]:
        """One gradient step."""
        c, s = self.config, self.samples
        tick, target, left, demos = self.draw()
        action = torch.from_numpy(s.action[tick])
        q = self.q(
            self.online, self.inputs(tick, s.soc[tick] - target, left * np.float64(self.dt_s))
        )
        loss = torch.zeros(())
        if c.td_weight > 0.0 and demos < c.batch:
            # Demonstrations stay out of it: every one of them lands where it should, so values
            # learned from them would hold landing for free.
            rest = slice(demos, None)
            aim = self.aims(tick[rest], target[rest], left[rest])
            taken = q[rest].gather(1, action[rest, None])[:, 0]
            loss = loss + c.td_weight * torch.nn.functional.huber_loss(taken, aim)
        loss = loss + self._restraint(q, tick, action, demos)
        self.adam.param_groups[0]["lr"] = learning_rate(c, self.step)
        self.adam.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]
        self.adam.step()
        copy_towards(self.target, self.online, c.target_rate)
        self.step += 1
        return {
            "losses/td_loss": float(loss.detach()),
            "losses/q_values": float(q.detach().mean()),
        }

    def _restraint(self, q: Tensor, tick: IntArray, action: Tensor, demos: int) -> Tensor:
        c = self.config
        mask = torch.from_numpy(self.mask[tick])
        # What the reserve rule forbids the policy, though DP did it, is nothing to imitate.
        allowed = mask.gather(1, action[:, None])[:, 0]
        total = torch.zeros(())
        for part, weight in (
            (slice(demos), c.conservative),
            (slice(demos, None), c.conservative_rest),
        ):
            here = allowed[part]
            if weight > 0.0 and bool(here.any()):
                gap = conservative_gap(
                    q[part][here], mask[part][here], action[part][here], c.temperature
                )
                total = total + weight * gap.mean()
        here = allowed[:demos]
        if c.margin > 0.0 and bool(here.any()):
            excess = margin_excess(
                q[:demos][here], mask[:demos][here], action[:demos][here], c.margin
            )
            total = total + excess.mean()
        return total

    def network(self) -> Mlp:
        """A copy of the averaged network for a policy, the state's value folded into every
        output."""
        net = to_numpy(self.target)
        if not self.config.dueling:
            return net
        weight, bias = net.weights[-1], net.biases[-1]
        scale = np.float32(VALUE_SCALE)
        return Mlp(
            (*net.weights[:-1], np.ascontiguousarray(weight[:-1] + scale * weight[-1:])),
            (*net.biases[:-1], np.ascontiguousarray(bias[:-1] + scale * bias[-1:])),
            net.activation,
        )


VALUE_SCALE = 10.0
"""Of the state's value against the advantages: SOC far from its target costs 100 times as much as
a wrong choice."""
