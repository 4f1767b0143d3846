"""The page of measured figures is what the scripts recorded, and nothing else."""

import json

from nodes.measured_table import DATA, PAGE, ROOT, SECTIONS, page


def test_the_page_is_what_was_recorded():
    assert PAGE.read_text() == page(json.loads(DATA.read_text()))


def test_a_section_that_was_not_measured_names_its_command():
    text = page({})
    for name, command in SECTIONS.items():
        assert f"python test/nodes/{command} --record {name}" in text


def test_make_measure_fills_every_section():
    recipe = (ROOT / "Makefile").read_text()
    for name, command in SECTIONS.items():
        assert f"test/nodes/{command} --record {name}\n" in recipe
