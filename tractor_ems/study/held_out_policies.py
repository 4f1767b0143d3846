"""Every policy of the held-out study by name: rules, tables and learned ones, the optimum."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

from tractor_ems.policies.made import load_made
from tractor_ems.policies.protocol import MadePolicy, Policy
from tractor_ems.policies.registry import make_rule
from tractor_ems.policies.run_or_stand import Prices, RunOrStand, prices_of
from tractor_ems.study.pieces import code_digest, digest_of_file
from tractor_sim.powertrain import PowertrainParams
from tractor_sim.resources import resource_path

DP = "dp"
"""The optimum's own plan, which knows the cycle: no opponent, a check of everything else."""

_CODE = (
    "tractor_ems/drive.py",
    "tractor_ems/safety.py",
    "tractor_ems/policies",
    "tractor_sim",
    "tractor_msgs_py/observation.py",
)


@dataclass(frozen=True)
class Driver:
    """Who drives: a rule by name, or a policy file.

    Attributes:
        name: what tables call it; seed: of its training.
        file: policy file, None for a rule; file_sha256: its content.
    """

    name: str
    seed: int | None = None
    file: Path | None = None
    file_sha256: str = ""

    @property
    def label(self) -> str:
        """A name for its files."""
        return self.name if self.seed is None else f"{self.name}_s{self.seed}"

    @property
    def identity(self) -> list[Any]:
        """What decides its decisions, the settings of tuned rules included."""
        return [self.name, self.seed, self.file_sha256, code_digest(*_CODE), _tuned()]


def _tuned() -> list[str]:
    folder = resource_path("config", "powertrain").parent / "baseline"
    files = [path for path in sorted(folder.glob("*.yaml")) if path.stem != "grid"]
    return [digest_of_file(path) for path in files]


def made_policy(driver: Driver, params: PowertrainParams, *, refit: bool = False) -> Policy:
    """The policy object.

    Args:
        params: the powertrain that it believes to drive.
        refit: a learned policy that was made for another powertrain is given ``params`` as its
            plant, see :func:`refitted`.

    Raises:
        PolicyError: unknown rule, or an unreadable file.
        ConfigError: the settings of a tuned rule cannot be read.
    """
    if driver.file is None:
        return make_rule(driver.name, params)
    policy = load_made(driver.file)
    return refitted(policy, params) if refit else policy


def refitted(policy: MadePolicy, params: PowertrainParams) -> Policy:
    """A learned policy with another plant as its own: limits, fuel and prices are right; what its
    networks learnt stays, in units of the engine's power and the price of SOC.

    Only run-or-stand policies have such units; of others the plant alone is exchanged.
    """
    if not isinstance(policy, RunOrStand):
        return cast(Policy, replace(cast(Any, policy), params=params))
    old, prices, scaling = policy.params, policy.prices, policy.scaling
    power = params.engine.power_max_w / old.engine.power_max_w
    before, now = prices_of(old, 1.0, 0.0), prices_of(params, 1.0, 0.0)
    cost = now.soc_kg / before.soc_kg
    filters = tuple(replace(f, prior_w=power * f.prior_w) for f in policy.spec.filters)
    return replace(
        policy,
        params=params,
        spec=replace(policy.spec, dt_s=params.dt_s, filters=filters),
        prices=Prices(
            soc_kg=cost * prices.soc_kg,
            start_kg=now.start_kg,
            end_kg=cost * prices.end_kg,
            ease_kg_s=now.ease_kg_s,
            unit_kg=cost * prices.unit_kg,
        ),
        scaling=replace(
            scaling,
            demand_offset_w=power * scaling.demand_offset_w,
            demand_scale_w=power * scaling.demand_scale_w,
        ),
    )
