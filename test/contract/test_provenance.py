"""The command line that files carry: repeatable, and without an install path."""

import sys

from tractor_msgs_py.provenance import command_line


def test_the_command_line_names_the_program_without_its_folder(monkeypatch):
    monkeypatch.setattr(sys, "argv", ["/opt/some/bin/ems", "run", "--out", "two words"])
    assert command_line() == "ems run --out 'two words'"
