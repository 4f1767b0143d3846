"""What the study found and how far it reaches, in sentences computed from its results: the top of
the report. Verdicts come from ``claims``; nothing here knows a result."""

from collections.abc import Iterator, Sequence

from tractor_ems.study.claims import Claim, claims
from tractor_ems.study.names import BASELINE_NAMES, SOC_MINS, soc_min_text
from tractor_ems.study.paper_values import CONVERGENCE, SUMMARY, episodes_text, percent_text
from tractor_ems.study.results import Baseline, Outcome, Run, StudyResults
from tractor_ems.study.speed_claims import SAME_SOC
from tractor_ems.study.verdicts import OPEN, baseline_of, baseline_score, dp_ratio_text, iqm_text
from tractor_sim.fuel import gallons


def what_was_found(results: StudyResults) -> tuple[str, ...]:
    """The five answers that a reader comes for: speed, tables, shaping, seeding, equal SOC."""
    by_id: dict[str, list[Claim]] = {}
    for claim in claims(results):
        by_id.setdefault(claim.id, []).append(claim)

    def said(what: str, name: str) -> str:
        verdicts = [item.verdict for item in by_id[name]]
        if len(verdicts) == 1:
            return f"{what}: **{verdicts[0]}**."
        if len(set(verdicts)) == 1:
            return f"{what}: **{verdicts[0]}** at both SOC_min."
        parts = zip(verdicts, SOC_MINS, strict=True)
        return f"{what}: " + ", ".join(f"**{v}** at {soc_min_text(s)}" for v, s in parts) + "."

    first = by_id["ddqn_faster"][0]
    return (
        f"DDQN converges sooner than DQN: **{first.verdict}**, within this budget and schedule "
        f"({'; '.join(first.evidence.split('; ')[: 2 if first.verdict == OPEN else 1])}).",
        said("Double Q-learning in a table is unsuitable", "double_q_unsuitable")
        + " "
        + said("Q-learning in a table is too", "q_unsuitable")
        + _tables_beside_myopic(results),
        said("Shaping moves the engine into its efficient region", "efficient")
        + " "
        + said("The shaped DDQN is near DP at DP's final SOC", "near_dp"),
        said("DP seeding converges sooner than none", "dp_faster")
        + " "
        + said("DP and rule-based seeding does", "mixed_faster"),
        *_equal_soc_sentences(results),
    )


def _tables_beside_myopic(results: StudyResults) -> str:
    alone = baseline_score(results, "myopic", "fuel", SOC_MINS[0])
    if alone is None:
        return ""
    return (
        f" Looking at the next fuel alone, without learning, already covers "
        f"{percent_text(alone)} of the way from random to the optimum."
    )


def _equal_soc_sentences(results: StudyResults) -> Iterator[str]:
    """Does shaped DDQN beat, at equal final SOC, what does not learn?"""
    for soc_min in SOC_MINS:
        runs = results.of(f"ddqn_shaped@{soc_min:g}")
        values = [r.outcome.dp_ratio for r in runs if r.outcome.dp_ratio is not None]
        if not values:
            continue
        others = {}
        for name in ("best_point", "rule_based", "myopic", "conventional"):
            found = baseline_of(results, name, "piecewise", soc_min)
            if found is not None and found.outcome.dp_ratio is not None:
                others[name] = found.outcome.dp_ratio
        here = sorted(values)[len(values) // 2]
        ahead = [f"{BASELINE_NAMES[n].split(' (')[0]} {r:.4f}" for n, r in others.items()]
        better = sum(ratio >= here for ratio in others.values())
        yield (
            f"At equal final SOC and SOC_min {soc_min_text(soc_min)} the shaped DDQN has "
            f"`dp_ratio` {dp_ratio_text(results, f'ddqn_shaped@{soc_min:g}')} (1 is the optimum); "
            f"{better} of {len(others)} drives that learn nothing do as well or better than its "
            f"median seed ({', '.join(ahead)})."
        )


def budget_caveat(results: StudyResults) -> str:
    """How this budget relates to the paper's: what a number of episodes here can say."""
    deep = [run for run in results.runs if not run.row.tabular]
    low, high = _paper_episodes()
    text = (
        f"**Budget.** A network learns for {episodes_text(results.episodes_deep)} episodes here"
        f"{_updates(deep)}; the paper's agents needed {episodes_text(low)} to "
        f"{episodes_text(high)} episodes"
    )
    if deep:
        steps = len(deep[0].outcome.trajectory.power_demand_w)
        text += f" ({low * steps / 1e6:.0f} to {high * steps / 1e6:.0f} million steps)"
    return text + f". {_schedule(results)} {episodes_caveat(results)}"


def episodes_caveat(results: StudyResults) -> str:
    """What a number of episodes to convergence means."""
    budget = episodes_text(results.episodes_deep)
    return (
        f'"Converged" means within this budget of {budget} episodes and its exploration '
        "schedule, which is tied to the budget: episodes here and in the paper are not "
        "comparable one to one. A censored or shorter number confirms no speed in the paper's "
        "terms; only rows of this study compare with each other."
    )


def _paper_episodes() -> tuple[int, int]:
    printed = [item.episodes for item in CONVERGENCE]
    return min(printed), max(printed)


def _updates(runs: Sequence[Run]) -> str:
    if not runs:
        return ""
    low, high = min(r.updates for r in runs), max(r.updates for r in runs)
    spread = f"{low:,}" if low == high else f"{low:,} to {high:,}"
    return f", with {spread} updates per run"


def _schedule(results: StudyResults) -> str:
    """Epsilon is tied to the budget; its share is in the provenance where the study says so."""
    share = results.provenance.get("epsilon_decay_share")
    if share is None:
        return (
            "Exploration falls over a fixed share of the budget, so a shorter budget explores "
            "less and settles sooner."
        )
    until = episodes_text(share * results.episodes_deep)
    return (
        f"Exploration falls over the first {percent_text(share, 0)} of the budget, until episode "
        f"{until}: a shorter budget explores less and settles sooner."
    )


def soc_min_paragraph(results: StudyResults) -> str:
    """Could SOC_min explain the paper's equal final SOC? From exact DP on the printed reward."""
    printed = {item.id: item for item in SUMMARY}
    plain, shaped = printed["ddqn"].soc_final, printed["ddqn_shaped"].soc_final
    assert plain is not None
    assert shaped is not None
    best = {s: baseline_of(results, "optimum", "piecewise", s) for s in SOC_MINS}
    found = {s: item.outcome for s, item in best.items() if item is not None}
    if len(found) < len(SOC_MINS):
        return ""
    ends = "; ".join(
        f"with SOC_min {soc_min_text(s)} it ends at {percent_text(outcome.soc_final)} with "
        f"{gallons(outcome.fuel_kg):.2f} gal{_myopic_end(results, s)}"
        for s, outcome in found.items()
    )
    text = (
        "**SOC_min and the equal final SOC.** The paper prints no SOC_min. Exact DP on its shaped "
        f"reward as printed: {ends}; the paper's shaped rows have {percent_text(shaped)} and "
        f"{printed['ddqn_shaped'].fuel_gal:.2f} gal. "
    )
    if all(outcome.soc_final - s <= SAME_SOC for s, outcome in found.items()):
        text += (
            f"Its optimum empties the battery to SOC_min, whatever that is. The paper's equal "
            f"final SOC of {percent_text(shaped)} with and without seeding therefore follows "
            f"from the bound if SOC_min is {soc_min_text(shaped)}, for any agent near that "
            f"optimum, and says nothing about charge that an agent learned to hold. The unshaped "
            f"row at {percent_text(plain)} needs a SOC_min of {soc_min_text(plain)} or less, at "
            "which the shaped reward's optimum ends there too: no single bound gives both rows."
        )
    else:
        text += (
            "Its optimum does not end at SOC_min in both cases, so a bound alone does not explain "
            "the equal final SOC."
        )
    return text + _learners_end(results)


def _myopic_end(results: StudyResults, soc_min: float) -> str:
    found: Baseline | None = baseline_of(results, "myopic", "piecewise", soc_min)
    if found is None:
        return ""
    outcome: Outcome = found.outcome
    return (
        f" (myopic greedy: {percent_text(outcome.soc_final)}, {gallons(outcome.fuel_kg):.2f} gal)"
    )


def _learners_end(results: StudyResults) -> str:
    """Where this study's shaped agents end, which need not be their reward's optimum."""
    ends = []
    for soc_min in SOC_MINS:
        runs = results.of(f"ddqn_shaped@{soc_min:g}")
        if runs:
            socs = [run.outcome.soc_final for run in runs]
            ends.append(f"{iqm_text(socs)} at SOC_min {soc_min_text(soc_min)}")
    return f" The shaped DDQN here ends at {', '.join(ends)}." if ends else ""
