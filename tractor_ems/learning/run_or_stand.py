"""Counterfactual learning of one choice: let the engine run or stand for some seconds.

Demand is exogenous and the plant is known, so a recorded stretch of ``commit`` steps of demand
teaches what running and standing cost over it from any SOC and, because any tick may be followed
by any planned end, with any time left. The network has two outputs,

    V(z, time left, SOC error)  cost to come if the engine runs for ``commit`` steps, then as is
                                best
    G(z, time left, SOC error)  what standing saves against that; > 0: stand

so that V_on = min(V, V - G) and V_off = min(V + start, V - G). The power of a running engine is
the one of least fuel at the price of energy that V's slope over SOC gives. To V belongs a known
part, ``stiffness_kg`` e^2: what ending e away from the target costs where only the battery's
losses stand in the way.

What follows a stretch is worth what stochastic DP says for the first ``table_updates`` updates (in
the presets: for all), then what the network says itself, by double Q-learning.

Why seconds and not steps: one more second of running costs 0.2 g, less than any network's error,
and a policy that compared single steps put off each stop for ever.

Only differences of V over SOC decide anything, so V is fitted to its targets up to a constant per
tick: what the rest of the work burns anyway, which varies far more, never enters the loss.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from tractor_ems.learning.config import RunOrStandConfig, learning_rate
from tractor_ems.learning.networks import (
    Net,
    Resumable,
    copy_towards,
    to_numpy,
)
from tractor_ems.learning.sdp_table import Table, make_table
from tractor_ems.learning.stretches import baseline, reserve, stretches
from tractor_ems.optimal.one_step_kernel import Cell
from tractor_ems.policies.genset import power_max_w, running_fuel_kg_per_s
from tractor_ems.policies.mlp import Float32Array, Mlp
from tractor_ems.policies.q_policy import Normalisation
from tractor_ems.policies.reserve import starts_slowly
from tractor_ems.policies.run_or_stand import (
    SLOPE_STEP,
    SOC_INPUTS,
    Prices,
    prices_of,
    reserve_inputs,
    soc_inputs,
    stiffness_kg,
    time_inputs,
)
from tractor_msgs_py.errors import ConfigError
from tractor_msgs_py.trajectory import BoolArray, FloatArray, IntArray
from tractor_sim.battery import open_circuit_v
from tractor_sim.powertrain import PowertrainParams

FUEL_KNOTS = 4097
"""Engine powers of the fuel table: 67 W apart on `field`."""

MOST_STARTS = 3.0
"""Bound of |G| in starts: beyond it the choice is clear, and its size is of no use."""

LEAST_START_KG = 0.005
"""What a start counts as at least in that bound: G is to be learned where starts are free, too."""


@dataclass(frozen=True)
class Problem:
    """The plant in the form that the compiled stretches need, and the demand to learn from.

    Attributes:
        cell, fuel_kg, engine_max_w, limit_w, ocv_v: battery, fuel per step over bus power, most
            engine power, most battery power, open-circuit voltage at the target.
        prices: see ``policies.run_or_stand``.
        min_off, ramp_w: steps, and power per step, that a restart takes.
        dt_s: step length.
        demand_w: N ticks of demand, traces end to end; inputs: (N, 1 + F), as the network sees
            them; ticks: those after which a whole stretch is left of the same trace.
        must_start, must_run: (N,), where a standing engine must start, a running one go on.
        baseline_kg: (N,), least cost of running at each tick: taken off, it keeps V small.
        commit, horizon: steps of a stretch; farthest time left, 0 without a planned end.
        table: values of stochastic DP on the same demand, to begin with; or None.
    """

    cell: Cell
    fuel_kg: FloatArray
    engine_max_w: float
    limit_w: float
    ocv_v: float
    prices: Prices
    min_off: int
    ramp_w: float
    dt_s: float
    demand_w: FloatArray
    inputs: Float32Array
    ticks: IntArray
    must_start: BoolArray
    must_run: BoolArray
    baseline_kg: FloatArray
    commit: int
    horizon: int
    table: Table | None


def make_problem(
    params: PowertrainParams,
    config: RunOrStandConfig,
    demands_w: Sequence[FloatArray],
    inputs: Float32Array,
    recorded: int,
) -> Problem:
    """The problem of a powertrain and its demand series; ``inputs``: of all of them, end to end;
    the first ``recorded`` of them were recorded, the others made from those.

    Raises:
        ConfigError: no trace is longer than a stretch, or steps are not of a second.
    """
    battery, engine, dt_s = params.battery, params.engine, params.dt_s
    if dt_s != 1.0:  # ``stretches.reserve`` counts steps of a second
        raise ConfigError(f"dt_s: {dt_s:g} with targets run_or_stand, allowed 1")
    commit = max(round(config.commit_s / dt_s), 1)
    ends = np.cumsum([len(d) for d in demands_w])
    begins = np.append(0, ends[:-1])
    ticks = np.concatenate(
        [np.arange(b, max(e - commit, b)) for b, e in zip(begins, ends, strict=True)]
    )
    if not len(ticks):
        raise ConfigError(f"training: no trace is longer than commit_s, {config.commit_s:g} s")
    most_w = power_max_w(params)
    cell = Cell(battery.resistance_ohm, battery.charge_c / dt_s, battery.power_max_w)
    fuel_kg = running_fuel_kg_per_s(params, np.linspace(0.0, most_w, FUEL_KNOTS)) * dt_s
    ocv_v = float(open_circuit_v(battery, np.array([params.soc_initial]))[0])
    prices = prices_of(params, config.price, config.end_kg if config.planned else 0.0)
    demand_w = np.concatenate(demands_w)
    ramp_w = min(engine.ramp_w_per_s * dt_s, engine.power_max_w)
    kept = [reserve(d, battery.power_max_w, ramp_w, starts_slowly(params)) for d in demands_w]
    seen = [reserve_inputs(params, one.peak_w, one.since_s) for one in kept]
    table = None
    if config.table_updates:
        table = make_table(params, config, demands_w, recorded)
        prices = replace(prices, soc_kg=table.price_kg)
    return Problem(
        cell=cell,
        fuel_kg=fuel_kg,
        engine_max_w=most_w,
        limit_w=battery.power_max_w,
        ocv_v=ocv_v,
        prices=prices,
        min_off=round(engine.min_off_s / dt_s),
        ramp_w=min(ramp_w, most_w),
        dt_s=dt_s,
        demand_w=demand_w,
        inputs=np.concatenate((inputs, np.concatenate(seen)), axis=1),
        ticks=ticks,
        must_start=np.concatenate([one.must_start for one in kept]),
        must_run=np.concatenate([one.must_run for one in kept]),
        baseline_kg=baseline(
            cell, fuel_kg, most_w, battery.power_max_w, ocv_v, demand_w, prices.soc_kg
        ),
        commit=commit,
        horizon=round(config.horizon_s / dt_s) if config.planned else 0,
        table=table,
    )


class RunOrStandLearner(Resumable):
    """Networks, optimiser and generator of one run; :meth:`update` is one gradient step."""

    def __init__(
        self,
        problem: Problem,
        config: RunOrStandConfig,
        init_rng: np.random.Generator,
        sample_rng: np.random.Generator,
    ) -> None:
        self.problem, self.config, self.rng = problem, config, sample_rng
        extra = time_inputs(np.zeros(1), config.horizon_s).shape[1] if config.planned else 0
        self.scaling = Normalisation(0.0, 1.0, config.soc_scale)
        sizes = (problem.inputs.shape[1] + extra + SOC_INPUTS, *config.hidden, 2)
        self.online, self.target = Net(sizes, "tanh", init_rng), Net(sizes, "tanh", init_rng)
        copy_towards(self.target, self.online, 1.0)
        self.adam = torch.optim.Adam(self.online.parameters(), lr=config.learning_rate, fused=True)
        self.step = 0
        c, dt_s = config, problem.dt_s
        self.holding = np.array(
            [c.holding_kg_per_s * dt_s, c.wall_kg_per_s * dt_s, c.wall_at, c.most_kg_per_s * dt_s]
        )

    def rows(self, tick: IntArray, left: IntArray, error: FloatArray) -> Float32Array:
        """Network inputs of ticks (B,) with steps left (B,) at SOC errors (B, K), (B K, n)."""
        p, k = self.problem, error.shape[1]
        known = [p.inputs[tick]]
        if p.horizon:
            known.append(time_inputs(p.dt_s * left.astype(np.float64), self.config.horizon_s))
        columns = soc_inputs(self.scaling, error.ravel())
        return np.concatenate((np.repeat(np.concatenate(known, 1), k, axis=0), columns), axis=1)

    @torch.no_grad()
    def values(
        self, net: Net, tick: IntArray, left: IntArray, error: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """V and G [units] at SOC errors (B, K), the known part of V included."""
        rows = torch.from_numpy(self.rows(tick, left, error))
        out = net(rows).double().numpy().reshape(*error.shape, 2)
        return out[..., 0] + self.known(left, error), out[..., 1]

    def known(self, left: IntArray, error: FloatArray) -> FloatArray:
        """The part of V that is known [units]."""
        p = self.problem
        stiff = stiffness_kg(p.prices, p.dt_s * left.astype(np.float64)) / p.prices.unit_kg
        found: FloatArray = stiff[:, None] * error * error
        return found

    def best(
        self, tick: IntArray, left: IntArray, error: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Cost to come of a running and of a standing engine at SOC errors (B, K) [units]: by
        the table at first, then by the averaged network, the online one choosing."""
        p = self.problem
        if p.table is not None and self.step < self.config.table_updates:
            on, off = p.table.values_kg(tick, p.dt_s * left.astype(np.float64), error)
            return on / p.prices.unit_kg, off / p.prices.unit_kg
        start = p.prices.start_kg / p.prices.unit_kg
        v, g = self.values(self.target, tick, left, error)
        choice = self.values(self.online, tick, left, error)[1] if self.config.double else g
        on = np.where((choice > 0.0) & ~p.must_run[tick, None], v - g, v)
        off = np.where((choice > -start) & ~p.must_start[tick, None], v - g, v + start)
        return on, off

    def backup(
        self, tick: IntArray, left: IntArray, error: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Targets of V and G at ticks (B,) with steps left (B,) and SOC errors (B, K) [units]."""
        p, c, prices = self.problem, self.config, self.problem.prices
        b, k = error.shape
        near = (error[..., None] + np.array([-SLOPE_STEP, SLOPE_STEP])).reshape(b, 2 * k)
        on = self.best(tick, left, near)[0].reshape(b, k, 2)
        slope = (on[..., 1] - on[..., 0]) / (2.0 * SLOPE_STEP) * prices.unit_kg
        steps = np.minimum(left, p.commit) if p.horizon else np.full(b, p.commit)
        cost, end, end_on = np.empty((3, b * k, 2))
        gamma = c.gamma**p.dt_s
        stretches(
            p.cell, p.fuel_kg, p.engine_max_w, p.limit_w, p.ocv_v, p.demand_w, p.baseline_kg,
            np.repeat(tick, k), np.repeat(steps, k), error.ravel(), slope.ravel(), prices.soc_kg,
            prices.start_kg, gamma, p.min_off, p.ramp_w, c.short_kg_per_j * p.dt_s, self.holding,
            p.must_start, cost, end, end_on,
        )  # fmt: skip
        after, end = tick + steps, end.reshape(b, 2 * k)
        then_left = left - steps
        on, off = self.best(after, then_left, end)
        then = np.where(end_on.reshape(b, 2 * k) > 0, on, off)
        if p.horizon:
            over = (then_left == 0)[:, None]
            then = np.where(over, self.known(then_left, end), then)
        then *= (gamma**steps)[:, None]
        total = (cost.reshape(b, 2 * k) / prices.unit_kg + then).reshape(b, k, 2)
        most = MOST_STARTS * (max(prices.start_kg, LEAST_START_KG) / prices.unit_kg)
        return total[..., 0], np.clip(total[..., 0] - total[..., 1], -most, most)

    def draw(self) -> tuple[IntArray, IntArray, FloatArray]:
        """Ticks, steps left, and SOC errors for each; see ``RunOrStandConfig``."""
        p, c, rng = self.problem, self.config, self.rng
        b, k = c.batch, c.errors
        tick = rng.choice(p.ticks, b)
        if not p.horizon:
            return tick, np.zeros(b, dtype=np.int64), rng.uniform(-1.0, 1.0, (b, k)) * c.soc_width
        share = rng.random(b)
        far = rng.integers(1, p.horizon + 1, b)
        near = rng.integers(1, max(round(c.near_end_s / p.dt_s), 2), b)
        left = np.where(share < c.near_end, near, far)
        # Far from the target with little time left is where no sound drive gets to.
        width = np.minimum(c.soc_width, 0.05 + c.soc_per_s * left * p.dt_s)
        return tick, left, rng.uniform(-1.0, 1.0, (b, k)) * width[:, None]

    def update(self) -> dict[str, Any]:
        """One gradient step; returns its loss."""
        c = self.config
        tick, left, error = self.draw()
        y_v, y_g = self.backup(tick, left, error)
        y_v -= self.known(left, error)
        rows = self.rows(tick, left, error)
        out = self.online(torch.from_numpy(rows)).reshape(*error.shape, 2)
        miss_v = out[..., 0] - torch.from_numpy(y_v.astype(np.float32))
        miss_g = out[..., 1] - torch.from_numpy(y_g.astype(np.float32))
        # Where it cannot stand nobody asks what standing saves.
        miss_g = miss_g * torch.from_numpy(~self.problem.must_start[tick, None])
        common = miss_v.mean(dim=1, keepdim=True)
        loss = ((miss_v - common) ** 2).mean() + c.gain_weight * (miss_g**2).mean()
        self.adam.param_groups[0]["lr"] = learning_rate(c, self.step)
        self.adam.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]
        self.adam.step()
        copy_towards(self.target, self.online, c.target_rate)
        self.step += 1
        return {
            "losses/td_loss": loss.detach(),
            "losses/gain_loss": (miss_g.detach() ** 2).mean(),
            "losses/q_values": -out[..., 0].detach().mean(),
        }

    def network(self) -> Mlp:
        """The averaged network, for a policy, its G raised by the margin."""
        net = to_numpy(self.target)
        net.biases[-1][1] += np.float32(self.config.margin_kg / self.problem.prices.unit_kg)
        return net
