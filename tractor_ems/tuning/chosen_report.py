"""What a search of settings chose: as the file that policies read, and as a page for people."""

from collections.abc import Mapping
from typing import Any

import yaml

from tractor_ems.tuning.grid import Grid, Preset
from tractor_ems.tuning.grid_search import Chosen, excess
from tractor_msgs_py import __version__
from tractor_sim.powertrain import PowertrainParams
from tractor_sim.powertrain_json import powertrain_hash

_PAGE = """# Baselines and how they were tuned

Every baseline's settings come from one grid search with one objective (`{command}`):
the largest median dp_ratio over {cycles} dev cycles, among settings that leave no demand unmet and
end near the target SOC: |final SOC - target| at most {soc_mean:.0f} points in the mean and
{soc_max:.0f} at worst. Where no setting holds these bars, the one with the fewest cycles of unmet
demand counts, then the one that exceeds the SOC bars by least. dp_ratio: least fuel to the run's
own final SOC over its fuel, 0 where demand was left unmet; for tuning it is interpolated between
solved ends. No held-out cycle was driven. Grid and cycles: `config/baseline/grid.yaml`. Every
setting that was tried, with its score by cycle: `docs/data/tuning/*.jsonl`. What was chosen:
`config/baseline/{name}.yaml`, which `ems evaluate --policy NAME`, `rule_based_policy` and
`ems tune sdp` use for this powertrain; others get the defaults in the code.

Powertrain {name} ({hash}), package {version}. SOC errors in points; starts over all cycles.

## On the dev cycles

{dev}

## On squeezed work

{squeezed_cycles} dev cycles compressed to 0.25-0.6 of their time at 0.4-0.8 of their power:
shorter strokes than any recording. It decided nothing.

{squeezed}

## Chosen settings

{settings}

## The policies

- `load_levelling`: the engine at the slow mean of demand, see `policies/levelling.py`.
- `never_stop_ecms`: least equivalent fuel at every step, the engine never stops.
- `ecms`: the classic one. Free to stop, a start counts nothing, the present demand decides.
- `a_ecms_unplanned`: a start is written off over a time, smoothed demand decides on it, SOC is fed
  back. `a_ecms` also knows the planned end: its feedback stiffens as soc_gain + stiffen_s / time
  left, so SOC swings first and lands at its target. The planned end is the cycle's real one.
- `sdp_unplanned`, `sdp`: stochastic dynamic programming on a Markov chain of demand, fitted here
  to the demand of the training cycles, by `ems tune sdp` to that of bags. `sdp` has a table of
  values for each of 15 times left; `sdp_unplanned` has one and a cost of SOC off its target.

`conventional`, `rule_based` and `best_point` have nothing to tune that would bring SOC back.
"""


def chosen_json(grid: Grid, chosen: Mapping[str, Chosen]) -> dict[str, Any]:
    """Settings and scores by policy as plain data, of which the rest here is made."""
    return {
        name: {
            "settings": found.dev.settings,
            "holds_bars": excess(found.dev, grid) == (0, 0.0),
            "feasible": found.feasible,
            "tried": found.tried,
            "dev": found.dev.summary(),
            "squeezed": found.squeezed.summary(),
            "squeezed_holds_bars": excess(found.squeezed, grid) == (0, 0.0),
        }
        for name, found in chosen.items()
    }


def settings_yaml(params: PowertrainParams, chosen: Mapping[str, Any]) -> str:
    """The file ``config/baseline/NAME.yaml``."""
    document = {
        "powertrain": params.name,
        "powertrain_hash": powertrain_hash(params),
        "policies": {name: dict(row["settings"]) for name, row in chosen.items()},
    }
    head = "# Settings of the baselines, chosen by `ems tune baselines`; see docs/baselines.md.\n"
    return head + yaml.safe_dump(document, sort_keys=False)


def page(
    params: PowertrainParams,
    grid: Grid,
    preset: Preset,
    chosen: Mapping[str, Any],
    command: str,
) -> str:
    """Markdown."""
    rows = [
        f"| {name} | {_settings(row['settings'])} | {row['feasible']} of {row['tried']} |"
        for name, row in chosen.items()
    ]
    return _PAGE.format(
        command=command,
        cycles=len(grid.dev.names[:: preset.every]),
        squeezed_cycles=len(grid.squeezed.names[:: preset.every]),
        soc_mean=100 * grid.soc_mean,
        soc_max=100 * grid.soc_max,
        name=params.name,
        hash=powertrain_hash(params)[:12],
        version=__version__,
        dev=_table(chosen, "dev", "holds_bars"),
        squeezed=_table(chosen, "squeezed", "squeezed_holds_bars"),
        settings="\n".join(["| policy | settings | hold the bars |", "|---|---|---|", *rows]),
    )


def _table(chosen: Mapping[str, Any], which: str, bars: str) -> str:
    lines = [
        "| policy | median | mean | worst | starts | SOC error mean | max | unmet | bars |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for name, found in chosen.items():
        row = found[which]
        scores = " | ".join(f"{row[key]:.4f}" for key in ("median", "mean", "worst"))
        lines.append(
            f"| {name} | {scores} | {row['starts']} | {100 * row['soc_mean']:.1f} | "
            f"{100 * row['soc_max']:.1f} | {row['short']} | "
            f"{'held' if found[bars] else 'missed'} |"
        )
    return "\n".join(lines)


def _settings(settings: Mapping[str, Any]) -> str:
    return ", ".join(f"{key} {value}" for key, value in settings.items())
