"""The card of a policy file: what it is, what it was made of, what it knows, what it must not be
used for. Everything comes out of the file, and scores from beside it; equal files, equal cards.
"""

import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from tractor_ems.policies.envelope import stored_envelope
from tractor_ems.policies.made import load_made
from tractor_ems.policies.protocol import MadePolicy
from tractor_msgs_py.errors import ConfigError, PolicyError
from tractor_msgs_py.observation import DemandFilter

SCORES_SUFFIX = ".scores.json"
"""Of the file beside a policy that holds its scores, in the shape of ``docs/data/held_out.json``
or a plain object of numbers."""

OPERATION_KEYS = ("median", "worst", "starts_per_h", "soc_error_max")
"""What the card shows of each operation."""


@dataclass(frozen=True)
class Card:
    """What people should know of a policy; lists and objects as in the file.

    Attributes:
        file, sha256: name and content of the policy file.
        name, kind: what tables call it, and the kind of file.
        powertrain, powertrain_hash: what it was made for.
        dt_s: step length it decides at; None: any [s].
        mode, signals, filters: what it needs to observe.
        horizon_s: farthest planned end that it tells from none; 0: it knows no planned end [s].
        envelope: signal to least and most seen in training; None: the file is older.
        seed, package_version, command_line: how it was made.
        cycles, bag_hashes: what it was trained on.
        training: figures of the training.
        scores: how good it was; empty where nobody says.
        operations: the same for each operation.
    """

    file: str
    sha256: str
    name: str
    kind: str
    powertrain: str
    powertrain_hash: str
    dt_s: float | None
    mode: str
    signals: tuple[str, ...]
    filters: tuple[DemandFilter, ...]
    horizon_s: float
    envelope: dict[str, tuple[float, float]] | None
    seed: int | None
    package_version: str
    command_line: str
    cycles: tuple[str, ...]
    bag_hashes: tuple[str, ...]
    training: dict[str, Any]
    scores: dict[str, Any]
    operations: dict[str, dict[str, Any]]

    def to_json(self) -> dict[str, Any]:
        """Plain data, the limits included."""
        return {**asdict(self), "limits": list(limits_of(self))}


def card_of(path: Path, scores: Path | None = None) -> Card:
    """The card of a policy file.

    Args:
        path: of the policy.
        scores: file with its scores; None: the one beside it, or else what its metadata says.

    Raises:
        PolicyError: the file is no policy of this package, or what it says of itself is damaged.
        ConfigError: the scores cannot be read, or hold none of this policy.
    """
    policy = load_made(path)
    found, operations = _scores(path, policy.name, policy.metadata, scores)
    try:
        return _card(path, policy, found, operations)
    except (TypeError, ValueError, AttributeError, OverflowError) as error:
        raise PolicyError(f"{path}: metadata has no card in it ({error!r:.200})") from None


def _card(
    path: Path,
    policy: MadePolicy,
    found: dict[str, Any],
    operations: dict[str, dict[str, Any]],
) -> Card:
    data, spec = policy.metadata, policy.spec
    times_s = [float(data.get("horizon_s", 0.0)), *map(float, data.get("times_s", ()))]
    horizon_s = 0.0 if policy.name.endswith("unplanned") else max(times_s)
    seed = data.get("seed")
    return Card(
        file=path.name,
        sha256=hashlib.sha256(path.read_bytes()).hexdigest(),
        name=policy.name,
        kind=str(data["kind"]),
        powertrain=policy.params.name,
        powertrain_hash=str(data["powertrain_hash"]),
        dt_s=spec.dt_s,
        mode=spec.mode,
        signals=spec.signals,
        filters=spec.filters,
        horizon_s=horizon_s,
        envelope=stored_envelope(data),
        seed=None if seed is None else int(seed),
        package_version=str(data.get("package_version", "")),
        command_line=str(data.get("command_line", "")),
        cycles=tuple(map(str, data.get("cycles", ()))),
        bag_hashes=tuple(map(str, data.get("bag_hashes", ()))),
        training=dict(data.get("training", {})),
        scores=found,
        operations=operations,
    )


def _scores(
    path: Path, name: str, data: Mapping[str, Any], given: Path | None
) -> tuple[dict[str, Any], dict[str, dict[str, Any]]]:
    """Scores over all, and by operation."""
    beside = path.with_suffix(SCORES_SUFFIX)
    file = given or (beside if beside.is_file() else None)
    if file is None:
        stored = data.get("scores", {})
        return dict(stored) if isinstance(stored, Mapping) else {}, {}
    try:
        document = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ConfigError(f"{file}: cannot be read as JSON ({error})") from None
    found = document.get("policies", document) if isinstance(document, dict) else None
    if found is not document and isinstance(found, dict):
        found = found.get(name)
    if not isinstance(found, dict):
        raise ConfigError(f"{file}: holds no scores of policy {name}")
    if found is document:
        return found, {}
    try:
        listed = document["per_operation"][name] if "per_operation" in document else {}
        return found, {operation: dict(own) for operation, own in listed.items()}
    except (KeyError, TypeError, ValueError, AttributeError):
        raise ConfigError(f"{file}: per_operation: no scores of policy {name}") from None


def limits_of(card: Card) -> tuple[str, ...]:
    """What the policy must not be used for, or not without thought, a sentence each."""
    found = [
        f"It was made for powertrain {card.powertrain} with hash {card.powertrain_hash[:12]}; "
        "others are refused unless `allow_other_powertrain` is set, and then nothing is promised."
    ]
    if card.dt_s is not None:
        found.append(f"It decides every {card.dt_s:g} s and at no other step length.")
    if card.envelope is None:
        found.append("The file holds no envelope: nobody is warned of work it was not trained on.")
    else:
        found.append(
            "Outside the envelope it guesses: `ddqn_policy` warns, and hands over to the fallback "
            "law with `outside_envelope:=fallback`."
        )
    if card.horizon_s:
        found.append(
            f"It wants to know when the work ends. Without a planned end it takes the farthest it "
            f"knows, {card.horizon_s:g} s: SOC then swings freely and may be off the target when "
            "the work stops."
        )
    else:
        found.append("It knows no planned end and keeps SOC near the target at all times.")
    if not card.scores:
        found.append("No scores are stored with it: drive it on work of your own first.")
    found.append(
        "It is as good as the powertrain model it was trained on. It is no safety function: what "
        "keeps commands feasible is outside it. On a vehicle begin in the shadow."
    )
    return tuple(found)


def markdown(card: Card) -> str:
    """The card as a page."""
    spec = f"{card.mode} samples of {', '.join(card.signals)}"
    spec += f", every {card.dt_s:g} s" if card.dt_s is not None else ""
    end = f"planned end up to {card.horizon_s:g} s ahead" if card.horizon_s else "no planned end"
    rows: list[tuple[str, str]] = [
        ("file", f"SHA-256 `{card.sha256}`"),
        ("policy", f"`{card.name}`, kind `{card.kind}`"),
        ("powertrain", f"`{card.powertrain}`, hash `{card.powertrain_hash}`"),
        ("observes", f"{spec}; {end}"),
        *((f"feature{n}", _filter_text(item)) for n, item in enumerate(card.filters)),
        ("made by", f"`{card.command_line}`" if card.command_line else "not said"),
        ("version, seed", f"{card.package_version or 'not said'}, {card.seed}"),
        *((f"training: {key}", _shown(value)) for key, value in sorted(card.training.items())),
    ]
    parts = [f"# Policy card: `{card.file}`", _table(("", ""), rows)]
    if card.envelope is not None:
        parts += [
            "## Envelope: what it saw in training",
            _table(
                ("signal", "least", "most"),
                [(name, *_range(name, *pair)) for name, pair in card.envelope.items()],
            ),
        ]
    if card.scores:
        shown = [(key, _shown(value)) for key, value in card.scores.items()]
        parts += ["## Scores", _table(("quantity", "value"), shown)]
    if card.operations:
        rows_of = [
            (name, *(_shown(own.get(key)) for key in OPERATION_KEYS))
            for name, own in card.operations.items()
        ]
        parts += [_table(("operation", *OPERATION_KEYS), rows_of)]
    parts += ["## Limits", "\n".join(f"- {limit}" for limit in limits_of(card))]
    parts += [
        "## Trained on",
        f"{len(card.cycles)} cycles: {', '.join(card.cycles) or 'none said'}.",
        f"{len(card.bag_hashes)} bags, the first twelve digits of their SHA-256: "
        f"{' '.join(item[:12] for item in card.bag_hashes) or 'none said'}.",
    ]
    return "\n\n".join(parts) + "\n"


def _filter_text(item: DemandFilter) -> str:
    if item.kind == "low_pass":
        return f"demand, low pass of {item.time_constant_s:g} s"
    prior = f"{item.prior_w / 1e3:.4g} kW counted for {item.time_constant_s:g} s"
    return f"demand, mean of the run so far with {prior}"


def _range(name: str, least: float, most: float) -> tuple[str, str]:
    if name == "soc":
        return f"{least:.3f}", f"{most:.3f}"
    return f"{least / 1e3:.1f} kW", f"{most / 1e3:.1f} kW"


def _shown(value: Any) -> str:
    if isinstance(value, bool) or value is None:
        return "-" if value is None else str(value).lower()
    if isinstance(value, float):
        return f"{value:.6g}" if math.isfinite(value) else str(value)
    if isinstance(value, list | tuple):
        between = " .. " if len(value) == 2 else ", "
        return between.join(_shown(item) for item in value)
    if isinstance(value, dict):
        return ", ".join(f"{key} {_shown(item)}" for key, item in value.items())
    return str(value)


def _table(heads: tuple[str, ...], rows: Sequence[tuple[str, ...]]) -> str:
    lines = [heads, ("---",) * len(heads), *rows]
    return "\n".join(
        "|" + "|".join(f" {cell.replace('|', '&#124;')} " if cell else " " for cell in line) + "|"
        for line in lines
    )
