"""The rows of the study: which agent, which reward, which seeds in its replay."""

from dataclasses import asdict, dataclass
from typing import Any, Literal

from tractor_ems.learning.mdp import ActionMapping
from tractor_ems.learning.rewards import RewardKind

Algorithm = Literal["q", "double_q", "dqn", "ddqn"]
SeedingKind = Literal["none", "dp", "mixed", "rule"]


@dataclass(frozen=True)
class Row:
    """One agent in one setting; several seeds of it are trained.

    Attributes:
        id: short name, for instance ``ddqn_shaped_dp``.
        label: what tables call it.
        role: ``paper`` re-makes something the paper reports, ``ablation`` asks a question of ours.
        algorithm: ``q`` and ``double_q`` are tables, ``dqn`` and ``ddqn`` networks.
        reward: of ``learning.rewards``.
        soc_min: lower SOC limit of the plant.
        mapping, actions: what an action means, and how many there are.
        soc_bins: bins of the SOC that the agent sees; None: continuous. The plant's SOC is always
            continuous.
        interpolate: tables only: look up between the two nearest SOC bins, linearly.
        epsilon_start: exploration of the first episode.
        seeding: whose transitions are in the replay buffer before the first episode.
        replay: ``fifo``: seeds are overwritten in their turn (the paper's); ``kept``: they have
            their own buffer and half of every batch.
        margin: of the ordinal large-margin loss on seeded transitions, 0 for none; needs ``kept``.
        target_every, target_rate: the target network moves by ``target_rate`` every
            ``target_every`` updates; rate 1 is a hard copy.
    """

    id: str
    label: str
    role: Literal["paper", "ablation"]
    algorithm: Algorithm
    reward: RewardKind
    soc_min: float
    mapping: ActionMapping = "p_batt_grid"
    actions: int = 1600
    soc_bins: int | None = None
    interpolate: bool = False
    epsilon_start: float = 1.0
    seeding: SeedingKind = "none"
    replay: Literal["fifo", "kept"] = "fifo"
    margin: float = 0.0
    target_every: int = 1000
    target_rate: float = 1.0

    @property
    def key(self) -> str:
        """Id and SOC_min: one name per row, also as a folder's."""
        return f"{self.id}@{self.soc_min:g}"

    @property
    def tabular(self) -> bool:
        """Learns a table."""
        return self.algorithm in ("q", "double_q")

    def to_json(self) -> dict[str, Any]:
        """Plain data."""
        return asdict(self)
