"""``ems cycle``: lists, generates and imports, with one JSON document or one line of refusal."""

import json

import numpy as np
import pytest

from tractor_ems.bags.in_process import record_in_process, write_samples_bag
from tractor_ems.cli import main
from tractor_ems.policies.rules import Conventional
from tractor_ems.scenario import make_scenario
from tractor_msgs_py.errors import CycleError
from tractor_msgs_py.types import PowerDemand
from tractor_sim.duty_cycle.cycle import cycle_hash
from tractor_sim.duty_cycle.cycle_csv import read_cycle_csv
from tractor_sim.duty_cycle.library import load_cycle

ROW = {"name", "operation", "split", "seed", "duration_s", "mean_w", "peak_w", "source"}
HEAD = "time_s,power_demand_w\n"


def document(capsys, *argv):
    assert main([*map(str, argv), "--json"]) == 0
    return json.loads(capsys.readouterr().out)


def refusal(capsys, *argv):
    assert main([*map(str, argv)]) == 2
    captured = capsys.readouterr()
    assert captured.out == "" and captured.err.count("\n") == 1, captured.err
    return captured.err


def test_rows_have_exactly_the_promised_keys_and_the_filters_filter(capsys):
    rows = document(capsys, "cycle", "list", "--set", "validation")["cycles"]
    assert all(set(row) == ROW for row in rows)
    assert {row["split"] for row in rows} == {"validation"}
    assert {"planter_1001", "planter_1012", "whtc", "iso8178_c1"} <= {r["name"] for r in rows}
    planters = document(capsys, "cycle", "list", "--operation", "planter")["cycles"]
    assert {row["operation"] for row in planters} == {"planter"}
    assert len(planters) == 99 + 12


def test_a_generated_planter_is_the_listed_one_and_its_file_the_same_bytes(capsys, tmp_path):
    first, second = tmp_path / "a.csv", tmp_path / "b.csv"
    row = document(capsys, "cycle", "generate", "planter", "--seed", 1001, "--out", first)
    document(capsys, "cycle", "generate", "planter", "--seed", 1001, "--out", second)
    assert first.read_bytes() == second.read_bytes()
    assert row["split"] == "validation"
    assert (
        cycle_hash(read_cycle_csv(first)) == row["hash"] == cycle_hash(load_cycle("planter_1001"))
    )


def test_a_file_that_exists_is_replaced_only_on_request(capsys, tmp_path):
    out = tmp_path / "mine.csv"
    out.write_text("precious")
    generate = ("cycle", "generate", "planter", "--seed", 5, "--out", out)
    assert "--force" in refusal(capsys, *generate)
    assert out.read_text() == "precious"
    document(capsys, *generate, "--force")
    assert len(read_cycle_csv(out)) == 766


def test_an_import_prints_its_account_and_writes_a_cycle_that_is_read_back(capsys, tmp_path):
    source, out = tmp_path / "log.csv", tmp_path / "cycle.csv"
    rows = [f"{k / 10:.1f},{1000 * k}" for k in range(100) if not 40 <= k < 60]
    source.write_text(HEAD + "\n".join([*rows[:3], "0.3,nan", *rows[3:]]) + "\n")
    account = document(capsys, "cycle", "import", source, "--out", out)
    assert account["rows_read"] == 81 and account["dropped_not_a_number"] == 1
    assert account["gaps_filled"] == 1 and account["first_dropped"].startswith("line 5")
    cycle = read_cycle_csv(out)
    assert cycle.dt_s == 1.0
    np.testing.assert_allclose(cycle.power_demand_w, 1000 * (10 * np.arange(10) + 4.5))


def test_a_ten_hertz_file_is_refused_with_the_way_out_and_driven_after_import(capsys, tmp_path):
    source, out = tmp_path / "fast.csv", tmp_path / "cycle.csv"
    source.write_text(HEAD + "".join(f"{k / 10:.1f},50000\n" for k in range(100)))
    with pytest.raises(CycleError, match=r"dt_s 0.1.*ems cycle import --dt 1 "):
        make_scenario("field", str(source))
    document(capsys, "cycle", "import", source, "--out", out)
    assert make_scenario("field", str(out)).cycle.power_demand_w.tolist() == [50e3] * 10


def test_pieces_are_numbered_and_none_is_written_over_another_file(capsys, tmp_path):
    source, out = tmp_path / "log.csv", tmp_path / "cycle.csv"
    source.write_text(HEAD + "0,1\n1,2\n100,3\n101,4\n")
    (tmp_path / "cycle_2.csv").write_text("precious")
    command = ("cycle", "import", source, "--out", out, "--split-gaps")
    assert "cycle_2.csv" in refusal(capsys, *command)
    assert not (tmp_path / "cycle_1.csv").exists()
    files = document(capsys, *command, "--force")["files"]
    assert [read_cycle_csv(path).power_demand_w.tolist() for path in map(tmp_path.joinpath, files)]


def test_a_bag_imports_to_the_demand_of_its_cycle_without_the_auxiliaries(capsys, tmp_path):
    source, out = tmp_path / "mine.csv", tmp_path / "cycle.csv"
    source.write_text(HEAD + "".join(f"{k},{50_000 + 100 * k}\n" for k in range(30)))
    scenario = make_scenario("field", str(source))
    assert scenario.params.p_aux_w > 0
    record_in_process(Conventional(), scenario, tmp_path / "bag")
    account = document(capsys, "cycle", "import", tmp_path / "bag", "--out", out)
    assert account["rows_kept"] == 30
    np.testing.assert_array_equal(
        read_cycle_csv(out).power_demand_w, read_cycle_csv(source).power_demand_w
    )


def demand_bag(path, demand):
    """A bag of demand alone, from (stamp [s], power [W])."""
    samples = [PowerDemand(round(stamp_s * 1e9), power_w) for stamp_s, power_w in demand]
    write_samples_bag(path, samples, {})
    return path


@pytest.mark.parametrize(
    ("options", "removed_w", "said"),
    [((), 0.0, "unknown, not removed"), (("--aux-w", "4000"), 4e3, "4000 W removed (--aux-w)")],
)
def test_a_bag_of_demand_alone_says_what_became_of_its_auxiliaries(
    capsys, tmp_path, options, removed_w, said
):
    bag = demand_bag(tmp_path / "bag", [(k, 50e3 + k) for k in range(1, 21)])
    out = tmp_path / "cycle.csv"
    account = document(capsys, "cycle", "import", bag, "--out", out, *options)
    assert account["auxiliaries"] == said
    assert account["auxiliaries_removed_w"] == removed_w
    expected = [50e3 + k - removed_w for k in range(1, 21)]
    assert read_cycle_csv(out).power_demand_w.tolist() == expected
    assert main(["cycle", "import", str(bag), "--out", str(out), "--force", *options]) == 0
    assert said in capsys.readouterr().out


def test_auxiliaries_are_not_taken_off_twice(capsys, tmp_path):
    source = tmp_path / "mine.csv"
    source.write_text(HEAD + "0,50000\n1,60000\n2,70000\n")
    bag, out = tmp_path / "bag", tmp_path / "cycle.csv"
    record_in_process(Conventional(), make_scenario("field", str(source)), bag)
    assert "announces auxiliaries of 4000 W" in refusal(
        capsys, "cycle", "import", bag, "--out", out, "--aux-w", "1"
    )
    account = document(capsys, "cycle", "import", bag, "--out", out)
    assert account["auxiliaries_removed_w"] == make_scenario("field", str(source)).params.p_aux_w
    account = document(capsys, "cycle", "import", source, "--out", tmp_path / "a.csv")
    assert account["auxiliaries_removed_w"] == 0
    document(capsys, "cycle", "import", source, "--out", tmp_path / "b.csv", "--aux-w", "1000")
    assert read_cycle_csv(tmp_path / "b.csv").power_demand_w.tolist() == [49e3, 59e3, 69e3]


def test_every_message_of_a_bag_is_in_the_account_and_the_first_dropped_has_its_number(
    capsys, tmp_path
):
    demand = [(k, 1e3 * k) for k in range(1, 41)]
    demand[6:6] = [(6.5, np.nan)]  # message 7
    demand[10:10] = [(demand[9][0], 7e3), (0, 5e3)]  # a repeat and a stamp that is not set
    demand[20] = (demand[20][0], 3e6)
    bag, out = demand_bag(tmp_path / "bag", demand), tmp_path / "cycle.csv"
    account = document(capsys, "cycle", "import", bag, "--out", out, "--max-dropped", "0.2")
    assert account["rows_read"] == 43 and account["rows_kept"] == 39
    assert account["first_dropped"] == ("message 7: not a number, time_s 5.5, power_demand_w nan")
    dropped = {
        k.removeprefix("dropped_"): v for k, v in account.items() if k.startswith("dropped_")
    }
    assert dropped == {
        "not_a_number": 1,
        "absurd_power": 1,
        "duplicate_time": 1,
        "time_backwards": 0,
    }
    assert account["refused"] == {"zero_stamp": 1}
    assert read_cycle_csv(out).power_demand_w.tolist() == [1e3 * k for k in range(1, 41)]


def test_a_bag_of_one_message_is_refused_with_its_place(capsys, tmp_path):
    bag = demand_bag(tmp_path / "bag", [(1, 5e3)])
    assert "bag: message 1: 1 usable rows of 1" in refusal(
        capsys, "cycle", "import", bag, "--out", tmp_path / "x.csv"
    )


@pytest.mark.parametrize(
    ("argv", "named"),
    [
        (["list", "--set", "test"], "'test', allowed train, validation, held-out"),
        (["list", "--operation", "ploughing"], "'ploughing'"),
        (["generate", "ploughing", "--seed", "1", "--out", "x.csv"], "chisel_plow"),
        (["generate", "planter", "--seed", "1", "--out", "x.txt"], "x.txt"),
        (["generate", "planter", "--seed", "-1", "--out", "x.csv"], "--seed"),
        (["generate", "planter", "--seed", "1", "--out", "x.csv", "--depth-cm", "5"], "planter"),
        (["import", "missing.csv", "--out", "x.csv"], "missing.csv"),
        (["import", "missing_bag", "--out", "x.csv"], "missing_bag"),
        (["import", "one.csv", "--out", "x.csv"], "one.csv: line 2: 1 usable rows of 1"),
        (
            ["import", "hex.csv", "--out", "x.csv"],
            "line 3: not a number, time_s 1, power_demand_w",
        ),
        (["import", "hex.csv", "--out", "x.csv"], "power_demand_w '0x10'"),
        (
            ["import", "one.csv", "--out", "x.csv", "--aux-w", "-1"],
            "aux_w: -1.0, allowed 0..2000000",
        ),
        (
            ["generate", "baler", "--seed", "1", "--out", "x.csv", "--duration-s", "1"],
            "--duration-s: 1, allowed 2..172800",
        ),
        (["import", "one.csv", "--out", "x.csv", "--dt", "0"], "dt_s"),
        (["show", "absurd.csv"], "absurd.csv:3: power_demand_w is 1e7, allowed -2000000..2000000"),
        (["show", "uneven.csv"], "uneven.csv:4: time_s is 3 after 1"),
    ],
)
def test_bad_input_is_refused_in_one_line(capsys, tmp_path, monkeypatch, argv, named):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "one.csv").write_text(HEAD + "0,5000\n")
    (tmp_path / "hex.csv").write_text(HEAD + "0,1\n1,0x10\n2,1\n")
    (tmp_path / "absurd.csv").write_text(HEAD + "0,1\n1,1e7\n2,1\n")
    (tmp_path / "uneven.csv").write_text(HEAD + "0,1\n1,1\n3,1\n4,1\n")
    assert named in refusal(capsys, "cycle", *argv)
    assert not (tmp_path / "x.csv").exists()
