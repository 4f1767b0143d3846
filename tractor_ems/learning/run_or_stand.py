"""Counterfactual double Q-learning of one choice: let the engine run or stand for some seconds.

Demand is exogenous and the plant is known, so a recorded stretch of ``commit`` seconds of demand
teaches what running and standing cost over it from any SOC. The network has two outputs,

    V(z, SOC error)  cost to come if the engine runs for ``commit`` steps, then as is best
    G(z, SOC error)  what standing saves against that; > 0: stand

so that V_on = min(V, V - G) and V_off = min(V + start, V - G). The power of a running engine is
the one of least fuel at the price of energy that V's slope over SOC gives.

Why seconds and not steps: one more second of running costs 0.2 g, less than any network's error,
and a policy that compared single steps put off each stop for ever.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numba import njit

from tractor_ems.learning.networks import Net, copy_towards
from tractor_ems.optimal.one_step_kernel import (
    BATTERY_SHARE,
    BESIDE_SHARE,
    HOLD_ON_W,
    Cell,
    best_power_w,
    fuel_at,
    parabola,
    soc_change,
)
from tractor_ems.policies.mlp import Float32Array
from tractor_msgs_py.trajectory import FloatArray, IntArray


@dataclass(frozen=True)
class Settings:
    """Settings of one training run.

    Attributes:
        updates, batch, rate, hold, last: of Adam; the rate is held for a share of the updates,
            then lowered along a cosine to ``last`` of it.
        commit: steps that a choice lasts in the targets.
        gamma: discount per step; target_rate: of the averaged net.
        price_kg: of one unit of SOC; start_kg: of a start.
        holding_kg, wall_kg, wall_at, most_kg: holding SOC costs per step, e = SOC - target,
            min(holding e^2 + wall (e / wall_at)^8, most).
        unit_kg: cost that the network sees as 1.
        soc_scale, soc_width: SOC error as input; half width of the errors drawn.
        gain_weight: weight of G's squared error.
        min_off, ramp_w: steps and power per step that a restart takes.
        short_kg_per_j: price of demand left unmet.
        double: choose with the online net, evaluate with the averaged one.
    """

    updates: int = 4000
    batch: int = 256
    rate: float = 2e-3
    hold: float = 0.4
    last: float = 0.01
    commit: int = 8
    gamma: float = 0.998
    target_rate: float = 0.02
    price_kg: float = 8.0
    start_kg: float = 0.015
    holding_kg: float = 0.008
    wall_kg: float = 3e-4
    wall_at: float = 0.07
    most_kg: float = 6e-4
    unit_kg: float = 0.010
    soc_scale: float = 0.05
    soc_width: float = 0.12
    gain_weight: float = 4.0
    hidden: tuple[int, int] = (64, 64)
    double: bool = True
    min_off: int = 5
    ramp_w: float = 56e3
    short_kg_per_j: float = 2e-6


SLOPE_STEP = 0.01
"""Half the distance over which V's slope over SOC is taken."""


@njit(cache=True, error_model="numpy", forceinline=True)
def held_kg(settings: FloatArray, error: float) -> float:
    """Holding cost of one step [kg]; ``settings``: quadratic, wall, its place, most."""
    far = (error / settings[2]) ** 2
    cost = settings[0] * error * error + settings[1] * far * far * far * far
    held: float = min(cost, settings[3])
    return held


@njit(cache=True, error_model="numpy", forceinline=True)
def power_at_price(
    cell: Cell, fuel_kg: FloatArray, engine_max_w: float, ocv_v: float, demand_w: float,
    least_w: float, most_w: float, per_soc_kg: float,
) -> float:  # fmt: skip
    """Engine power of least fuel less SOC gained at a price [W]."""
    low_w, high_w = demand_w - most_w, demand_w - least_w
    y0 = -per_soc_kg * soc_change(cell, ocv_v, low_w)
    y1 = -per_soc_kg * soc_change(cell, ocv_v, 0.5 * (low_w + high_w))
    y2 = -per_soc_kg * soc_change(cell, ocv_v, high_w)
    c0, c1, c2 = parabola(low_w, high_w, cell.unit_w, y0, y1, y2)
    best_w, _ = best_power_w(
        fuel_kg, engine_max_w, demand_w, least_w, most_w, cell.unit_w, c0, c1, c2
    )
    return best_w


@njit(cache=True, error_model="numpy")
def stretches(
    cell: Cell, fuel_kg: FloatArray, engine_max_w: float, limit_w: float, ocv_v: float,
    demand_w: FloatArray, baseline_kg: FloatArray, tick: IntArray, error: FloatArray,
    slope_kg: FloatArray, price_kg: float, start_kg: float, gamma: float, commit: int,
    min_off: int, ramp_w: float, short_kg_per_w: float, holding: FloatArray,
    cost: FloatArray, end: FloatArray, end_on: FloatArray,
) -> None:  # fmt: skip
    """Cost (B, 2) of running and standing from ``tick`` for ``commit`` steps, SOC errors after it,
    and whether the engine runs then; what stands is started where the battery should not carry
    the load alone, as fast as the real engine can. inf: it cannot stand at all."""
    for i in range(len(tick)):
        per_soc = price_kg - slope_kg[i]
        for way in range(2):
            e, on, total, weight = error[i], way == 0, 0.0, 1.0
            ready_w = engine_max_w  # what the engine can give: less after a restart
            for k in range(commit):
                d = demand_w[tick[i] + k]
                if not on and d > BATTERY_SHARE * limit_w:
                    if k == 0:
                        total = np.inf
                        break
                    if k >= min_off:
                        on, total, ready_w = True, total + weight * start_kg, 0.0
                ready_w = min(ready_w + ramp_w, engine_max_w)
                # Demand that a late or slow restart leaves unmet.
                short_w = max(d - limit_w - (ready_w if on else 0.0), 0.0)
                total += weight * short_w * short_kg_per_w
                change, burnt = 0.0, 0.0
                if on:
                    least = max(d - BESIDE_SHARE * limit_w, HOLD_ON_W)
                    most = max(min(ready_w, d + limit_w), HOLD_ON_W)
                    least = min(least, most)
                    engine_w = power_at_price(
                        cell, fuel_kg, engine_max_w, ocv_v, d, least, most, per_soc
                    )
                    burnt = fuel_at(fuel_kg, engine_max_w, engine_w)
                    change = soc_change(cell, ocv_v, min(d - engine_w, limit_w))
                else:
                    change = soc_change(cell, ocv_v, min(max(d, -limit_w), limit_w))
                step = burnt - price_kg * change + held_kg(holding, e)
                total += weight * (step - baseline_kg[tick[i] + k])
                e += change
                weight *= gamma
            cost[i, way], end[i, way], end_on[i, way] = total, e, on


class Learner:
    """Networks, optimiser and generator of one run; :meth:`update` is one gradient step."""

    def __init__(
        self,
        settings: Settings,
        cell: Cell,
        fuel_kg: FloatArray,
        engine_max_w: float,
        limit_w: float,
        ocv_v: float,
        demands_w: Sequence[FloatArray],
        inputs: Sequence[Float32Array],
        seed: int,
    ) -> None:
        s = self.s = settings
        self.cell, self.fuel_kg, self.engine_max_w = cell, fuel_kg, engine_max_w
        self.limit_w, self.ocv_v = limit_w, ocv_v
        self.demand_w = np.concatenate(demands_w)
        self.inputs = np.concatenate(inputs).astype(np.float32)
        ends = np.cumsum([len(d) for d in demands_w])
        late = np.concatenate([np.arange(e - s.commit - 1, e) for e in ends])
        self.ticks = np.setdiff1d(np.arange(len(self.demand_w)), late)
        init, self.rng = (
            np.random.Generator(np.random.PCG64(child))
            for child in np.random.SeedSequence(seed).spawn(2)
        )
        sizes = (self.inputs.shape[1] + 1, *s.hidden, 2)
        self.online, self.target = Net(sizes, "tanh", init), Net(sizes, "tanh", init)
        copy_towards(self.target, self.online, 1.0)
        self.adam = torch.optim.Adam(self.online.parameters(), lr=s.rate, fused=True)
        self.step, self.level = 0, 0.0
        self.holding = np.array([s.holding_kg, s.wall_kg, s.wall_at, s.most_kg])
        self.baseline_kg = baseline(
            cell, fuel_kg, engine_max_w, limit_w, ocv_v, self.demand_w, s.price_kg
        )

    @torch.no_grad()
    def values(
        self, net: Net, inputs: Float32Array, error: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """V and G [units] at SOC errors (B, K)."""
        k = error.shape[1]
        column = (error.reshape(-1, 1) / self.s.soc_scale).astype(np.float32)
        rows = np.concatenate((np.repeat(inputs, k, axis=0), column), axis=1)
        out = net(torch.from_numpy(rows)).double().numpy().reshape(*error.shape, 2)
        return out[..., 0], out[..., 1]

    def backup(self, tick: IntArray, error: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Targets of V and G at ``tick`` [units]."""
        s = self.s
        near = error[:, None] + np.array([-SLOPE_STEP, SLOPE_STEP])
        v, g = self.values(self.target, self.inputs[tick], near)
        on = np.minimum(v, v - g)
        slope = (on[:, 1] - on[:, 0]) / (2.0 * SLOPE_STEP) * s.unit_kg
        cost, end, end_on = np.empty((3, len(tick), 2))
        stretches(
            self.cell, self.fuel_kg, self.engine_max_w, self.limit_w, self.ocv_v, self.demand_w,
            self.baseline_kg, tick, error, slope, s.price_kg, s.start_kg, s.gamma, s.commit,
            s.min_off, s.ramp_w, s.short_kg_per_j, self.holding, cost, end, end_on,
        )  # fmt: skip
        start = s.start_kg / s.unit_kg
        after = self.inputs[tick + s.commit]
        v, g = self.values(self.target, after, end)
        choice = self.values(self.online, after, end)[1] if s.double else g
        restart = np.where(end_on > 0, 0.0, start)
        then = np.where(choice > -restart, v - g, v + restart)
        total = cost / s.unit_kg + s.gamma**s.commit * then
        most = 3.0 * start
        return total[:, 0], np.clip(total[:, 0] - total[:, 1], -most, most)

    def update(self) -> float:
        """One gradient step; returns the loss."""
        s = self.s
        tick = self.rng.choice(self.ticks, s.batch)
        error = self.rng.uniform(-s.soc_width, s.soc_width, s.batch)
        y_v, y_g = self.backup(tick, error)
        # Values are kept around 0: a constant in all of them changes no choice.
        self.level += 0.05 * (float(y_v.mean()) - self.level)
        column = (error / s.soc_scale).astype(np.float32)[:, None]
        rows = np.concatenate((self.inputs[tick], column), axis=1)
        out = self.online(torch.from_numpy(rows))
        aim = torch.from_numpy(np.stack((y_v - self.level, y_g), axis=1).astype(np.float32))
        squares = (out - aim) ** 2
        loss = squares[:, 0].mean() + s.gain_weight * squares[:, 1].mean()
        done = min(max(0.0, (self.step / s.updates - s.hold) / (1.0 - s.hold)), 1.0)
        lr = s.rate * (s.last + (1.0 - s.last) * 0.5 * (1.0 + np.cos(np.pi * done)))
        self.adam.param_groups[0]["lr"] = lr
        self.adam.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]
        self.adam.step()
        copy_towards(self.target, self.online, s.target_rate)
        self.step += 1
        return float(loss.detach())

    def weights(self, *, averaged: bool = True) -> tuple[FloatArray, ...]:
        """Weights and biases in turn, for ``closed_loop.drive_choice``."""
        net = self.target if averaged else self.online
        pairs = zip(net.weights, net.biases, strict=True)
        return tuple(
            np.ascontiguousarray(t.detach().numpy().astype(np.float64)) for p in pairs for t in p
        )


def baseline(
    cell: Cell, fuel_kg: FloatArray, engine_max_w: float, limit_w: float, ocv_v: float,
    demand_w: FloatArray, price_kg: float,
) -> FloatArray:  # fmt: skip
    """Least fuel and price of battery energy of a running engine at every demand [kg]."""
    found = np.empty(len(demand_w))
    _baseline(cell, fuel_kg, engine_max_w, limit_w, ocv_v, demand_w, price_kg, found)
    return found


@njit(cache=True, error_model="numpy")
def _baseline(
    cell: Cell, fuel_kg: FloatArray, engine_max_w: float, limit_w: float, ocv_v: float,
    demand_w: FloatArray, price_kg: float, found: FloatArray,
) -> None:  # fmt: skip
    for i in range(len(demand_w)):
        d = demand_w[i]
        most = max(min(engine_max_w, d + limit_w), HOLD_ON_W)
        least = min(max(d - BESIDE_SHARE * limit_w, HOLD_ON_W), most)
        engine_w = power_at_price(cell, fuel_kg, engine_max_w, ocv_v, d, least, most, price_kg)
        change = soc_change(cell, ocv_v, d - engine_w)
        found[i] = fuel_at(fuel_kg, engine_max_w, engine_w) - price_kg * change
