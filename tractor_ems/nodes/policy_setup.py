"""From a policy node's parameters to who answers: a policy and how it is watched. No topics."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tractor_ems import handover
from tractor_ems.answer import Answerer, RunCheck
from tractor_ems.decide import DecideConfig
from tractor_ems.drive_report import write_report
from tractor_ems.handover import HandoverConfig
from tractor_ems.policies.envelope import Envelope
from tractor_ems.policies.protocol import Policy
from tractor_ems.shadow_log import ShadowLog, price_of
from tractor_msgs_py.errors import ConfigError
from tractor_sim.powertrain import PowertrainParams

if TYPE_CHECKING:  # signal maps need YAML and its schema, which a simulated run does without
    from tractor_ems.answer_sampled import SampledAnswerer


@dataclass(frozen=True)
class PolicySetup:
    """What a policy node runs.

    Attributes:
        policy: the decision maker.
        powertrain_hash: the powertrain it was made for; None when any will do.
        check_run: raises where the policy must not drive a run.
        params: that powertrain; on a vehicle its limits and plausible values hold.
        envelope: what the policy saw in training; None: not known.
    """

    policy: Policy
    powertrain_hash: str | None = None
    check_run: RunCheck | None = None
    params: PowertrainParams | None = None
    envelope: Envelope | None = None


def handover_of(
    params: PowertrainParams | None, ramp_w_per_s: float, always: bool
) -> HandoverConfig:
    """The hand-over that parameters ask for."""
    if ramp_w_per_s < 0.0:
        own_w_per_s = math.inf if params is None else params.engine.ramp_w_per_s
        ramp_w_per_s = handover.ramp_of(own_w_per_s)
    return HandoverConfig(ramp_w_per_s, always)


def changed(config: DecideConfig, values: Mapping[str, Any]) -> DecideConfig:
    """``config`` with new values of the dynamic parameters among ``values``."""
    if "observation_timeout_s" in values:
        config = replace(config, timeout_s=values["observation_timeout_s"])
    if "ramp_w_per_s" in values:
        always = config.handover.always
        ramped = handover_of(config.params, values["ramp_w_per_s"], always)
        config = replace(config, handover=ramped)
    if "outside_envelope" in values:
        config = replace(config, outside_fallback=values["outside_envelope"] == "fallback")
    if "outside_envelope_s" in values:
        config = replace(config, outside_s=values["outside_envelope_s"])
    return config


def soc_target_of(soc_target: float) -> float | None:
    """The SOC to end at; None, said as -1, where the run, the map or the powertrain says."""
    return None if soc_target < 0.0 else soc_target


def answerer_of(setup: PolicySetup, values: Mapping[str, Any]) -> "Answerer | SampledAnswerer":
    """Who answers.

    Raises:
        TractorEmsError: a signal map that cannot be read or does not fit the policy.
    """
    made_for = None if values["allow_other_powertrain"] else setup.powertrain_hash
    config = DecideConfig(
        values["observation_timeout_s"],
        handover_of(setup.params, values["ramp_w_per_s"], values["ramp_always"]),
        values["shadow"],
        setup.params,
        envelope=setup.envelope,
    )
    outside = {name: value for name, value in values.items() if name.startswith("outside_")}
    answerer = _answerer(setup, changed(config, outside), made_for, values)
    answerer.decider.plan_work(values.get("planned_work_s", 0.0))
    return answerer


def _answerer(
    setup: PolicySetup, config: DecideConfig, made_for: str | None, values: Mapping[str, Any]
) -> "Answerer | SampledAnswerer":
    named, policy, check = values["signals"], setup.policy, setup.check_run
    if not named and policy.spec.mode == "exact":
        target = (
            soc_target_of(values["soc_target"]) if check is None else None
        )  # a checked run is a solved one
        return Answerer(policy, made_for, config.timeout_s, check, config, target)
    if check is not None:
        raise ConfigError(f"parameter signals: {named!r}, {policy.name} drives its own cycle only")
    from tractor_ems.answer_sampled import SampledAnswerer
    from tractor_ems.signals.config import DEFAULT, load_signal_map

    return SampledAnswerer(
        policy,
        load_signal_map(named or DEFAULT),
        config,
        values["dt_s"],
        made_for,
        soc_target=soc_target_of(values["soc_target"]),
        time_scale=values["time_scale"],
        lag_s=values["lag_s"],
    )


@dataclass(frozen=True)
class Paperwork:
    """What a drive leaves behind: a shadow topic, a shadow log, a report; none by default."""

    shadow: bool = False
    log: ShadowLog | None = None
    report: Path | None = None


def papers_of(
    setup: PolicySetup, answerer: "Answerer | SampledAnswerer", values: Mapping[str, Any]
) -> Paperwork:
    """What the parameters ask for; there is a log where there is a shadow or a file for it.

    A report that never ends says so, so that a crash does not look like the drive before it.

    Raises ConfigError where a file cannot be written, two have one name, or no powertrain is
    known.
    """
    path, params, shadow = values["shadow_log"], setup.params, values["shadow"]
    report = Path(values["report"]) if values["report"] else None
    totals = Path(path).with_suffix(".json") if path else None
    if path and Path(path) == totals:
        raise ConfigError(f"parameter shadow_log: {path}, its totals go there; call it .csv")
    if report is not None and report in (totals, Path(path)):
        raise ConfigError(f"parameter report: {report}, shadow_log {path} writes there")
    if report is not None:
        write_report(report, {"ended": False, "policy": setup.policy.name})
    if params is None or not (path or shadow):
        if path:
            raise ConfigError(f"parameter shadow_log: {path}, needs a policy with a powertrain")
        return Paperwork(shadow, None, report)
    about = {
        "policy": values.get("policy_file") or setup.policy.name,
        "powertrain": f"{params.name} {setup.powertrain_hash or ''}".strip(),
        "signals": getattr(getattr(answerer, "signals", None), "origin", "") or "equal stamps",
    }
    price = price_of(params, getattr(setup.policy, "reward", None))
    dt_s = getattr(answerer, "dt_s", params.dt_s)
    log = ShadowLog(params, dt_s, price, Path(path) if path else None, about)
    return Paperwork(shadow, log, report)
