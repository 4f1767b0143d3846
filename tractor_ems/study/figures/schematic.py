"""The series hybrid powertrain as a drawing: who feeds whom, and what the controller sees."""

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import FancyArrowPatch, FancyBboxPatch

from tractor_ems.study.figures.style import (
    BLACK,
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    VERMILION,
    look,
    new_figure,
)
from tractor_sim.config import load_powertrain

_MECHANICAL, _ELECTRIC, _SIGNAL = BLACK, BLUE, VERMILION


def build_schematic() -> Figure:
    """Engine and generator (PGU), power distribution unit, battery, traction drive and PTO.

    The energies and powers written into the boxes are those of the powertrain ``paper``.
    """
    params = load_powertrain("paper")
    battery = params.battery
    with look():
        figure = new_figure(4.5)
        axes = figure.add_subplot()
        axes.set(xlim=(0, 16), ylim=(0, 9.2), aspect="equal")
        axes.set_axis_off()

        axes.add_patch(
            FancyBboxPatch(
                (0.25, 3.85),
                6.2,
                2.85,
                boxstyle="round,pad=0.1",
                facecolor="#f3f3f3",
                edgecolor=GREY,
                linestyle="--",
            )
        )
        axes.text(0.3, 6.42, "power generation unit (PGU)", color=GREY, va="center")
        _box(axes, 0.4, 4.2, 2.4, 1.7, f"engine\n{params.engine.power_max_w / 1e3:g} kW", ORANGE)
        _box(axes, 3.9, 4.2, 2.4, 1.7, "generator,\nrectifier", ORANGE)
        _box(axes, 8.0, 3.1, 1.9, 3.85, "PDU\nDC bus", GREY)
        battery_text = (
            f"battery  {battery.energy_j / 3.6e6:.0f} kWh\n"
            f"SOC {battery.soc_min:.0%} to {battery.soc_max:.0%}"
        )
        _box(axes, 6.95, 0.4, 4.0, 1.5, battery_text, GREEN)
        _box(axes, 11.5, 5.45, 2.4, 1.5, "inverter,\ntraction motor", BLUE)
        _box(axes, 11.5, 3.1, 2.4, 1.5, "inverter,\nPTO motor", BLUE)
        _box(
            axes,
            4.0,
            7.75,
            6.9,
            1.15,
            "energy management: $[P_{dem},\\ SOC] \\to P_{batt}$",
            VERMILION,
        )

        _link(axes, (2.8, 5.05), (3.9, 5.05), _MECHANICAL)
        _link(axes, (6.3, 5.05), (8.0, 5.05), _ELECTRIC)
        _link(axes, (8.95, 3.1), (8.95, 1.9), _ELECTRIC, both=True)
        _link(axes, (9.9, 6.2), (11.5, 6.2), _ELECTRIC, both=True)
        _link(axes, (9.9, 3.85), (11.5, 3.85), _ELECTRIC)
        _link(axes, (13.9, 6.2), (15.0, 6.2), _MECHANICAL, both=True)
        _link(axes, (13.9, 3.85), (15.0, 3.85), _MECHANICAL)
        _link(axes, (8.95, 7.75), (8.95, 6.95), _SIGNAL, dashed=True)

        axes.text(7.2, 5.3, "$P_{ICE}$", ha="center", va="bottom", fontsize=11.5)
        axes.text(9.15, 2.5, "$P_{batt}$  (> 0 discharges)", va="center", fontsize=11.5)
        axes.text(10.7, 5.03, "$P_{dem}$", ha="center", va="center", fontsize=11.5)
        axes.text(9.15, 7.35, "power split", color=_SIGNAL, va="center")
        axes.text(15.1, 6.2, "wheels", va="center")
        axes.text(15.1, 3.85, "PTO", va="center")
        axes.text(0.3, 2.1, "$P_{dem} = P_{batt} + P_{ICE}$", fontsize=13, va="center")
        axes.legend(
            handles=[
                Line2D([], [], color=_MECHANICAL, linewidth=3, label="shaft"),
                Line2D([], [], color=_ELECTRIC, linewidth=1.8, label="electric, high voltage"),
                Line2D([], [], color=_SIGNAL, linestyle="--", label="signal"),
            ],
            loc="lower left",
            bbox_to_anchor=(0.0, -0.02),
            handlelength=2.6,
        )
    return figure


def _box(
    axes: Axes, x: float, y: float, width: float, height: float, text: str, colour: str
) -> None:
    axes.add_patch(
        FancyBboxPatch(
            (x, y),
            width,
            height,
            boxstyle="round,pad=0,rounding_size=0.18",
            facecolor="white",
            edgecolor=colour,
            linewidth=2.2,
        )
    )
    axes.text(x + width / 2, y + height / 2, text, ha="center", va="center", linespacing=1.35)


def _link(
    axes: Axes,
    start: tuple[float, float],
    end: tuple[float, float],
    colour: str,
    *,
    both: bool = False,
    dashed: bool = False,
) -> None:
    axes.add_patch(
        FancyArrowPatch(
            start,
            end,
            arrowstyle="<|-|>" if both else "-|>",
            mutation_scale=13,
            color=colour,
            linewidth=3.0 if colour == _MECHANICAL else 1.8,
            linestyle="--" if dashed else "-",
            shrinkA=1,
            shrinkB=1,
        )
    )
