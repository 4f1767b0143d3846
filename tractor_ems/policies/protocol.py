"""What every policy is: ``init`` and ``act``, pure and batched; all memory is in the state."""

from typing import Any, Protocol

import numpy as np

from tractor_msgs_py.observation import Observation, ObservationSpec
from tractor_sim.powertrain import Command, PowerLimits, PowertrainParams

ANY_RUN = ObservationSpec()
"""The spec of a policy that needs no filters and runs at any step length."""


class Policy(Protocol):
    """A decision maker. The same object runs in-process and in a node."""

    @property
    def name(self) -> str:
        """What result tables call it."""

    @property
    def spec(self) -> ObservationSpec:
        """What it needs to see."""

    def init(self, batch: int) -> Any:
        """State before the first tick of B runs."""

    def act(self, observation: Observation, state: Any) -> tuple[Command, Any]:
        """The command for every run of the batch, and the next state. Never mutates ``state``."""


class MadePolicy(Policy, Protocol):
    """A policy out of a file: it was made for one powertrain and says from what."""

    @property
    def params(self) -> PowertrainParams:
        """The powertrain it was made for."""

    @property
    def metadata(self) -> dict[str, Any]:
        """Where it came from, as stored in its file."""


def limits_of(observation: Observation) -> PowerLimits:
    """The plant's published present limits as the feasible set's input."""
    batch = observation.soc.shape
    return PowerLimits(
        charge_w=observation.charge_limit_w,
        discharge_w=observation.discharge_limit_w,
        engine_w=observation.engine_limit_w,
        engine_least_w=np.zeros(batch),
        may_be_off=np.ones(batch, dtype=bool),
    )
