"""Every figure of the study, as functions of its results; ``write_figures`` writes them all."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from matplotlib.figure import Figure

from tractor_ems.study.figures.comparison import (
    build_ablations,
    build_convergence,
    build_optimum,
)
from tractor_ems.study.figures.curves import build_curve
from tractor_ems.study.figures.heatmap import build_heatmap
from tractor_ems.study.figures.operating_points import (
    build_conventional_points,
    build_shaped_points,
)
from tractor_ems.study.figures.schematic import build_schematic
from tractor_ems.study.figures.style import DPI, write_png_and_svg
from tractor_ems.study.figures.tabular import build_pearson, build_tabular
from tractor_ems.study.figures.traces import build_traces
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

    return FigureSpec(
        f"reward_{row_id}",
        f"Reward curve, {title}",
        "Training return (exploration included) and greedy return, interquartile mean over seeds "
        f"with a 95 % band, and the episode of convergence here and in the paper.{more}",
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
        "Visits of every (SOC bin, demand bin) during training, median seed; white was never "
        "visited.",
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
        "Greedy return over the tabular budget, share of the table's entries never visited, and "
        "correlation over visited pairs; one dot a seed, numbers are medians.",
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
        "Final greedy drive of the median seed over the cycle, fuel reward.",
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
        "As above, median seed." + _TWO,
        build_shaped_points,
    ),
    FigureSpec(
        "optimum",
        "True optimum of each reward",
        "Exact DP on the reward itself, by SOC_min, beside the paper's rows. Not in the paper.",
        build_optimum,
    ),
    FigureSpec(
        "convergence",
        "Episodes until convergence",
        "One rule for every curve. Interquartile mean, 95 % interval and seeds; a triangle is a "
        "lower bound. Not in the paper.",
        build_convergence,
    ),
    FigureSpec(
        "ablations",
        "What each single change does",
        "Interquartile mean, 95 % interval and seeds. Not in the paper.",
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
