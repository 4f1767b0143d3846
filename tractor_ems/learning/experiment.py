"""What a training run is made of: inputs, reward, networks, replay; and the policy it makes."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tractor_ems.learning.augment import augmented
from tractor_ems.learning.config import (
    CounterfactualConfig,
    SampledConfig,
    TrainConfig,
    step_discount,
)
from tractor_ems.learning.dqn import SampledLearner
from tractor_ems.learning.interact import episode, episode_cycles, training_demand_w
from tractor_ems.learning.recorded import Drive, drive_of_trace, replay_transitions
from tractor_ems.learning.recordings import Recordings, distinct_demands
from tractor_ems.learning.replay import (
    Replay,
    Seeding,
    Transitions,
    concatenate,
    distinct_rows,
    draw_seeds,
)
from tractor_ems.learning.rewards import RewardConfig, resolve
from tractor_ems.learning.samples import (
    demand_samples,
    demand_scaling,
    observation_spec,
    servable_demand_w,
)
from tractor_ems.policies.envelope import envelope_of
from tractor_ems.policies.mlp import Mlp
from tractor_ems.policies.q_policy import Normalisation, QPolicy, save_policy
from tractor_ems.policies.run_or_stand import RunOrStand
from tractor_ems.policies.run_or_stand_file import save_run_or_stand
from tractor_ems.signals.vehicle import sampled_spec
from tractor_msgs_py.errors import ConfigError
from tractor_msgs_py.observation import ObservationSpec
from tractor_msgs_py.trajectory import FloatArray
from tractor_sim.powertrain import PowertrainParams

if TYPE_CHECKING:
    from tractor_ems.learning.knot_run import KnotRun


@dataclass(frozen=True)
class Experiment:
    """Everything that is fixed before the first update.

    Attributes:
        config, params: settings and powertrain.
        reward: resolved.
        recordings: what the bags hold.
        demands_w: every demand series to learn from, once each, cut to what can be served.
        episodes: names of the cycles to simulate, in order.
        spec, scaling: what the policy sees, and how it enters the network.
    """

    config: TrainConfig
    params: PowertrainParams
    reward: RewardConfig
    recordings: Recordings
    demands_w: tuple[FloatArray, ...]
    episodes: tuple[str, ...]
    spec: ObservationSpec
    scaling: Normalisation

    def policy(self, net: Mlp, metadata: dict[str, Any] | None = None) -> QPolicy:
        """The policy of a network of one of the two modes that choose among battery powers."""
        mode = self.config.mode
        assert isinstance(mode, CounterfactualConfig | SampledConfig)
        return QPolicy(
            name="ddqn_counterfactual"
            if self.config.targets == "counterfactual"
            else "ddqn_sampled",
            spec=self.spec,
            params=self.params,
            reward=self.reward,
            net=net,
            scaling=self.scaling,
            gamma=step_discount(mode, self.params.dt_s),
            actions=self.config.actions,
            metadata=metadata or {},
        )


@dataclass(frozen=True)
class Generators:
    """One generator per purpose, all from one seed."""

    init: np.random.Generator
    sample: np.random.Generator
    seeding: np.random.Generator
    episodes: np.random.Generator
    explore: np.random.Generator
    augment: np.random.Generator


def make_generators(seed: int) -> Generators:
    """Independent PCG64 streams."""
    children = np.random.SeedSequence(seed).spawn(6)
    return Generators(*(np.random.Generator(np.random.PCG64(child)) for child in children))


def prepare(
    config: TrainConfig,
    params: PowertrainParams,
    recordings: Recordings,
    rng: np.random.Generator,
) -> Experiment:
    """Collect demand, choose the episodes' cycles with ``rng``, fix the observation.

    Raises:
        ConfigError: there is nothing to learn from.
    """
    if not recordings.traces and not config.interact:
        raise ConfigError("training: no bags given and interact is 0, there is nothing to learn")
    episodes = tuple(episode_cycles(config.interact, rng))
    simulated = [training_demand_w(name, params) for name in sorted(set(episodes))]
    recorded = distinct_demands(recordings.traces)
    demands = [servable_demand_w(params, demand_w) for demand_w in (*recorded, *simulated)]
    scaling = demand_scaling(demands)
    own = config.run_or_stand
    spec = (
        observation_spec(scaling, params.dt_s, own.mean_prior_s, *own.low_pass_s)
        if config.targets == "run_or_stand"
        else observation_spec(scaling, params.dt_s, config.mean_prior_s, config.low_pass_s)
    )
    if recordings.signals is not None:  # it will drive a vehicle with such signals
        spec = sampled_spec(recordings.signals, params.dt_s, spec.filters)
    return Experiment(
        config=config,
        params=params,
        reward=resolve(config.reward, params),
        recordings=recordings,
        demands_w=tuple(demands),
        episodes=episodes,
        spec=spec,
        scaling=scaling,
    )


class CounterfactualRun:
    """Counterfactual learning. Simulated episodes add their cycles' demand and nothing else,
    because nothing else of a drive is used."""

    def __init__(self, experiment: Experiment, generators: Generators) -> None:
        # Here and not above, because it imports torch, which sampled runs do without.
        from tractor_ems.learning.counterfactual import CounterfactualLearner, make_problem

        config, params = experiment.config, experiment.params
        samples = demand_samples(
            experiment.demands_w, experiment.spec, experiment.scaling, params.dt_s
        )
        problem = make_problem(
            params,
            experiment.reward,
            experiment.scaling,
            config.counterfactual,
            samples,
            config.actions,
        )
        self.learner = CounterfactualLearner(
            problem, config.counterfactual, generators.init, generators.sample
        )
        self.experiment = experiment
        self.summary: dict[str, Any] = {"demand_ticks": len(samples.power_demand_w)}

    def before_update(self) -> None:
        """Nothing is driven."""

    def save(self, out: Path, metadata: dict[str, Any]) -> None:
        """Write the policy."""
        save_policy(out, self.experiment.policy(self.learner.network(), metadata))

    def state(self) -> dict[str, Any]:
        """The learner's."""
        return self.learner.state()

    def restore(self, tensors: dict[str, Any], state: dict[str, Any]) -> None:
        """The learner's."""
        self.learner.restore(tensors, state)


class RunOrStandRun:
    """Counterfactual learning of running and standing; simulated episodes add demand only."""

    def __init__(self, experiment: Experiment, generators: Generators) -> None:
        from tractor_ems.learning.run_or_stand import RunOrStandLearner, make_problem

        config, params = experiment.config.run_or_stand, experiment.params
        self.experiment = experiment
        made = augmented(
            experiment.demands_w, config.augmentation, params.p_aux_w, generators.augment
        )
        self.demands_w = [*experiment.demands_w, *(servable_demand_w(params, d) for d in made)]
        samples = demand_samples(self.demands_w, experiment.spec, experiment.scaling, params.dt_s)
        problem = make_problem(
            params, config, self.demands_w, samples.inputs, len(experiment.demands_w)
        )
        self.prices = problem.prices
        self.learner = RunOrStandLearner(problem, config, generators.init, generators.sample)
        ticks = sum(len(demand_w) for demand_w in experiment.demands_w)
        self.summary: dict[str, Any] = {
            "demand_ticks": ticks,
            "made_ticks": len(samples.power_demand_w) - ticks,
        }

    def before_update(self) -> None:
        """Nothing is driven."""

    def save(self, out: Path, metadata: dict[str, Any]) -> None:
        """Write the policy, with the envelope of what it was trained on."""
        experiment, config = self.experiment, self.experiment.config.run_or_stand
        params, spec = experiment.params, experiment.spec
        width = config.soc_width
        battery, target = params.battery, params.soc_initial
        soc = (max(target - width, battery.soc_min), min(target + width, battery.soc_max))
        envelope = envelope_of(spec, self.demands_w, params.dt_s, soc)
        policy = RunOrStand(
            params=params,
            spec=spec,
            nets=(self.learner.network(),),
            scaling=replace(experiment.scaling, soc_scale=config.soc_scale),
            prices=self.prices,
            horizon_s=config.horizon_s if config.planned else 0.0,
            metadata={**metadata, "envelope": envelope},
        )
        save_run_or_stand(out, policy)

    def state(self) -> dict[str, Any]:
        """The learner's."""
        return self.learner.state()

    def restore(self, tensors: dict[str, Any], state: dict[str, Any]) -> None:
        """The learner's."""
        self.learner.restore(tensors, state)


class SampledRun:
    """Sampled learning: replay seeded from bags, and episodes driven at evenly spaced updates."""

    def __init__(self, experiment: Experiment, generators: Generators) -> None:
        self.experiment, self.explore, self.done = experiment, generators.explore, 0
        config = experiment.config
        inputs = 3 + len(experiment.spec.filters)
        replay = Replay(config.sampled.replay_capacity, inputs)
        seeds, seeding = seed_transitions(experiment, generators.seeding)
        replay.add(seeds)
        if not len(replay) and not config.interact:
            raise ConfigError(
                "targets sampled: the bags hold no driven run from its start on to seed the replay"
                " from (demand-only bags serve targets counterfactual)"
            )
        self.learner = SampledLearner(
            inputs, config.actions, config.sampled, replay, generators.init, generators.sample
        )
        self.summary = {"seeding": {name: asdict(part) for name, part in seeding.items()}}

    def before_update(self) -> None:
        """Drive the episodes that are due: number i before update i * updates / episodes."""
        experiment = self.experiment
        config, mode = experiment.config, experiment.config.sampled
        total = len(experiment.episodes)
        while self.done < total and self.done * mode.updates <= self.learner.step * total:
            policy = experiment.policy(self.learner.network())
            share = self.done / max(total - 1, 1)
            epsilon = mode.epsilon_start + share * (mode.epsilon_end - mode.epsilon_start)
            driven = episode(policy, experiment.episodes[self.done], epsilon, self.explore)
            self.learner.replay.add(to_replay(experiment, driven, config.actions, mode))
            self.done += 1

    def save(self, out: Path, metadata: dict[str, Any]) -> None:
        """Write the policy."""
        save_policy(out, self.experiment.policy(self.learner.network(), metadata))

    def state(self) -> dict[str, Any]:
        """The learner's, and how far exploration got."""
        explore = self.explore.bit_generator.state
        return {**self.learner.state(), "episodes": self.done, "explore_rng": explore}

    def restore(self, tensors: dict[str, Any], state: dict[str, Any]) -> None:
        """The learner's, and how far exploration got."""
        self.learner.restore(tensors, state)
        self.done = int(state["episodes"])
        self.explore.bit_generator.state = state["explore_rng"]


def begin(
    experiment: Experiment, generators: Generators
) -> "CounterfactualRun | RunOrStandRun | SampledRun | KnotRun":
    """The run of the chosen mode, at step 0."""
    config = experiment.config
    if config.targets == "counterfactual":
        return CounterfactualRun(experiment, generators)
    if config.targets == "run_or_stand":
        return RunOrStandRun(experiment, generators)
    if config.parametrisation == "p_eng_knots":
        from tractor_ems.learning.knot_run import KnotRun

        return KnotRun(experiment, generators)
    return SampledRun(experiment, generators)


def to_replay(
    experiment: Experiment, driven: Drive, actions: int, mode: SampledConfig
) -> Transitions:
    """A driven run as transitions of this experiment."""
    return replay_transitions(
        driven,
        experiment.params,
        experiment.reward,
        experiment.spec,
        experiment.scaling,
        step_discount(mode, experiment.params.dt_s),
        actions,
    )


def seed_transitions(
    experiment: Experiment, rng: np.random.Generator
) -> tuple[Transitions, dict[str, Seeding]]:
    """Distinct transitions of DP and rule-based recordings, shuffled together."""
    config, mode = experiment.config, experiment.config.sampled
    inputs = 3 + len(experiment.spec.filters)

    def of(traces: Sequence[Any]) -> Transitions:
        drives = [drive_of_trace(trace) for trace in traces]
        parts = [to_replay(experiment, d, config.actions, mode) for d in drives if d is not None]
        return concatenate(parts, inputs)

    dp, dp_seeding = draw_seeds(
        of(experiment.recordings.dp), mode.dp_share, mode.replay_capacity, rng
    )
    # A transition that both drove counts once, as DP's.
    both = concatenate([dp, of(experiment.recordings.rule)], inputs)
    fresh = distinct_rows(both)
    rule, rule_seeding = draw_seeds(
        both.take(fresh[fresh >= len(dp)]), mode.rule_share, mode.replay_capacity, rng
    )
    seeds = concatenate([dp, rule], inputs)
    return seeds.take(rng.permutation(len(seeds))), {"dp": dp_seeding, "rule": rule_seeding}
