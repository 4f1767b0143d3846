"""The bars of the held-out study against what was found: each is met or missed, by its number."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any


@dataclass(frozen=True)
class Verdict:
    """One bar: what was to be, what was found, whether that meets it.

    ``hoped`` marks a bar that was attempted beyond what had to be.
    """

    bar: str
    wanted: str
    found: str
    met: bool
    hoped: bool = False

    def to_json(self) -> dict[str, Any]:
        """Plain data."""
        return asdict(self)


def verdicts(results: Mapping[str, Any]) -> list[Verdict]:
    """Every bar, judged from the results alone; what was not run is missed."""
    settings = results["settings"]
    bars, subject = settings["bars"], settings["subject"]
    own = results["policies"][subject]
    return [
        *_scores(bars, own),
        *_opponents(settings, results),
        _at_most("violations of SOC, power and ramp limits", own["violations"], 0, "{:.0f}"),
        _at_most("largest |final SOC - target|", own["soc_error_max"], bars["soc_each"], "{:.2%}"),
        _at_most("mean |final SOC - target|", own["soc_error_mean"], bars["soc_mean"], "{:.2%}"),
        _at_most(
            f"engine starts over {settings['starts_of']}'s",
            own["starts"] / max(results["policies"][settings["starts_of"]]["starts"], 1e-9),
            bars["starts"],
            "{:.2f}",
        ),
        *_cost(settings, results),
        _robust(settings, results),
    ]


def _scores(bars: Mapping[str, Any], own: Mapping[str, Any]) -> list[Verdict]:
    short = f", {own['failed']} of {own['runs']} runs failed" if own["failed"] else ""
    found = {"median": f"{own['median']:.4f}", "worst": f"{own['worst']:.4f}{short}"}
    return [
        Verdict(
            f"{name} dp_ratio" + (" (hoped for)" if prefix else ""),
            f">= {bars[prefix + name]:g}",
            found[name],
            bool(own[name] >= bars[prefix + name]),
            bool(prefix),
        )
        for prefix in ("", "stretch_")
        for name in ("median", "worst")
    ]


def _opponents(settings: Mapping[str, Any], results: Mapping[str, Any]) -> list[Verdict]:
    subject, never_stop = settings["subject"], settings["never_stop"]
    pairs = results["pairwise"][subject]
    made = []
    for other in (never_stop, settings["starts_of"]):
        overall = pairs[other]["overall"]
        made.append(
            Verdict(
                f"not worse than {other} overall",
                "interval of P(better) reaches 0.5",
                _interval(overall),
                bool(overall["high"] >= 0.5),
            )
        )
    hard = [
        operation
        for operation, figures in results["per_operation"][never_stop].items()
        if figures["median"] < 1.0 - settings["bars"]["lossy"]
    ]
    for operation in hard:
        found = pairs[never_stop][operation]
        made.append(
            Verdict(
                f"better than {never_stop} on {operation}",
                "whole interval of P(better) above 0.5",
                _interval(found),
                bool(found["low"] > 0.5),
            )
        )
    others = [o for o in settings["opponents"] if o not in (never_stop, settings["starts_of"])]
    for other in others:
        for where, found in pairs[other].items():
            made.append(
                Verdict(
                    f"better than {other} {'overall' if where == 'overall' else 'on ' + where}",
                    "whole interval of P(better) above 0.5",
                    _interval(found),
                    bool(found["low"] > 0.5),
                )
            )
    return made


def _cost(settings: Mapping[str, Any], results: Mapping[str, Any]) -> list[Verdict]:
    bars, subject = settings["bars"], settings["subject"]
    own = [
        item
        for item in results["training"]
        if item["policy"] == subject and item["powertrain"] == settings["powertrain"]
    ]
    seconds = max(item["seconds"] for item in own)
    episodes = max(item["episodes"] for item in own)
    most = bars["paper_episodes"] / bars["fewer_episodes"]
    return [
        _at_most("seconds from bags to policy file, slowest seed", seconds, bars["train_s"]),
        _at_most("transitions recorded", own[0]["transitions"], bars["transitions"], "{:,.0f}"),
        _at_most(
            f"episodes recorded ({bars['fewer_episodes']:g} times fewer than "
            f"{bars['paper_episodes']:,})",
            episodes,
            most,
        ),
    ]


def _robust(settings: Mapping[str, Any], results: Mapping[str, Any]) -> Verdict:
    share, never_stop = settings["bars"]["robust"], settings["never_stop"]
    name = f"disturbances that cost no more than they cost {never_stop}"
    found = results["robustness"].get(settings["subject"], {})
    if not found:
        return Verdict(name, f">= {share:.0%} of them", "not run", False)
    count = sum(item["no_worse"] for item in found.values())
    return Verdict(
        name,
        f">= {share:.0%} of {len(found)}",
        f"{count} of {len(found)}",
        bool(count >= share * len(found)),
    )


def _at_most(bar: str, value: float, limit: float, text: str = "{:.0f}") -> Verdict:
    return Verdict(bar, f"<= {text.format(limit)}", text.format(value), bool(value <= limit))


def _interval(found: Mapping[str, float]) -> str:
    return f"{found['value']:.3f} [{found['low']:.3f}, {found['high']:.3f}]"
