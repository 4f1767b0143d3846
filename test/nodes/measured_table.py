"""Writes docs/measured.md from docs/data/measured.json, so that no figure is typed by hand.

python test/nodes/measured_table.py
"""

import json
from pathlib import Path
from typing import Any

from tractor_msgs_py.atomic import write_bytes

ROOT = Path(__file__).resolve().parents[2]
DATA = ROOT / "docs" / "data" / "measured.json"
PAGE = ROOT / "docs" / "measured.md"

INTRODUCTION = """\
# Measured: reactions, ticks, signals, hand-overs

Written by `python test/nodes/measured_table.py` from `docs/data/measured.json`; the scripts below
fill that with `--record`. Real nodes as separate processes, the other side scripted where one has
to misbehave. What should happen is in [safety.md](safety.md); that it happens is tested
(`test/nodes/test_faults.py`); how soon, on one machine, is here. No test depends on a time.

`make measure` runs all of it: about an hour and a half, on a machine that does nothing else.
"""

SECTIONS = {
    "reactions": "measure_reactions.py --trials 50",
    "faults": "measure_faults.py --trials 5",
    "real_time": "measure_real_time.py --seconds 600",
    "learnt": "measure_real_time.py --seconds 600 --policy out/measured/tractor.safetensors",
    "signals": "measure_signals.py --trials 50",
    "handover": "measure_handover.py --trials 100",
}
"""Sections in their order, and the full measurement of each."""


def page(recorded: dict[str, Any]) -> str:
    """The page for what was recorded; a section that was not names its command."""
    parts = [INTRODUCTION]
    for name, command in SECTIONS.items():
        full = f"python test/nodes/{command} --record {name}"
        if name not in recorded:
            parts.append(f"## {name}\n\nNot measured yet: `{full}`\n")
            continue
        parts.append(_section(recorded[name], full))
    return "\n".join(parts)


def _section(section: dict[str, Any], full: str) -> str:
    machine, columns = section["machine"], section["columns"]
    lines = [f"## {section['title']}", "", f"`{section['command']}`", ""]
    lines += [_line(columns), _line(["---"] * len(columns)), *map(_line, section["rows"]), ""]
    lines += [f"- {note}" for note in section["notes"]]
    lines.append(
        f"- {section['date']}, {machine['cores']} cores of {machine['processor']}, Python "
        f"{machine['python']}; load average {machine['load_before']} before, "
        f"{machine['load_after']} after."
    )
    if section["command"] != full:
        lines.append(f"- A shorter run than the full one: `{full}`")
    return "\n".join([*lines, ""])


def _line(cells: list[str]) -> str:
    return f"| {' | '.join(cells)} |"


def main() -> None:
    """Write the page."""
    recorded = json.loads(DATA.read_text()) if DATA.exists() else {}
    write_bytes(PAGE, page(recorded).encode())


if __name__ == "__main__":
    main()
