"""``ems study paper --preset smoke``: every table and figure, and a second call only reads."""

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest


def study(out: Path, *more: str) -> tuple[dict, str]:
    command = [sys.executable, "-m", "tractor_ems.cli", "study", "paper", "--preset", "smoke"]
    done = subprocess.run(
        [*command, "--out", str(out), "--json", *more],
        capture_output=True,
        text=True,
        timeout=900,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    return json.loads(done.stdout), done.stderr


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_the_smoke_study_makes_every_table_and_figure_and_is_resumed_from_its_runs(
    tmp_path: Path,
) -> None:
    document, _ = study(tmp_path / "out")
    report = Path(document["report"])
    text = report.read_text()
    images = re.findall(r"!\[[^\]]+\]\(([^)]+)\)", text)
    assert len(images) == len(set(images)) >= 16
    for link in re.findall(r"\]\(([^)#]+)\)", text):
        assert (report.parent / link).is_file(), link
    names = {table["name"] for table in document["tables"]}
    assert {"table_1", "table_2", "summary_fuel", "seeding", "claims", "slips"} <= names
    assert all(table["rows"] for table in document["tables"])
    assert "nan" not in re.findall(r"[a-z]+", text.lower())
    for printed in ("37,000", "25,000", "32,000", "40,000", "9,000"):
        assert printed in text

    runs = sorted((tmp_path / "out" / "runs").glob("*/result.json"))
    before = {path: path.stat().st_mtime_ns for path in runs}
    again, notes = study(tmp_path / "out")
    assert {path: path.stat().st_mtime_ns for path in runs} == before
    assert "training agents" not in notes
    assert again["tables"] != [] and len(again["tables"]) == len(document["tables"])
