"""Statistics, verdicts and page of the held-out study, on rows whose truth is known."""

import json

import numpy as np
import pytest
from study import held_out_rows as made

from tractor_ems.study.figures.held_out import FIGURES
from tractor_ems.study.held_out_report import page_of, write_report
from tractor_ems.study.held_out_results import read_results, results_of, write_results
from tractor_ems.study.held_out_statistics import (
    analyse,
    draw_cycles,
    improvement,
    scores_of,
    summary,
)
from tractor_msgs_py.errors import ConfigError


@pytest.fixture(scope="module")
def results():
    return made.results()


def rng():
    return np.random.Generator(np.random.PCG64(1))


def verdict(results, bar):
    (found,) = [item for item in results["verdicts"] if item["bar"] == bar]
    return found


def rows_of(**scores):
    return [
        made.row(name, seed, "light", n, values[n])
        for name, by_seed in scores.items()
        for seed, values in enumerate(by_seed)
        for n in range(len(values))
    ]


def test_the_data_holds_what_the_field_promises_of_every_policy(results):
    for name in made.SCORES:
        found = results["policies"][name]
        assert {"median", "iqm", "worst", "ci95", "starts_per_h"} <= set(found)
        assert found["ci95"][0] <= found["iqm"] <= found["ci95"][1]
        assert ("improvement_over_a_ecms" in found) == (name != "a_ecms")


def test_a_run_without_a_score_counts_as_zero_and_is_told_apart():
    rows = rows_of(a=[[0.99, 0.98, 0.97]])
    rows[1]["dp_ratio"] = None
    found = summary(scores_of(rows)["a"], rng(), 50)
    assert (found["worst"], found["failed"], found["runs"]) == (0.0, 1, 3)
    assert found["worst_finished"] == pytest.approx(0.97 - 2e-4)


def test_improvement_is_paired_by_cycle():
    # On every cycle the first is a little better; between cycles scores differ by much more.
    rows = rows_of(a=[[0.91, 0.95, 0.99]], b=[[0.90, 0.94, 0.98]])
    scores = scores_of(rows)
    found = improvement(scores["a"], scores["b"], rng(), 100)
    assert (found.value, found.low, found.high) == (1.0, 1.0, 1.0)


def test_ties_count_half():
    scores = scores_of(rows_of(a=[[0.9, 0.9, 0.9]], b=[[0.9, 0.9, 0.9]]))
    found = improvement(scores["a"], scores["b"], rng(), 100)
    assert (found.value, found.low, found.high) == (0.5, 0.5, 0.5)


def test_a_seed_that_fails_widens_the_interval():
    scores = scores_of(rows_of(a=[[0.95] * 4, [0.95] * 4, [0.5] * 4], b=[[0.9] * 4]))
    found = improvement(scores["a"], scores["b"], rng(), 500)
    assert found.value == pytest.approx(2 / 3)
    assert found.low < 0.4 and found.high == 1.0


def test_cycles_are_drawn_within_their_operation():
    operation = np.array([0, 0, 1, 1, 1])
    drawn = draw_cycles(operation, rng(), 200)
    assert np.array_equal(operation[drawn], np.broadcast_to(operation, drawn.shape))
    assert len(np.unique(drawn[:, 0])) == 2


def test_a_missing_run_is_refused():
    with pytest.raises(ConfigError, match="rows of a"):
        scores_of(rows_of(a=[[0.9, 0.9], [0.9, 0.9]])[:-1])


def test_equal_rows_give_equal_figures():
    rows = made.found_rows()["rows"]
    assert analyse(rows, ["sdp"], 50) == analyse(rows, ["sdp"], 50)


def test_good_runs_meet_every_bar_but_the_hoped_for_median(results):
    missed = [item["bar"] for item in results["verdicts"] if not item["met"]]
    assert missed == ["median dp_ratio (hoped for)"]


def test_a_missed_bar_is_shown_as_missed():
    results = made.results(ddqn_counterfactual=0.9949)
    assert not verdict(results, "median dp_ratio")["met"]
    assert not verdict(results, "not worse than sdp overall")["met"]
    assert verdict(results, "worst dp_ratio")["met"]
    page = page_of(results, "held_out", {f"{name}.png": "" for name in FIGURES})
    (line,) = [x for x in page.splitlines() if x.startswith("| median dp_ratio |")]
    assert line.endswith("| **missed** |")


@pytest.mark.parametrize(
    ("change", "bar"),
    [
        ({"dp_ratio": None, "shortfall_j": 2e3}, "worst dp_ratio"),
        ({"violations": 1}, "violations of SOC, power and ramp limits"),
        ({"soc_final": 0.601}, "largest |final SOC - target|"),
        ({"engine_starts": 900}, "engine starts over sdp's"),
    ],
)
def test_one_bad_run_of_the_subject_misses_its_bar(change, bar):
    found = made.found_rows()
    found["rows"][0] |= change
    assert not verdict(results_of(found), bar)["met"]


def test_slow_training_misses_its_bar():
    found = made.found_rows()
    found["training"][3]["seconds"] = 301.0
    assert not verdict(results_of(found), "seconds from bags to policy file, slowest seed")["met"]


def test_losing_more_than_never_stop_is_told_for_each_disturbance(results):
    own = results["robustness"]["ddqn_counterfactual"]
    assert own["delay_1"]["loss"] == pytest.approx(0.001)
    assert own["delay_1"]["no_worse"] and not own["noise"]["no_worse"]
    bar = "disturbances that cost no more than they cost never_stop_ecms"
    assert verdict(results, bar)["found"] == "1 of 2"


def test_a_failed_run_is_worse_whatever_the_others_lose():
    found = made.found_rows()
    for row in found["robustness_rows"]:
        if (row["policy"], row["disturbance"]) == ("ddqn_counterfactual", "delay_1"):
            row["dp_ratio"] = None if row["cycle"] == "light_0" else 0.997
    cell = results_of(found)["robustness"]["ddqn_counterfactual"]["delay_1"]
    assert (cell["failed"], cell["no_worse"]) == (1, False)


def test_the_page_is_made_again_from_its_data_alone(results, tmp_path):
    data = write_report(results, tmp_path / "held_out.md")
    page = (tmp_path / "held_out.md").read_text()
    captions = {f"{name}.png": caption for name, (_, caption) in FIGURES.items()}
    assert page_of(read_results(data), "held_out", captions) == page
    write_results(tmp_path / "again.json", read_results(data))
    assert (tmp_path / "again.json").read_bytes() == data.read_bytes()
    figures = sorted(path.name for path in (tmp_path / "held_out").iterdir())
    assert "robustness.png" in figures and len(figures) == 7


def test_figures_follow_from_rows_not_from_what_the_file_claims(results, tmp_path):
    path = tmp_path / "held_out.json"
    write_results(path, results)
    document = json.loads(path.read_text())
    document["policies"]["ddqn_counterfactual"]["median"] = 1.0
    document["verdicts"] = []
    path.write_text(json.dumps(document))
    assert read_results(path)["policies"] == results["policies"]
    assert read_results(path)["verdicts"] == results["verdicts"]


def test_a_file_that_is_no_results_is_refused(tmp_path):
    path = tmp_path / "other.json"
    path.write_text("{}")
    with pytest.raises(ConfigError, match=r"other.json"):
        read_results(path)
