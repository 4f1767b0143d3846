"""Stochastic DP from recordings: what ``ems tune sdp`` does."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tractor_ems.learning.recordings import distinct_demands, read_recordings
from tractor_ems.optimal.sdp_fit import SdpSettings, fit_sdp
from tractor_ems.policies.baselines import tuned_settings
from tractor_ems.policies.envelope import envelope_of
from tractor_ems.policies.sdp import SdpPolicy
from tractor_ems.tuning.squeeze import varied
from tractor_msgs_py import __version__
from tractor_msgs_py.errors import ConfigError
from tractor_msgs_py.provenance import command_line
from tractor_msgs_py.trajectory import FloatArray
from tractor_sim.powertrain import PowertrainParams


def sdp_settings(
    params: PowertrainParams, *, planned: bool, given: Mapping[str, Any] | None = None
) -> SdpSettings:
    """Settings for a powertrain: given ones, else those tuned for it, else the defaults.

    Raises:
        ConfigError: an unknown setting, or one out of range.
    """
    name = "sdp" if planned else "sdp_unplanned"
    chosen = tuned_settings(name, params) if given is None else given
    known = {field.name: field.type for field in dataclasses.fields(SdpSettings)}
    for key, value in chosen.items():
        text = key == "slow"
        if key not in known or key == "planned":
            raise ConfigError(f"{name}.{key}: unknown, allowed {', '.join(sorted(known))}")
        if isinstance(value, str) != text or isinstance(value, bool):
            raise ConfigError(f"{name}.{key}: {value!r}, allowed {'a name' if text else 'number'}")
        if key in ("sweeps", "seed") and not isinstance(value, int):
            raise ConfigError(f"{name}.{key}: {value!r}, allowed a whole number")
    return SdpSettings(planned=planned, **chosen)


def sdp_of_demand(
    params: PowertrainParams,
    demands_w: Sequence[FloatArray],
    settings: SdpSettings,
    progress: Callable[[float], None] = lambda done: None,
) -> SdpPolicy:
    """Fit to demand traces at the bus, and to as many squeezed ones as the settings say.

    Raises:
        ConfigError: no demand, or too short.
    """
    rng = np.random.Generator(np.random.PCG64(settings.seed))
    count = round(settings.varied * len(demands_w))
    more_w = varied(demands_w, params.p_aux_w, count, rng)
    return fit_sdp(params, demands_w, settings, more_w=more_w, progress=progress)


def sdp_of_bags(
    bags: Sequence[Path],
    params: PowertrainParams,
    settings: SdpSettings | None = None,
    *,
    planned: bool = True,
    allow_held_out: bool = False,
    progress: Callable[[float], None] = lambda done: None,
) -> SdpPolicy:
    """Fit to the demand of recordings, whoever drove them; the policy's metadata name them.

    Args:
        settings: None: those tuned for the powertrain, ``planned`` or not.

    Raises:
        BagError: a bag cannot be read, steps by another time, is of another powertrain or of a
            held-out cycle.
        ConfigError: the settings are wrong, or the recordings too short.
    """
    chosen = sdp_settings(params, planned=planned) if settings is None else settings
    recordings = read_recordings(bags, (), params, allow_held_out=allow_held_out)
    demands_w = distinct_demands(recordings.traces)
    policy = sdp_of_demand(params, demands_w, chosen, progress)
    battery = params.battery
    metadata = {
        "package_version": __version__,
        "command_line": command_line(),
        "config": dataclasses.asdict(chosen),
        "seed": chosen.seed,
        "bag_hashes": recordings.bag_hashes,
        "cycle_hashes": recordings.cycle_hashes,
        "cycles": recordings.cycles,
        "training": {
            "traces": len(demands_w),
            "steps": sum(map(len, demands_w)),
            "situations": int(policy.number.max()) + 1,
        },
        "envelope": envelope_of(
            policy.spec, demands_w, params.dt_s, (battery.soc_min, battery.soc_max)
        ),
    }
    return dataclasses.replace(policy, metadata=metadata)
