"""Many series hybrids at once on the compiled batch plant; what ``gymnasium.make_vec`` makes."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from tractor_msgs_py.errors import ConfigError
from tractor_msgs_py.trajectory import BoolArray, FloatArray
from tractor_sim.gym.fleet import Fleet
from tractor_sim.gym.observation import bounds
from tractor_sim.gym.settings import make_settings

Observations = NDArray[np.float32]


class SeriesHybridVectorEnv(VectorEnv[Observations, NDArray[np.int64], NDArray[Any]]):
    """``num_envs`` environments; each does what a single one with its seed does.

    An environment whose episode is over starts the next one at the following step, with reward 0
    (autoreset mode ``NEXT_STEP``). Every info has a row per environment.

    Args:
        num_envs: 1 or more.
        threads: that share the plants, 1..64; more than one pays from some thousand environments.
        kwargs: as for one environment.

    Raises:
        ConfigError: unknown keyword, or a value out of range.
        CycleError: no such cycle.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012  (Gymnasium's own form)
        "render_modes": [],
        "autoreset_mode": AutoresetMode.NEXT_STEP,
    }

    def __init__(self, num_envs: int = 1, threads: int = 1, **kwargs: Any) -> None:
        for name, value, most in (("num_envs", num_envs, 1_000_000), ("threads", threads, 64)):
            if not isinstance(value, int) or isinstance(value, bool) or not 1 <= value <= most:
                raise ConfigError(f"SeriesHybrid: {name} {value!r}, allowed 1..{most}")
        settings, params = make_settings(**kwargs)
        self.num_envs = num_envs
        self.single_observation_space = spaces.Box(*bounds(), dtype=np.float32)
        self.single_action_space = spaces.Discrete(settings.count)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.fleet = Fleet(settings, params, num_envs, threads)
        self._generators: list[np.random.Generator] = []
        self._over: BoolArray = np.zeros(num_envs, dtype=bool)

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Observations, dict[str, Any]]:
        """Start an episode everywhere. Environment i is seeded with ``seed + i``, or ``seed[i]``;
        None goes on with the generators there are."""
        if isinstance(seed, int | np.integer):
            super().reset(seed=int(seed))
            seed = [int(seed) + i for i in range(self.num_envs)]
        if seed is None:
            seed = [None] * self.num_envs
        if len(seed) != self.num_envs:
            raise ValueError(f"{len(seed)} seeds, allowed {self.num_envs}")
        if not self._generators:
            self._generators = [seeding.np_random(one)[0] for one in seed]
        for i, one in enumerate(seed):
            if one is not None:
                self._generators[i] = seeding.np_random(one)[0]
            self.fleet.reset(i, self._generators[i], options)
        self._over[:] = False
        return self._look()

    def step(
        self, actions: NDArray[np.int64]
    ) -> tuple[Observations, FloatArray, BoolArray, BoolArray, dict[str, Any]]:
        """Drive one step, or start the next episode where the last step ended one."""
        chosen = np.asarray(actions, dtype=np.int64)
        count = self.fleet.actions.power_w.size
        if chosen.shape != (self.num_envs,) or chosen.min() < 0 or chosen.max() >= count:
            raise ValueError(f"actions {actions!r}, allowed {self.action_space}")
        fresh = np.flatnonzero(self._over)
        reward, over = self.fleet.step(chosen)
        for i in fresh:
            self.fleet.reset(int(i), self._generators[i], None)
        reward[fresh], over[fresh] = 0.0, False
        self._over = over
        seen, info = self._look()
        return seen, reward, np.zeros(self.num_envs, dtype=bool), over.copy(), info

    def _look(self) -> tuple[Observations, dict[str, Any]]:
        seen, info = self.fleet.look()
        present = {f"_{name}": np.ones(self.num_envs, dtype=bool) for name in info}
        return seen, {**info, **present}
