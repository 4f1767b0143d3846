"""The replication report in Markdown, as a function of the results. Prose explains the method;
every number and every verdict is computed."""

import os
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any
from urllib.parse import quote

from tractor_ems.study.claims import Claim, Verdict, claims
from tractor_ems.study.convergence import FINAL_SHARE, HOLD_SHARE, MIN_SEEDS, REACHED
from tractor_ems.study.figures import FigureFile, write_figures
from tractor_ems.study.figures.style import DPI
from tractor_ems.study.findings import budget_caveat, soc_min_paragraph, what_was_found
from tractor_ems.study.paper_values import episodes_text
from tractor_ems.study.results import StudyResults
from tractor_ems.study.statistics import COVERAGE_5
from tractor_ems.study.tables import Table, build_tables, to_markdown
from tractor_ems.study.tables.cost import OVERLAPPED
from tractor_ems.study.tables.measures import soc_min_text
from tractor_msgs_py.atomic import write_bytes

DP_RATIO_BOUND = 1.0005
"""Largest dp_ratio that the grid of the DP explains; the tests of the score hold it."""

_VERDICTS: Mapping[Verdict, str] = {
    "holds": "hold",
    "does not hold": "do not hold",
    "not resolved": "are not resolved",
    "calibrated": "are calibrated",
}
"""Verdicts, and the same said of several claims."""

_CALIBRATED = """\
**Calibrated, not reproduced.** The paper prints neither its engine map, its battery nor its cycle.
The plant and the cycle used here were chosen so that the paper's conventional and DP rows come
out. Agreement of those rows, and of what follows from them alone, proves nothing."""

_PAPER = """\
Replication of H. Abououf, S. G. Bhatti and Q. Ahmed (The Ohio State University), "Improving
Q-Learning for Real-World Control: A Case Study in Series Hybrid Agricultural Tractors", a
manuscript in the style of the AAAI 2026 conference. Every number, verdict and sentence about a
result below is computed from the runs of this study."""

_METHOD = f"""\
- **Here** is the interquartile mean over seeds with a stratified bootstrap 95 % interval; fewer
  than {MIN_SEEDS} seeds resolve no difference. Of {MIN_SEEDS} normal runs such an interval covers
  the truth in about {100 * COVERAGE_5:.0f} % of cases, not 95 %: a verdict that just passes is
  weaker than it reads.
- **Converged** is the first evaluation from which the running median of the greedy return stays at
  {100 * REACHED:.0f} % of the way from the first evaluation to the final value (median of the last
  {100 * FINAL_SHARE:.0f} % of the evaluations), held for {100 * HOLD_SHARE:.0f} % of them before
  those. The rule was fixed before the results and is the same for every curve. A curve that does
  not is censored: `> N` episodes. A settled curve need not be a good one: "episodes to 95 % of the
  optimum" asks for the exact optimum of the reward instead.
- **`dp_ratio`** is the fuel of a certified DP solution that starts and ends at the run's own SOC
  over the run's fuel. The paper's way of counting, at whatever SOC a drive ends, stands beside it.
  Values a little above 1, up to {DP_RATIO_BOUND}, are the DP's grid error: read them as 1.
- **Way** is where a return lies between random feasible actions (0) and the exact optimum of the
  same reward (100 %). Myopic greedy, which only looks at the next reward, is far along it on some
  rewards; beside it a high number shows no learning.
- **SOC_min** is not printed. The paper's unshaped row ends at 70 % and its shaped rows at 83.6 %;
  either could be the bound, so every shaped row of the paper is run with both.
- **Marks** like (1) stand for the same reason in every table; it is written out where it first
  appears."""

_SECTIONS: Sequence[tuple[str, Sequence[str], Sequence[str]]] = (
    ("The paper's tables", ("table_1", "table_2", "summary_fuel", "summary_efficiency",
                            "summary_episodes", "summary_relative", "seeding",
                            "seeding_episodes"), ()),
    ("Powertrain", (), ("powertrain",)),
    ("Tabular agents", ("tabular",), ("state_visits", "pearson", "tabular", "reward_double_q")),
    ("DQN and DDQN", (), ("reward_dqn", "reward_ddqn", "traces")),
    ("Reward shaping", (), ("reward_ddqn_shaped", "points_conventional", "points_ddqn_shaped")),
    ("Seeding", ("seeds",), ("reward_ddqn_shaped_dp", "reward_ddqn_shaped_mixed",
                     "reward_ddqn_shaped_rule", "convergence")),
    ("What the rewards ask for", ("optimum",), ("optimum",)),
    ("Ablations", ("ablations",), ("ablations",)),
    ("Differences from the paper", ("differences",), ()),
    ("Slips of the paper", ("slips",), ()),
    ("Cost", ("cost", "speed"), ()),
)  # fmt: skip
"""Section, its tables, its figures. Tables and figures that are not named follow at the end."""


def write_report(
    results: StudyResults, out_md: Path, figures_folder: Path, dpi: int = DPI
) -> None:
    """Write the figures, then the report that links them; each file is whole or absent.

    Args:
        out_md: the Markdown file; links are relative to its folder.
        figures_folder: for PNG and SVG.
        dpi: of the PNG.

    Raises:
        ConfigError: a folder cannot be written to, or a result is not finite.
    """
    figures = write_figures(results, figures_folder, dpi)
    write_bytes(out_md, report_text(results, figures, out_md.parent).encode())


def report_text(results: StudyResults, figures: Sequence[FigureFile], folder: Path) -> str:
    """The report.

    Args:
        figures: as written.
        folder: that links are relative to.
    """
    tables = {table.name: table for table in build_tables(results)}
    images = {figure.name: figure for figure in figures}
    numbers = {name: place for place, name in enumerate(_figure_order(images), 1)}
    seen = {soc_min_paragraph(results)}  # stands in the summary
    parts = ["# The tractor paper's study, made again", _PAPER]
    parts += [_summary(results), _made_with(results)]
    parts += ["## How to read it", _METHOD, _CALIBRATED]
    parts += ["## Claims of the paper", to_markdown(tables.pop("claims"))]
    for title, table_names, figure_names in _SECTIONS:
        parts.append(f"## {title}")
        parts += [
            _table(_once(tables.pop(name), seen), title) for name in table_names if name in tables
        ]
        parts += [_image(images[n], numbers[n], folder) for n in figure_names if n in images]
    if tables:
        parts.append("## Learners beside what does not learn")
        parts += [_table(_once(table, seen)) for table in tables.values()]
    rest = [name for name in images if name not in _named_figures()]
    parts += [_image(images[name], numbers[name], folder) for name in rest]
    parts += ["## Runs", _runs(results)]
    return "\n\n".join(part.strip("\n") for part in parts if part) + "\n"


def _named_figures() -> list[str]:
    return [name for _, _, names in _SECTIONS for name in names]


def _figure_order(images: Mapping[str, FigureFile]) -> list[str]:
    named = [name for name in _named_figures() if name in images]
    return [*named, *(name for name in images if name not in named)]


# --- summary ----------------------------------------------------------------------------------


def _summary(results: StudyResults) -> str:
    found = claims(results)
    counts = Counter(item.verdict for item in found)
    tally = ", ".join(
        f"{counts[key]} {several}" for key, several in _VERDICTS.items() if counts[key]
    )
    lines = [
        "## Summary",
        "",
        "**What was found**",
        "",
        *(f"- {line}" for line in what_was_found(results)),
        "",
        budget_caveat(results),
        "",
        soc_min_paragraph(results),
        "",
        f"Preset `{results.preset}`. Of {len(found)} claims (those on shaping and seeding count "
        f"once per SOC_min) {tally}. Evidence stands in the table of claims.",
    ]
    for verdict in _VERDICTS:
        chosen = [item for item in found if item.verdict == verdict]
        if chosen:
            lines += ["", f"**{verdict.capitalize()}**", "", *_claim_lines(chosen)]
    for kind, heading in _KINDS.items():
        subjects = [item["subject"] for item in results.differences if item["kind"] == kind]
        if subjects:
            lines += ["", f"**{heading}** (choices and reasons below): {'; '.join(subjects)}."]
    return "\n".join(lines)


_KINDS: Mapping[str, str] = {
    "silent": "What the paper left out",
    "different": "Done otherwise than in the paper",
    "slip": "Put right, because the paper has a slip",
}
"""Of the differences from the paper."""


def _claim_lines(chosen: Sequence[Claim]) -> Iterator[str]:
    """One line per claim; settings with the same verdict share it."""
    settings: dict[str, list[str]] = {}
    for item in chosen:
        settings.setdefault(item.text, []).append(item.setting)
    for text, where in settings.items():
        yield f"- {text} ({'; '.join(where)})"


# --- how it was made --------------------------------------------------------------------------


def _made_with(results: StudyResults) -> str:
    deep = [run for run in results.runs if not run.row.tabular]
    seeds = sorted({run.seed for run in results.runs})
    rows = [
        ("preset", results.preset),
        ("runs", f"{len(results.runs)} of {len(results.rows)} rows"),
        ("seeds", ", ".join(map(str, seeds)) or "none"),
        ("budget of a network", f"{episodes_text(results.episodes_deep)} episodes"),
        ("budget of a table", f"{episodes_text(results.episodes_tabular)} episodes"),
        ("environment steps per update", f"{results.steps_per_update:,}"),
        ("updates of a network", _spread([run.updates for run in deep])),
        ("transitions, all runs", f"{sum(run.steps for run in results.runs):,}"),
        ("wall time, all runs added up", f"{sum(r.seconds for r in results.runs) / 3600:.2f} h"),
    ]
    known = {name for name, _ in rows}
    rows += [
        (name, text)
        for name, text in _flat(_without_tables(results.provenance))
        if name not in known
    ]
    table = Table("provenance", "", "", ("what", "value"), tuple(rows), (OVERLAPPED,))
    return "## How it was made\n\n" + to_markdown(table)


def _without_tables(provenance: Mapping[str, Any]) -> dict[str, Any]:
    """Speeds have a table of their own."""
    return {name: value for name, value in provenance.items() if name != "speed"}


def _spread(values: Sequence[int]) -> str:
    if not values:
        return "none"
    low, high = min(values), max(values)
    return f"{low:,}" if low == high else f"{low:,} to {high:,}"


def _flat(document: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, str]]:
    """Name and text of every value of nested data."""
    for name, value in document.items():
        label = prefix + str(name).replace("_", " ")
        label = re.sub(r" (s|h|mb)\b", r" [\1]", label)  # units in names, as in code
        if isinstance(value, Mapping):
            yield from _flat(value, f"{label}, ")
        elif isinstance(value, Sequence) and not isinstance(value, str):
            yield label, ", ".join(map(str, value))
        elif name == "command":
            yield label, f"`{value}`"
        else:
            yield label, f"{value:,.1f}" if isinstance(value, float) else str(value)


def _runs(results: StudyResults) -> str:
    """Configuration hashes; equal hashes give equal results."""
    rows = tuple(
        (
            row.label,
            soc_min_text(row.soc_min),
            ", ".join(f"{run.seed}: `{run.config_hash[:12]}`" for run in results.of(row.key)),
        )
        for row in results.rows
    )
    caption = "First 12 digits of the SHA-256 of everything that decides a run's result, by seed."
    return to_markdown(Table("runs", "", caption, ("row", "SOC_min", "seed: hash"), rows))


# --- pieces -----------------------------------------------------------------------------------


def _once(table: Table, seen: set[str]) -> Table:
    """Without the notes that an earlier table of the report has already."""
    new = tuple(note for note in table.notes if note not in seen)
    known = [note for note in table.notes if note in seen]
    seen.update(new)
    marks = [found.group() for note in known if (found := re.match(r"\(\d+\)", note))]
    if marks:
        new = (*new, f"{', '.join(marks)}: see above.")
    return replace(table, notes=new)


def _table(table: Table, section: str = "") -> str:
    """With a heading of its own unless the section has the same."""
    heading = "" if table.title == section else f"### {table.title}\n\n"
    return heading + to_markdown(table)


def _image(figure: FigureFile, number: int, folder: Path) -> str:
    png, vector = (
        quote(Path(os.path.relpath(path, folder)).as_posix())
        for path in (figure.png, figure.vector)
    )
    return (
        f"![{figure.title}]({png})\n\n"
        f"*Figure {number}. {figure.title}.* {figure.caption} ([vector]({vector}))"
    )
