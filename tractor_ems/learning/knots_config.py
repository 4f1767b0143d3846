"""Settings of the sampled learner over knots of engine power; part of ``config.TrainConfig``."""

from typing import Annotated, Literal

from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

Count = Annotated[int, Field(ge=1, le=100_000_000)]
Share = Annotated[float, Field(ge=0.0, le=1.0)]
Weight = Annotated[float, Field(ge=0.0, le=1e6)]
Seconds = Annotated[float, Field(gt=0.0, le=86_400.0)]


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class KnotsConfig:
    """Offline double DQN over "off" and knots of engine power, kept close to the data.

    Attributes:
        knots: of engine power, evenly from 0 to the most the engine can give at the bus.
        updates: gradient steps.
        batch: transitions per step.
        demo_share: of the batch that is drawn from DP's runs, with the target and the end that
            they had; the rest from all runs. The temporal
            difference is taken over the rest alone.
        hindsight: share of those that get, instead, the SOC and the time of a later tick of
            their run as target and end: a piece of an optimal run is optimal for where it led.
        relabel: give the rest other targets and planned ends than they had. Demand, fuel and the
            change of SOC do not depend on them, so the transitions stay true.
        n_step: transitions whose measured rewards make up a return before it bootstraps.
        learning_rate, hold_fraction, final_fraction: of Adam, see ``CounterfactualConfig``.
        gamma: discount per second; 1 is allowed, because the planned end bounds every sum.
        target_rate: share of the online net that the target net takes over per update.
        td_weight: of the temporal difference; 0 leaves imitation alone.
        conservative: weight of log-sum-exp(Q) over the feasible actions less Q of DP's action.
        conservative_rest: the same over the relabelled rest, whoever drove.
        temperature: of that log-sum-exp, > 0 [reward units].
        margin: an action at distance d (share of the outputs) must be worth ``margin * d`` less
            than DP's, off being at distance 1 from all knots [reward units].
        dueling: learn one value for the state and an advantage per action.
        hidden, activation: of the network.
        low_pass_s, mean_prior_s: demand filters that the policy sees.
        horizon_s: planned ends are drawn up to this far away, and seen no farther.
        end_kg_per_soc2: price of the squared SOC error at the planned end.
        soc_width: half width of the SOC errors that targets are drawn for.
        wall_kg: price of a second at the edge of that width; it falls with the 16th power.
    """

    knots: Annotated[int, Field(ge=2, le=512)] = 33
    updates: Count = 6000
    batch: Count = 256
    demo_share: Share = 0.3
    hindsight: Share = 0.7
    relabel: bool = True
    n_step: Annotated[int, Field(ge=1, le=600)] = 20
    learning_rate: Annotated[float, Field(gt=0.0, le=1.0)] = 2e-3
    hold_fraction: Share = 0.5
    final_fraction: Share = 0.02
    gamma: Share = 1.0
    target_rate: Annotated[float, Field(gt=0.0, le=1.0)] = 0.03
    td_weight: Weight = 1.0
    conservative: Weight = 0.3
    conservative_rest: Weight = 0.0
    temperature: Annotated[float, Field(gt=0.0, le=1e3)] = 0.3
    margin: Weight = 0.0
    dueling: bool = True
    hidden: Annotated[
        tuple[Annotated[int, Field(ge=1, le=4096)], ...], Field(min_length=1, max_length=15)
    ] = (64, 64)
    activation: Literal["relu", "tanh"] = "tanh"
    low_pass_s: tuple[Seconds, ...] = (8.0, 30.0, 120.0)
    mean_prior_s: Seconds = 600.0
    horizon_s: Seconds = 2400.0
    end_kg_per_soc2: Weight = 16.0
    soc_width: Annotated[float, Field(gt=0.0, le=1.0)] = 0.25
    wall_kg: Weight = 0.002
