"""The run of a sampled training over knots of engine power: bags in, policy file out."""

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tractor_ems.learning.knot_learner import KnotLearner
from tractor_ems.learning.knot_samples import KnotSamples, knot_samples, measured_of
from tractor_ems.learning.recorded import drive_of_trace
from tractor_ems.learning.samples import observation_spec
from tractor_ems.policies.envelope import envelope_of
from tractor_ems.policies.knot_q import KnotQ
from tractor_ems.policies.knot_q_file import save_knot_q
from tractor_ems.signals.vehicle import sampled_spec
from tractor_msgs_py.errors import ConfigError

if TYPE_CHECKING:
    from tractor_ems.learning.experiment import Experiment, Generators

SOC_SCALE = 0.1
"""SOC error that enters the network as 1."""


class KnotRun:
    """Offline learning from driven recordings; nothing is driven."""

    def __init__(self, experiment: "Experiment", generators: "Generators") -> None:
        config, params = experiment.config, experiment.params
        if config.interact:
            raise ConfigError(
                f"interact: {config.interact} with parametrisation p_eng_knots, allowed 0"
            )
        own, recordings = config.knots, experiment.recordings
        self.experiment = experiment
        self.scaling = replace(experiment.scaling, soc_scale=SOC_SCALE)
        self.spec = observation_spec(
            experiment.scaling, params.dt_s, own.mean_prior_s, *own.low_pass_s
        )
        if recordings.signals is not None:
            self.spec = sampled_spec(recordings.signals, params.dt_s, self.spec.filters)
        by_expert = [(t, True) for t in recordings.dp] + [(t, False) for t in recordings.rule]
        driven = [(t, expert, drive_of_trace(t)) for t, expert in by_expert]
        kept = [(t, expert, drive) for t, expert, drive in driven if drive is not None]
        if not kept:
            raise ConfigError(
                "targets sampled: the bags hold no driven run from its start on to learn from"
                " (demand-only bags serve targets counterfactual and run_or_stand)"
            )
        self.samples: KnotSamples = knot_samples(
            [drive for _, _, drive in kept],
            [expert for _, expert, _ in kept],
            [trace.to_end for trace, _, _ in kept],
            params,
            self.spec,
            self.scaling,
            own.knots,
        )
        self.learner = KnotLearner(
            self.samples,
            params,
            experiment.reward,
            self.scaling,
            own,
            generators.init,
            generators.sample,
        )
        self.summary: dict[str, Any] = {
            "transitions": len(self.samples),
            "dp_transitions": int(np.sum(self.samples.expert)),
        }

    def before_update(self) -> None:
        """Nothing is driven."""

    def save(self, out: Path, metadata: dict[str, Any]) -> None:
        """Write the policy, with the envelope of what it was trained on."""
        experiment, own = self.experiment, self.experiment.config.knots
        params, samples = experiment.params, self.samples
        soc = (float(samples.soc.min()), float(samples.soc.max()))
        envelope = envelope_of(self.spec, experiment.demands_w, params.dt_s, soc)
        policy = KnotQ(
            params=params,
            spec=self.spec,
            net=self.learner.network(),
            scaling=self.scaling,
            horizon_s=own.horizon_s,
            measured=measured_of(self.samples, params, experiment.reward, own.knots),
            start_units=self.learner.start_units,
            metadata={**metadata, "envelope": envelope},
        )
        save_knot_q(out, policy)

    def state(self) -> dict[str, Any]:
        """The learner's."""
        return self.learner.state()

    def restore(self, tensors: dict[str, Any], state: dict[str, Any]) -> None:
        """The learner's."""
        self.learner.restore(tensors, state)
