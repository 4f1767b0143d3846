"""The plant as a Gymnasium environment, one at a time or many at once: docs/gymnasium.md.

Importing this registers ``tractor_sim/SeriesHybrid-v0``. Nothing else imports it: Gymnasium is an
optional extra, ``pip install '.[gym]'``.
"""

import gymnasium

from tractor_sim.gym.env import SeriesHybridEnv
from tractor_sim.gym.settings import Settings, make_settings
from tractor_sim.gym.vector_env import SeriesHybridVectorEnv

ENV_ID = "tractor_sim/SeriesHybrid-v0"

__all__ = ["ENV_ID", "SeriesHybridEnv", "SeriesHybridVectorEnv", "Settings", "make_settings"]

if ENV_ID not in gymnasium.registry:  # a second import of a reloaded module would warn
    gymnasium.register(
        id=ENV_ID,
        entry_point="tractor_sim.gym.env:SeriesHybridEnv",
        vector_entry_point="tractor_sim.gym.vector_env:SeriesHybridVectorEnv",
    )
