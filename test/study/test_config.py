"""The study's settings file: what it refuses, and what it spells out."""

from pathlib import Path

import pytest
import yaml

from tractor_ems.study.config import load_study
from tractor_msgs_py.errors import ConfigError
from tractor_sim.resources import resource_path

SHIPPED = resource_path("config", "study") / "paper.yaml"


def changed(tmp_path: Path, change) -> Path:
    document = yaml.safe_load(SHIPPED.read_text())
    change(document)
    path = tmp_path / "mine.yaml"
    path.write_text(yaml.safe_dump(document))
    return path


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: d.update(extra=1), "extra"),
        (lambda d: d["networks"].update(gamma=1.0), r"networks\.gamma.*1\.0"),
        (lambda d: d["networks"].update(batch=63), r"networks\.batch"),
        (lambda d: d["rows"][0].update(seeding="dp"), "tables have no replay"),
        (lambda d: d["rows"][2].update(interpolate=True), "interpolate is of tables"),
        (lambda d: d["rows"][2].update(replay="kept"), "replay kept, but seeding none"),
        (lambda d: d["rows"][6].update(margin=1.0), "allowed with replay kept"),
        (lambda d: d["rows"].append(dict(d["rows"][0], soc_min=[0.7])), r"q@0\.7 is there twice"),
        (lambda d: d["rows"][0].update(reward="speed"), "reward"),
        (lambda d: d["rows"][0].update(soc_bins=50), "are of networks"),
        (lambda d: d["networks"].update(warm_up=7000), r"networks\.warm_up: 7000.*preset smoke"),
        (lambda d: d["experts"].update(dp_share=0.8), r"experts\.rule_share: 0\.25"),
        (lambda d: d.update(soc_initial=0.95), r"soc_initial: 0\.95, allowed 0\.7\.\.0\.9"),
        (lambda d: d.update(soc_target=0.8), r"soc_target: 0\.8, allowed 0\.836\.\.0\.9 in row"),
        (lambda d: d.update(cycle="rotary_hoe_2001"), r"cycle: .*rotary_hoe_2001, a held-out"),
        (lambda d: d.update(cycle="planter_x"), "cycle: .*planter_x"),
        (lambda d: d["differences"][0].pop("why"), r"differences\.0\.why"),
    ],
)
def test_a_wrong_setting_is_refused_by_file_and_field(change, message, tmp_path: Path) -> None:
    path = changed(tmp_path, change)
    with pytest.raises(ConfigError, match=message) as refused:
        load_study(path, "smoke")
    assert str(path) in str(refused.value)
    assert "\n" not in str(refused.value)


def test_an_unknown_preset_is_refused_with_those_that_exist() -> None:
    with pytest.raises(ConfigError, match="preset 'fast', allowed smoke, standard, full"):
        load_study("paper", "fast")


def test_every_shaped_row_of_the_paper_is_there_at_both_soc_limits() -> None:
    rows = load_study("paper", "standard").rows
    shaped = [row for row in rows if row.id.startswith("ddqn_shaped") and row.role == "paper"]
    limits = {row.id: set() for row in shaped}
    for row in shaped:
        limits[row.id].add(row.soc_min)
    assert len(limits) == 4
    assert all(found == {0.70, 0.836} for found in limits.values())


def test_the_papers_own_numbers_are_used_where_it_prints_them() -> None:
    config = load_study("paper", "standard")
    assert config.networks.learning_rate == 0.001
    assert (config.networks.batch, config.replay_capacity) == (64, 200_000)
    assert (config.tables.soc_bins, config.tables.demand_bins) == (50, 766)
    assert config.budget.table_episodes == 100_000
    assert config.budget.seeds >= 5
    grid = [row for row in config.rows if row.role == "paper"]
    assert all(row.actions == 1600 for row in grid)
    assert all(row.soc_bins == 200 for row in grid if row.reward == "piecewise")
    assert all(row.epsilon_start == (0.5 if row.seeding != "none" else 1.0) for row in grid)


def test_every_difference_says_what_and_why() -> None:
    for item in load_study("paper", "smoke").differences:
        assert set(item) == {"subject", "kind", "paper", "here", "why"}
        assert "{" not in item["here"]
        assert all(item.values())
