"""The held-out study's one JSON document: rows as they were found, and everything that follows
from them. From the rows alone the rest can be made again."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tractor_ems.study.held_out_statistics import analyse, robustness_table
from tractor_ems.study.held_out_verdicts import verdicts
from tractor_msgs_py.atomic import write_bytes
from tractor_msgs_py.errors import ConfigError

DIGITS = 7
"""Decimals of a number that is kept: SOC, kg and ratios are then known to 1e-7."""

_TABLES = ("rows", "robustness_rows", "transfer_rows")
_AS_FOUND = ("settings", "package_version", "recorded", "training", "curve", "traces")


def results_of(found: Mapping[str, Any]) -> dict[str, Any]:
    """The whole document of what ``run_held_out`` found, or of a document read back."""
    settings = found["settings"]
    rounded = {name: _rounded(found[name]) for name in _TABLES}
    results = {
        **analyse(rounded["rows"], settings["opponents"], settings["budget"]["resamples"]),
        "robustness": robustness_table(
            rounded["robustness_rows"],
            settings["never_stop"],
            [item["name"] for item in settings["disturbances"]],
        ),
        "transfer": transfer_table(rounded["transfer_rows"]),
        **{name: found[name] for name in _AS_FOUND},
        **rounded,
    }
    results["verdicts"] = [item.to_json() for item in verdicts(results)]
    return results


def transfer_table(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Median, worst, failed runs, mean |final SOC - target| and starts per hour by vehicle, way
    and policy; a run without a score counts as 0."""
    groups: dict[tuple[str, str, str], list[Mapping[str, Any]]] = {}
    for row in rows:
        groups.setdefault((row["vehicle"], row["way"], row["policy"]), []).append(row)
    made = []
    for (vehicle, way, policy), own in groups.items():
        scores = [row["dp_ratio"] or 0.0 for row in own]
        errors = [abs(row["soc_final"] - row["soc_target"]) for row in own]
        made.append(
            {
                "vehicle": vehicle,
                "way": way,
                "policy": policy,
                "runs": len(own),
                "median": round(float(np.median(scores)), 5),
                "worst": round(min(scores), 5),
                "failed": sum(row["dp_ratio"] is None for row in own),
                "soc_error_mean": round(float(np.mean(errors)), 5),
                "soc_error_max": round(max(errors), 5),
                "starts_per_h": round(
                    sum(row["engine_starts"] for row in own) / sum(row["hours"] for row in own), 3
                ),
                "violations": sum(row["violations"] for row in own),
            }
        )
    return made


def write_results(path: Path, results: Mapping[str, Any]) -> None:
    """Write the document; tables of rows as one list of columns and a list per row.

    Raises:
        ConfigError: it cannot be written.
        ValueError: a number is not finite.
    """
    parts = []
    for name, value in results.items():
        if name in _TABLES:
            value = _packed(value)
            lines = ",\n   ".join(json.dumps(line, allow_nan=False) for line in value["rows"])
            text = f'{{"columns": {json.dumps(value["columns"])}, "rows": [\n   {lines}]}}'
        elif name in ("traces", "curve"):
            text = json.dumps(value, allow_nan=False)
        else:
            text = json.dumps(value, indent=1, allow_nan=False)
        parts.append(f"{json.dumps(name)}: {text}")
    write_bytes(path, ("{\n" + ",\n".join(parts) + "\n}\n").encode())


def read_results(path: Path) -> dict[str, Any]:
    """A document of :func:`write_results`, its figures made again from its rows.

    Raises:
        ConfigError: it is missing or not such a document.
    """
    try:
        document = json.loads(path.read_text())
        found = {name: document[name] for name in _AS_FOUND}
        for name in _TABLES:
            columns, lines = document[name]["columns"], document[name]["rows"]
            found[name] = [dict(zip(columns, line, strict=True)) for line in lines]
        return results_of(found)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read ({error.strerror or error})") from None
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise ConfigError(f"{path}: not the results of the held-out study ({error!r})") from None


def _packed(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    columns = list(dict.fromkeys(name for row in rows for name in row))
    return {"columns": columns, "rows": [[row.get(name) for name in columns] for row in rows]}


def _rounded(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    return [
        {
            name: round(value, DIGITS) if isinstance(value, float) else value
            for name, value in row.items()
        }
        for row in rows
    ]
