"""``tractor_sim/SeriesHybrid-v0``: one series hybrid that drives one duty cycle per episode."""

from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from tractor_sim.gym.fleet import Fleet
from tractor_sim.gym.observation import bounds
from tractor_sim.gym.settings import make_settings

Observation = NDArray[np.float32]


class SeriesHybridEnv(gymnasium.Env[Observation, np.int64]):
    """Spaces, reward and infos: docs/gymnasium.md. Keyword arguments: ``Settings``.

    Raises:
        ConfigError: unknown keyword, or a value out of range.
        CycleError: no such cycle.
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012  (Gymnasium's own form)

    def __init__(self, **kwargs: Any) -> None:
        settings, params = make_settings(**kwargs)
        self.fleet = Fleet(settings, params, batch=1)
        self.observation_space = spaces.Box(*bounds(), dtype=np.float32)
        self.action_space = spaces.Discrete(settings.count)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start an episode; ``options`` may name its ``cycle`` and ``soc_initial``."""
        super().reset(seed=seed)
        self.fleet.reset(0, self.np_random, options)
        return self._look()

    def step(self, action: Any) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Drive one step; the end of the cycle is a truncation."""
        if not self.action_space.contains(action):
            raise ValueError(f"action {action!r}, allowed {self.action_space}")
        reward, over = self.fleet.step(np.array([action], dtype=np.int64))
        seen, info = self._look()
        return seen, float(reward[0]), False, bool(over[0]), info

    def _look(self) -> tuple[Observation, dict[str, Any]]:
        seen, info = self.fleet.look()
        return seen[0], {name: column[0] for name, column in info.items()}
