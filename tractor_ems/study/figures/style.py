"""One look for every figure of the study, and how a figure becomes a PNG and an SVG with the same
bytes every time. No results here."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import matplotlib
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter

from tractor_ems.plots import COLOURS
from tractor_msgs_py.atomic import write_bytes_with

BLUE, VERMILION, GREEN, PINK, ORANGE, SKY, BLACK = COLOURS
GREY = "#6b6b6b"

WIDTH_IN = 8.0
"""1280 px at 160 dpi: 10 pt text is 14 px high where a page shows the picture 800 px wide."""

DPI = 160

_LOOK: Any = {
    "font.family": "DejaVu Sans",  # matplotlib brings it, so every machine has it
    "font.size": 10.5,
    "axes.titlesize": 11,
    "axes.titlelocation": "left",
    "axes.labelsize": 10.5,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.axisbelow": True,
    "legend.fontsize": 9.5,
    "legend.frameon": False,
    "xtick.labelsize": 10,
    "ytick.labelsize": 10,
    "grid.alpha": 0.3,
    "svg.hashsalt": "tractor_ems",
    "path.simplify": True,
}


@contextmanager
def look() -> Iterator[None]:
    """The settings above, for building and for writing alike."""
    with matplotlib.rc_context(_LOOK):
        yield


def new_figure(height_in: float, width_in: float = WIDTH_IN) -> Figure:
    """An empty figure that needs no screen; call it within :func:`look`."""
    figure = Figure(figsize=(width_in, height_in), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def write_png_and_svg(figure: Figure, png: Path, svg: Path, dpi: int = DPI) -> None:
    """Both files, atomically; no date, version or random id goes into them.

    Raises:
        ConfigError: the folder cannot be written to.
    """
    with look():
        write_bytes_with(
            png,
            lambda file: figure.savefig(file, format="png", dpi=dpi, metadata={"Software": None}),
        )
        # Layout is the slow part, and both files shall have the same one.
        figure.set_layout_engine(None)
        write_bytes_with(
            svg,
            lambda file: figure.savefig(
                file, format="svg", dpi=dpi, metadata={"Date": None, "Creator": None}
            ),
        )


def say_not_run(axes: Axes, what: str) -> None:
    """An empty panel that says why it is empty."""
    axes.text(
        0.5,
        0.5,
        f"{what}: not run",
        transform=axes.transAxes,
        ha="center",
        va="center",
        color=GREY,
    )


def use_thousands(axis: Axis) -> None:
    """Tick labels as the paper writes numbers."""
    axis.set_major_formatter(FuncFormatter(lambda value, _: thousands(value).replace("-", "−")))


def thousands(value: float) -> str:
    """As the paper writes numbers: 37,000."""
    return f"{value:,.0f}"


def percent(share: float, digits: int = 1) -> str:
    """A fraction in percent: 83.6 %."""
    return f"{100 * share:.{digits}f} %"
