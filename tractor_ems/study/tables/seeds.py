"""What seeded the replay buffers, how long it stayed, and what that means at this budget."""

import math

from tractor_ems.study.paper_values import SETTINGS, episodes_of, episodes_text
from tractor_ems.study.results import Run, StudyResults
from tractor_ems.study.tables.measures import row_name, soc_min_text
from tractor_ems.study.tables.quantities import NONE, percent_text
from tractor_ems.study.tables.table import Table

_EXPERTS = {"dp": "DP", "rule_based": "rule base"}

_STAY = {"fifo": "first in, first out", "kept": "kept, half of every batch"}


def seeds_table(results: StudyResults) -> Table:
    """One line per seeded row and expert, from what the runs report."""
    rows, facts = [], dict[str, None]()
    for row in results.rows:
        runs = results.of(row.key)
        if row.seeding == "none" or not runs or not runs[0].seeding:
            continue
        run, fate = runs[0], ("never", "never")
        if row.replay == "fifo":
            from_episode, gone = overwritten(run)
            fate = (episodes_text(from_episode), episodes_text(gone))
            facts.setdefault(_at_this_budget(run, from_episode, gone))
        for expert, part in run.seeding.items():
            available = int(part["available"])
            bags, rest = divmod(available, _transitions(run))
            rows.append(
                (
                    row_name(row.key),
                    soc_min_text(row.soc_min),
                    _EXPERTS.get(expert, expert),
                    NONE if rest else str(bags),
                    f"{available:,}",
                    f"{int(part['distinct']):,}",
                    f"{int(part['seeded']):,}",
                    percent_text(part["share"]),
                    _STAY[row.replay],
                    *fate,
                )
            )
    notes = [
        "Seeds are transitions read from MCAP bags of the experts' drives, by the same reader as "
        "production training uses, and counted anew in the row's own reward and actions. The "
        "experts drove planter cycles of other seeds than the study's own.",
        *facts,
    ]
    if not rows:
        notes.append("No seeded row was run.")
    return Table(
        "seeds",
        "Seeds in the replay",
        f"The paper: a replay of {SETTINGS.replay_size:,}, nearly "
        f"{percent_text(SETTINGS.dp_share_of_replay, 0)} (DP) or "
        f"{percent_text(SETTINGS.mixed_share_of_replay, 0)} (DP + rule base) of it seeded; "
        "whether seeds stay is not printed.",
        (
            "row",
            "SOC_min",
            "expert",
            "bags",
            "transitions in the bags",
            "distinct",
            "seeded",
            "share of the replay",
            "seeds are",
            "overwritten from episode",
            "gone in episode",
        ),
        tuple(rows),
        tuple(notes),
    )


def overwritten(run: Run) -> tuple[int, int]:
    """Episode in which the first seed of a first-in-first-out replay is overwritten, and that in
    which the last one is. Counted in the T - 1 transitions that an episode of T steps stores."""
    seeded = sum(int(part["seeded"]) for part in run.seeding.values())
    capacity = capacity_of(run)
    per_episode = _transitions(run)
    return (capacity - seeded) // per_episode + 1, math.ceil(capacity / per_episode)


def capacity_of(run: Run) -> int:
    """Transitions that the replay holds."""
    part = next(part for part in run.seeding.values() if part["share"] > 0.0)
    return round(int(part["seeded"]) / float(part["share"]))


def _transitions(run: Run) -> int:
    return max(len(run.outcome.trajectory.power_demand_w) - 1, 1)


def _at_this_budget(run: Run, from_episode: int, gone: int) -> str:
    """How much of the training the seeds accompany, here and at the paper's length."""
    share = min(gone / run.episodes, 1.0)
    untouched = min((from_episode - 1) / run.episodes, 1.0)
    text = (
        f"{row_name(run.row.key)}: all seeds are in the replay for {percent_text(untouched, 0)} "
        f"of this budget's {episodes_text(run.episodes)} episodes, some for "
        f"{percent_text(share, 0)}"
    )
    paper = episodes_of(run.row.id)
    if paper is not None:
        text += (
            f"; of the paper's {episodes_text(paper)} episodes the same replay would hold some "
            f"for {percent_text(min(gone / paper, 1.0))}"
        )
    return text + (
        ". A budget this short gives the seeds more weight than the paper's: what they do here "
        "they need not do there."
    )
