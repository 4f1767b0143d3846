"""Every figure of the study, as functions of its results; ``write_figures`` writes them all."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from matplotlib.figure import Figure

from tractor_ems.study.figures.ablations import build_ablations
from tractor_ems.study.figures.curves import build_curve
from tractor_ems.study.figures.episodes import build_convergence
from tractor_ems.study.figures.heatmap import build_heatmap
from tractor_ems.study.figures.operating_points import (
    build_conventional_points,
    build_shaped_points,
)
from tractor_ems.study.figures.optimum import build_optimum
from tractor_ems.study.figures.schematic import build_schematic
from tractor_ems.study.figures.style import DPI, write_png_and_svg
from tractor_ems.study.figures.tabular import build_pearson, build_tabular
from tractor_ems.study.figures.traces import build_traces
from tractor_ems.study.paper_values import episodes_of
from tractor_ems.study.results import StudyResults

__all__ = ["FIGURES", "FigureFile", "FigureSpec", "write_figures"]


@dataclass(frozen=True)
class FigureSpec:
    """One figure of the study.

    Attributes:
        name: of its files.
        title: for its caption.
        caption: what is drawn, without results.
        build: results to figure.
    """

    name: str
    title: str
    caption: str
    build: Callable[[StudyResults], Figure]


@dataclass(frozen=True)
class FigureFile:
    """A written figure: ``FigureSpec`` with the paths of its two files."""

    name: str
    title: str
    caption: str
    png: Path
    vector: Path


def _curve(row_id: str, title: str, more: str = "") -> FigureSpec:
    def build(results: StudyResults) -> Figure:
        return build_curve(results, row_id, title)

    where = (
        "here; the paper prints none" if episodes_of(row_id) is None else "here and in the paper"
    )
    return FigureSpec(
        f"reward_{row_id}",
        f"Reward curve, {title}",
        "Training return (exploration included) and greedy return, interquartile mean over seeds "
        f"with a 95 % band, and the episode of convergence {where}.{more}",
        build,
    )


_TWO = " One panel per SOC_min."

FIGURES: tuple[FigureSpec, ...] = (
    FigureSpec(
        "powertrain",
        "Series hybrid powertrain",
        "Power generation unit, power distribution unit (PDU), battery and motors. Sizes are "
        "those of the powertrain `paper`.",
        lambda results: build_schematic(),
    ),
    FigureSpec(
        "state_visits",
        "State visits of double Q-learning",
        "Visits of every (SOC bin, demand bin) during training, median seed; light grey was "
        "never visited. SOC over the window of the battery, demand over the range of the cycle.",
        build_heatmap,
    ),
    FigureSpec(
        "pearson",
        "Q against reward of double Q-learning",
        "Visited pairs of the median seed; below, the correlation of every seed on the paper's "
        "scale of strength.",
        build_pearson,
    ),
    FigureSpec(
        "tabular",
        "Tabular agents",
        "Greedy return over the tabular budget; the median seed's table in three parts; "
        "correlation over visited pairs, one dot a seed.",
        build_tabular,
    ),
    _curve("double_q", "double Q-learning"),
    _curve("dqn", "DQN"),
    _curve("ddqn", "DDQN"),
    _curve("ddqn_shaped", "DDQN, shaped reward", _TWO),
    _curve("ddqn_shaped_dp", "DDQN, shaped reward, DP seeds", _TWO),
    _curve("ddqn_shaped_mixed", "DDQN, shaped reward, DP + rule seeds", _TWO),
    _curve(
        "ddqn_shaped_rule",
        "DDQN, shaped reward, rule seeds",
        _TWO + " The paper prints its number and no curve.",
    ),
    FigureSpec(
        "traces",
        "SOC, battery, engine and total power of DQN and DDQN",
        "Final greedy drive of the median seed over the cycle, fuel reward. Pale lines are the "
        "steps, dark ones a running mean.",
        build_traces,
    ),
    FigureSpec(
        "points_conventional",
        "Engine operating points, conventional",
        "Circle area is the share of the engine's running time. The efficiency curve stands in "
        "for the paper's normalised map.",
        build_conventional_points,
    ),
    FigureSpec(
        "points_ddqn_shaped",
        "Engine operating points, DDQN with the shaped reward",
        "As above, same scale, median seed." + _TWO,
        build_shaped_points,
    ),
    FigureSpec(
        "optimum",
        "True optimum of each reward",
        "Exact DP on the reward itself, and greed on each step's reward, by SOC_min, beside the "
        "paper's rows. Lines in the right panel run from the initial to the final SOC, on an axis "
        "that does not begin at 0. Not in the paper.",
        build_optimum,
    ),
    FigureSpec(
        "convergence",
        "Episodes until convergence",
        "One rule for every curve. Interquartile mean, 95 % interval and seeds, one lane each; a "
        "triangle is a lower bound. The paper prints no episode for the tabular agents.",
        build_convergence,
    ),
    FigureSpec(
        "ablations",
        "Ablations beside the row they vary",
        "Interquartile mean, 95 % interval and seeds, with myopic greedy and the best point under "
        "the same reward and SOC_min, and what the paper prints for a row of its own. Some "
        "variations change more than one setting, see the rows' settings. Not in the paper.",
        build_ablations,
    ),
)


def write_figures(results: StudyResults, folder: Path, dpi: int = DPI) -> tuple[FigureFile, ...]:
    """Write every figure as PNG and SVG; equal results give equal bytes.

    Args:
        folder: made where it is missing.
        dpi: of the PNG, and of dense parts of the SVG.

    Raises:
        ConfigError: the folder cannot be written to.
    """
    written = []
    for spec in FIGURES:
        png, vector = folder / f"{spec.name}.png", folder / f"{spec.name}.svg"
        write_png_and_svg(spec.build(results), png, vector, dpi)
        written.append(FigureFile(spec.name, spec.title, spec.caption, png, vector))
    return tuple(written)
