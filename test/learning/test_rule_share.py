"""Rule-based bags that are named are used."""

import pytest

from tractor_ems.learning.config import rule_share_of


@pytest.mark.parametrize(
    ("given", "rule_bags", "share"),
    [
        (None, [], None),
        (-1.0, [""], None),
        (None, ["bag"], 0.25),
        (0.1, ["bag"], 0.1),
        (0.0, ["bag"], 0.0),
    ],
)
def test_named_rule_bags_seed_a_quarter_unless_told_otherwise(given, rule_bags, share):
    assert rule_share_of(given, rule_bags) == share
