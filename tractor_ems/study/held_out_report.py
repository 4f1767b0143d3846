"""The page of the held-out study: verdicts first, then what they rest on; from results alone."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from tractor_ems.study.figures.held_out import causal, write_figures
from tractor_ems.study.held_out_policies import DP
from tractor_ems.study.held_out_results import write_results
from tractor_msgs_py.atomic import write_bytes

Results = Mapping[str, Any]


def write_report(results: Results, page: Path) -> Path:
    """Write the page, its figures in a folder of its name beside it, and the results to
    ``data/STEM.json`` beside it; returns the latter.

    Raises:
        ConfigError: a file cannot be written.
    """
    data = data_of(page)
    write_results(data, results)
    figures = write_figures(results, page.with_suffix(""))
    write_bytes(page, page_of(results, page.stem, figures).encode())
    return data


def data_of(page: Path) -> Path:
    """Where the results of a page are."""
    return page.parent / "data" / f"{page.stem}.json"


def page_of(results: Results, stem: str, figures: Mapping[str, str]) -> str:
    """The page in Markdown; ``figures``: file name to caption."""

    def figure(name: str) -> str:
        caption = figures[f"{name}.png"]
        return f"![{caption}]({stem}/{name}.png)\n\n{caption}"

    parts = [
        "# Held-out study",
        _opening(results, stem),
        "## Verdicts",
        _verdicts(results),
        "## Scores",
        _policies(results),
        figure("ratios"),
        figure("profile"),
        "## By operation",
        _operations(results),
        figure("operations"),
        "## Pairs",
        _pairs(results),
        figure("improvement"),
        "## Conduct",
        _conduct(results),
        figure("traces"),
        "## What training took",
        _training(results),
        figure("learning_curve"),
        "## Disturbances",
        _robustness(results),
        figure("robustness"),
        "## Other vehicles",
        _transfer(results),
        "## How it was measured",
        _method(results),
    ]
    return "\n\n".join(part for part in parts if part) + "\n"


def table(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table, its first column to the left."""
    rule = ["---", *["---:"] * (len(heads) - 1)]
    lines = [list(heads), rule, *[[cell.replace("|", "\\|") for cell in row] for row in rows]]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def _opening(results: Results, stem: str) -> str:
    settings, judged = results["settings"], results["verdicts"]
    own = results["policies"][settings["subject"]]
    cycles = len({row["cycle"] for row in results["rows"]})
    due = [item for item in judged if not item["hoped"]]
    missed = sum(not item["met"] for item in due)
    smoke = settings["preset"] != "full"
    return (
        (
            f"**This is the preset {settings['preset']}: it shows that everything runs; its "
            "figures mean nothing.**\n\n"
            if smoke
            else ""
        )
        + f"{len(results['policies'])} policies on {cycles} cycles that no training saw, "
        f"powertrain `{settings['powertrain']}`. `{settings['subject']}` ({own['seeds']} training "
        "seeds): "
        f"median {own['median']:.4f}, worst {own['worst']:.4f} of the optimum. "
        f"{len(due) - missed} of {len(due)} bars are met, {missed} missed. It, `sdp`, `a_ecms` "
        "and `ddqn_sampled` are told when the work is planned to end, the others are not.\n\n"
        f"    ems study held-out --preset {settings['preset']} --report docs/{stem}.md\n"
        f"    ems study held-out --from docs/data/{stem}.json --report docs/{stem}.md\n\n"
        "The first command makes everything from nothing, the second this page from the rows of "
        f"[data/{stem}.json](data/{stem}.json) alone. What the figures of a run mean: "
        "[metrics.md](metrics.md)."
    )


def _verdicts(results: Results) -> str:
    return table(
        ("bar", "wanted", "found", "verdict"),
        [
            (item["bar"], item["wanted"], item["found"], "met" if item["met"] else "**missed**")
            for item in results["verdicts"]
        ],
    )


def _policies(results: Results) -> str:
    names = causal(results) + [name for name in results["policies"] if name == DP]
    rows = []
    for name in names:
        found = results["policies"][name]
        low, high = found["ci95"]
        seeds = found["seed_medians"]
        spread = f"{min(seeds):.4f}-{max(seeds):.4f}" if len(seeds) > 1 else "-"
        rows.append(
            (
                f"`{name}`",
                f"{found['median']:.4f}",
                f"{found['iqm']:.4f} [{low:.4f}, {high:.4f}]",
                f"{found['worst']:.4f}",
                _number(found["worst_finished"]),
                str(found["failed"]),
                spread,
            )
        )
    heads = (
        "policy", "median", "IQM [95 %]", "worst", "worst finished", "failed", "median by seed"
    )  # fmt: skip
    return table(heads, rows) + (
        "\n\nA run that left demand unmet has no score: it counts as failed, as 0 in all "
        "statistics but `worst finished`. `dp` knows the cycle: the optimum's own plan, whose "
        "distance from 1 is the price of ramp limit and minimum times and the grid's error."
    )


def _operations(results: Results) -> str:
    operations = list(next(iter(results["per_operation"].values())))
    rows = [
        (
            f"`{name}`",
            *(
                f"{found[o]['median']:.4f} / {found[o]['worst']:.4f}"
                for found in (results["per_operation"][name],)
                for o in operations
            ),
        )
        for name in causal(results)
    ]
    return table(("median / worst", *operations), rows)


def _pairs(results: Results) -> str:
    settings = results["settings"]
    learnt = [item["name"] for item in settings["learners"]]
    parts = [
        "How likely a run scores higher than the other policy's on the same cycle, ties half. "
        "Above 0.5 is better."
    ]
    for name in dict.fromkeys([settings["subject"], *learnt]):
        found = results["pairwise"][name]
        where = list(next(iter(found.values())))
        rows = [
            (
                f"`{other}`",
                *(f"{x['value']:.2f} [{x['low']:.2f}, {x['high']:.2f}]" for x in pairs.values()),
            )
            for other, pairs in found.items()
        ]
        parts.append(table((f"`{name}` over", *where), rows))
    return "\n\n".join(parts)


def _conduct(results: Results) -> str:
    rows = []
    for name in [*causal(results), *[n for n in results["policies"] if n == DP]]:
        x = results["policies"][name]
        rows.append(
            (
                f"`{name}`",
                f"{x['starts_per_h']:.2f}",
                f"{x['starts']:.0f}",
                f"{x['soc_min']:.2f}-{x['soc_max']:.2f}",
                f"{x['soc_swing']:.2f}",
                f"{100 * x['soc_error_mean']:.2f}",
                f"{100 * x['soc_error_max']:.2f}",
                str(x["violations"]),
                f"{x['shortfall_j'] / 1e3:.1f}",
            )
        )
    heads = (
        "policy", "starts/h", "starts, whole set", "SOC used", "swing, median",
        "SOC error mean, points", "max", "violations", "unmet, kJ",
    )  # fmt: skip
    return table(heads, rows) + (
        "\n\nSOC error is |final SOC - target|. Violations are steps that break a limit of SOC, "
        "battery power or current, engine power, ramp or minimum times, checked on every "
        "trajectory from its columns."
    )


def _training(results: Results) -> str:
    groups: dict[tuple[str, str], list[Mapping[str, Any]]] = {}
    for item in results["training"]:
        groups.setdefault((item["powertrain"], item["policy"]), []).append(item)
    rows = [
        (
            f"`{policy}`",
            powertrain,
            str(len(items)),
            str(items[0]["episodes"]),
            f"{items[0]['transitions']:,}",
            f"{min(i['seconds'] for i in items):.0f}-{max(i['seconds'] for i in items):.0f}",
            f"{max(i['cpu_s'] for i in items):.0f}",
            f"{max(i['read_s'] for i in items):.0f}",
        )
        for (powertrain, policy), items in groups.items()
    ]
    recorded, bars = results["recorded"], results["settings"]["bars"]
    heads = (
        "policy", "powertrain", "seeds", "recorded runs", "transitions", "seconds", "CPU s, most",
        "of it reading bags",
    )  # fmt: skip
    curve = ""
    if results["curve"]:
        curve = (
            "\n\nThe learning curve trains on fewer recorded runs with the same number of "
            "gradient steps, and is scored on dev cycles, never on held-out ones; references "
            f"there are interpolated over final SOC. The paper needs {bars['paper_episodes']:,} "
            "episodes, each driven."
        )
    return (
        f"{recorded['bags']} runs were recorded, {recorded['transitions']:,} steps, in "
        f"{recorded['cpu_s']:.0f} s of CPU. Seconds count from bags to policy file, one core of "
        "two each.\n\n" + table(heads, rows) + curve
    )


def _robustness(results: Results) -> str:
    found = results["robustness"]
    if not found:
        return "Not run."
    settings = results["settings"]
    subject, rule = settings["subject"], settings["never_stop"]
    cycles = len({row["cycle"] for row in results["robustness_rows"]})
    if subject not in found:
        return "Not run."
    rows = [
        (
            name,
            _loss(found[subject][name]),
            _loss(found[rule][name]),
            "yes" if found[subject][name]["no_worse"] else "no",
            str(found[subject][name]["violations"]),
        )
        for name in found[subject]
    ]
    heads = ("disturbance", f"`{subject}`", f"`{rule}`", "no worse", "violations")
    return (
        f"The same {cycles} cycles for all, first of each operation; no policy knows. Each run is "
        "scored against the optimum of the plant as it really is, to its own end. That optimum is "
        "solved on one grid without the halving certificate and interpolated over final SOC. Loss "
        "is the mean difference from the undisturbed score of the same runs, in points; runs that "
        "left demand unmet are counted beside it. No worse: neither more loss nor more failed "
        "runs. `fuel` scales the engine's fuel rate, not the fuel of a start: no policy decides "
        "otherwise for it. `end`: announced duration over the real one.\n\n" + table(heads, rows)
    )


def _transfer(results: Results) -> str:
    if not results["transfer"]:
        return "Not run."
    scale = {row["vehicle"]: row["scale"] for row in results["transfer_rows"]}
    factors = ", ".join(f"{100 * value:.1f} % for `{name}`" for name, value in scale.items())
    rows = [
        (
            item["vehicle"],
            item["way"],
            f"`{item['policy']}`",
            f"{item['median']:.4f}",
            f"{item['worst']:.4f}",
            f"{item['failed']} of {item['runs']}",
            f"{100 * item['soc_error_mean']:.2f} / {100 * item['soc_error_max']:.2f}",
            f"{item['starts_per_h']:.1f}",
            str(item["violations"]),
        )
        for item in results["transfer"]
    ]
    heads = (
        "vehicle", "way", "policy", "median", "worst", "failed", "SOC error mean / max",
        "starts/h", "violations",
    )  # fmt: skip
    return (
        f"Demand is scaled with the engine's rated power ({factors}): the originals ask for more "
        "than these vehicles have. *As it is*: the policy still believes to drive its own "
        "vehicle; only the published limits are the new one's. *Right plant model*: its engine, "
        "battery, limits and prices are the new vehicle's, demand is seen in units of its power; "
        "what it learnt stays. *Trained anew*: from "
        "bags of the new vehicle. Rules have their plain settings there. References are solved "
        "to each run's own end on one grid, without the halving certificate.\n\n"
        + table(heads, rows)
    )


def _method(results: Results) -> str:
    settings = results["settings"]
    budget = settings["budget"]
    return (
        f"- Training: {', '.join(settings['recorders'])} on seeds {budget['train_seeds'][0]}-"
        f"{budget['train_seeds'][1]} of {', '.join(settings['train_operations'])}"
        + (f"; {', '.join(budget['train_cycles'])}" if budget["train_cycles"] else "")
        + ". Nothing was tuned on a scored cycle. Two early drafts were scored on them, though: "
        "engines that stopped too often in loader work prompted the rule that keeps one ready, "
        "whose settings were then chosen on training and dev cycles.\n"
        "- Planned end: policies that use it are told the cycle's real length, as `run_info` "
        "announces it; names with `_unplanned` are not. Demand stays unknown to all but `dp`.\n"
        "- Targets of preset `field`: 12 s of recorded demand computed on the known plant, "
        "running and standing, then the value of stochastic DP fitted to the same bags, not the "
        "network's own. Its settings were chosen by hand on dev cycles, those of the baselines by "
        "a grid search on the same: [learning.md](learning.md), [baselines.md](baselines.md).\n"
        "- Score: fuel of the optimum from the same start to the run's own final SOC over the "
        "run's fuel, certified for every run by halving the grid; on `rows`.\n"
        "- Intervals: 95 % percentile bootstrap, "
        f"{budget['resamples']} resamples; seeds and cycles are drawn with replacement, cycles "
        "within their operation. `ci95` in the data is that of the interquartile mean.\n"
        "- Starts over the whole set are the mean over seeds.\n"
        f"- Package version {results['package_version']}; all settings are in the data."
    )


def _loss(cell: Mapping[str, Any]) -> str:
    loss = "-" if cell["loss"] is None else f"{100 * cell['loss']:+.2f}"
    return loss + (f", {cell['failed']} of {cell['runs']} failed" if cell["failed"] else "")


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.4f}"
