"""The replication report in Markdown, as a function of the results. Prose explains the method;
every number and every verdict is computed."""

import os
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import quote

from tractor_ems.study.claims import Claim, Verdict, claims
from tractor_ems.study.convergence import FINAL_SHARE, HOLD_SHARE, MIN_SEEDS, REACHED
from tractor_ems.study.figures import FigureFile, write_figures
from tractor_ems.study.figures.style import DPI
from tractor_ems.study.paper_values import episodes_text
from tractor_ems.study.results import StudyResults
from tractor_ems.study.tables import Table, build_tables, to_markdown
from tractor_ems.study.tables.measures import (
    BASELINE_NAMES,
    SOC_MINS,
    find_baseline,
    measure,
)
from tractor_ems.study.tables.quantities import measure_text, percent_text
from tractor_msgs_py.atomic import write_bytes

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

_METHOD = f"""\
- **Here** is the interquartile mean over seeds with a stratified bootstrap 95 % interval; fewer
  than {MIN_SEEDS} seeds resolve no difference.
- **Converged** is the first evaluation from which the running median of the greedy return stays at
  {100 * REACHED:.0f} % of the way from the first evaluation to the final value (median of the last
  {100 * FINAL_SHARE:.0f} % of the evaluations), held for {100 * HOLD_SHARE:.0f} % of them before
  those. The rule was fixed before the results and is the same for every curve. A curve that does
  not is censored: `> N` episodes.
- **`dp_ratio`** is the fuel of a certified DP solution that starts and ends at the run's own SOC
  over the run's fuel. The paper's way of counting, at whatever SOC a drive ends, stands beside it.
- **SOC_min** is not printed. The paper's unshaped row ends at 70 % and its shaped rows at 83.6 %;
  either could be the bound, so every shaped row is run with both."""

_SECTIONS: Sequence[tuple[str, Sequence[str], Sequence[str]]] = (
    ("The paper's tables", ("table_1", "table_2", "summary_fuel", "summary_efficiency",
                            "summary_episodes", "summary_relative", "seeding"), ()),
    ("Powertrain", (), ("powertrain",)),
    ("Tabular agents", ("tabular",), ("state_visits", "pearson", "tabular", "reward_double_q")),
    ("DQN and DDQN", (), ("reward_dqn", "reward_ddqn", "traces")),
    ("Reward shaping", (), ("reward_ddqn_shaped", "points_conventional", "points_ddqn_shaped")),
    ("Seeding", (), ("reward_ddqn_shaped_dp", "reward_ddqn_shaped_mixed",
                     "reward_ddqn_shaped_rule", "convergence")),
    ("What the rewards ask for", ("optimum",), ("optimum",)),
    ("Ablations", ("ablations",), ("ablations",)),
    ("Differences from the paper", ("differences",), ()),
    ("Slips of the paper", ("slips",), ()),
    ("Cost", ("cost",), ()),
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
    parts = ["# The paper's study, made again", _summary(results), _made_with(results)]
    parts += ["## How to read it", _METHOD, _CALIBRATED]
    parts += ["## Claims of the paper", to_markdown(tables.pop("claims"))]
    for title, table_names, figure_names in _SECTIONS:
        parts.append(f"## {title}")
        parts += [_table(tables.pop(name), title) for name in table_names if name in tables]
        parts += [_image(images[n], numbers[n], folder) for n in figure_names if n in images]
    if tables:
        parts.append("## Learners beside what does not learn")
        parts += [_table(table) for table in tables.values()]
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
        f"Preset `{results.preset}`. Of {len(found)} claims (those on shaping and seeding count "
        f"once per SOC_min) {tally}. Evidence stands in the table of claims.",
    ]
    for verdict in _VERDICTS:
        chosen = [item for item in found if item.verdict == verdict]
        if chosen:
            lines += ["", f"**{verdict.capitalize()}**", "", *_claim_lines(chosen)]
    lines += ["", "**At equal final SOC** (`dp_ratio`, 1 is the optimum)", ""]
    lines += [f"- {line}" for line in _equal_soc(results)]
    for heading, subjects in _silent_and_other(results):
        if subjects:
            lines += ["", f"**{heading}** (choices and reasons below): {'; '.join(subjects)}."]
    return "\n".join(lines)


def _silent_and_other(results: StudyResults) -> Iterator[tuple[str, list[str]]]:
    left_out = [item for item in results.differences if "not " in item["paper"].lower()]
    yield "What the paper left out", [item["subject"] for item in left_out]
    others = [item["subject"] for item in results.differences if item not in left_out]
    yield "Done otherwise than in the paper", others


def _claim_lines(chosen: Sequence[Claim]) -> Iterator[str]:
    """One line per claim; settings with the same verdict share it."""
    settings: dict[str, list[str]] = {}
    for item in chosen:
        settings.setdefault(item.text, []).append(item.setting)
    for text, where in settings.items():
        yield f"- {text} ({'; '.join(where)})"


def _equal_soc(results: StudyResults) -> Iterator[str]:
    for soc_min in SOC_MINS:
        runs = results.of(f"ddqn_shaped@{soc_min:g}")
        texts = []
        if runs:
            ratio = measure_text(measure(runs, lambda o: o.dp_ratio), True, 1.0, 4, "")
            soc = measure_text(measure(runs, lambda o: o.soc_final), False, 100.0, 1, " %")
            texts.append(f"shaped DDQN {ratio}, final SOC {soc}")
        else:
            texts.append("shaped DDQN not run")
        for name in ("best_point", "rule_based", "myopic", "conventional"):
            item = find_baseline(results, name, "piecewise", soc_min)
            if item is not None and item.outcome.dp_ratio is not None:
                texts.append(
                    f"{BASELINE_NAMES[name].split(' (')[0]} {item.outcome.dp_ratio:.4f}, "
                    f"final SOC {percent_text(item.outcome.soc_final)}"
                )
        yield f"SOC_min {percent_text(soc_min)}: " + "; ".join(texts)


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
        ("process time, all runs", f"{sum(run.seconds for run in results.runs) / 3600:.2f} h"),
    ]
    known = {name for name, _ in rows}
    rows += [(name, text) for name, text in _flat(results.provenance) if name not in known]
    table = Table("provenance", "", "", ("what", "value"), tuple(rows))
    return "## How it was made\n\n" + to_markdown(table)


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
            percent_text(row.soc_min),
            ", ".join(f"{run.seed}: `{run.config_hash[:12]}`" for run in results.of(row.key)),
        )
        for row in results.rows
    )
    caption = "First 12 digits of the SHA-256 of everything that decides a run's result, by seed."
    return to_markdown(Table("runs", "", caption, ("row", "SOC_min", "seed: hash"), rows))


# --- pieces -----------------------------------------------------------------------------------


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
