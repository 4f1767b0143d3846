"""Values of stochastic DP, fitted to the demand that is learned from, to begin learning with."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tractor_ems.learning.config import RunOrStandConfig
from tractor_ems.optimal.sdp import cell_of
from tractor_ems.optimal.sdp_fit import SdpSettings, features_of, fit_sdp
from tractor_msgs_py.trajectory import FloatArray, IntArray
from tractor_sim.powertrain import PowertrainParams


@dataclass(frozen=True)
class Table:
    """Cost to come after the decision of a tick.

    Attributes:
        situation: (N,), of every tick.
        times_s: (K,), times left; offset: (S,), SOC errors, evenly spaced.
        value_kg: (K, Z, S, 2), last axis: engine off, on.
        price_kg: of a unit of SOC, as it was solved with.
    """

    situation: IntArray
    times_s: FloatArray
    offset: FloatArray
    value_kg: FloatArray
    price_kg: float

    def values_kg(
        self, tick: IntArray, left_s: FloatArray, error: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Cost to come with the engine on and off before the decision of ticks (B,), at SOC
        errors (B, K) [kg]: that after the decision one tick earlier."""
        k = np.clip(
            np.searchsorted(self.times_s, left_s, side="right") - 1, 0, len(self.times_s) - 1
        )
        then = np.minimum(k + 1, len(self.times_s) - 1)
        gap = np.where(then > k, self.times_s[then] - self.times_s[k], 1.0)
        share = np.clip((left_s - self.times_s[k]) / gap, 0.0, 1.0)[:, None, None]
        x = (error - self.offset[0]) / (self.offset[1] - self.offset[0])
        j = np.clip(x.astype(np.int64), 0, len(self.offset) - 2)
        part = (x - j)[..., None]
        z = self.situation[np.maximum(tick - 1, 0)][:, None]

        def at(time: IntArray) -> FloatArray:
            low = self.value_kg[time[:, None], z, j]
            high = self.value_kg[time[:, None], z, j + 1]
            found: FloatArray = low + part * (high - low)
            return found

        value = at(k)
        value = value + share * (at(then) - value)
        return value[..., 1], value[..., 0]


def make_table(
    params: PowertrainParams,
    config: RunOrStandConfig,
    demands_w: Sequence[FloatArray],
    recorded: int,
) -> Table:
    """Solved on the chain of all demand; the mean demand is that of the first ``recorded``."""
    settings = SdpSettings(
        planned=config.planned,
        end_kg=config.end_kg,
        price=config.price,
    )
    policy = fit_sdp(params, demands_w[:recorded], settings, more_w=demands_w[recorded:])
    traces = features_of(policy.filters, demands_w, params.dt_s)
    situation = np.concatenate([policy.number[cell_of(policy.edges, t)] for t in traces])
    return Table(situation, policy.times_s, policy.offset, policy.value_kg, policy.price_kg)
