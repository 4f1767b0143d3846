"""A cycle in CSV is read to the bit or refused by file, line and value."""

import numpy as np
import pytest

from tractor_msgs_py.errors import CycleError
from tractor_sim.duty_cycle.cycle import DEMAND_LIMIT_W, DutyCycle, cycle_hash
from tractor_sim.duty_cycle.cycle_csv import read_cycle_csv, write_cycle_csv

HEAD = "time_s,power_demand_w\n"


def write(tmp_path, text):
    path = tmp_path / "mine.csv"
    path.write_text(text)
    return path


def test_a_csv_cycle_is_read_and_negative_demand_is_valid(tmp_path):
    cycle = read_cycle_csv(write(tmp_path, f"{HEAD}0,1000\n0.5,-2000\n1.0,3000\n"))
    assert cycle.dt_s == 0.5
    assert cycle.power_demand_w.tolist() == [1000.0, -2000.0, 3000.0]


def test_other_columns_and_a_byte_order_mark_do_no_harm(tmp_path):
    text = "\ufefftime_s,note,power_demand_w\n0,a,1\n1,b,2\n"
    assert read_cycle_csv(write(tmp_path, text)).power_demand_w.tolist() == [1.0, 2.0]


def test_times_since_1970_are_even_enough(tmp_path):
    rows = "\n".join(f"{1_700_000_000 + k / 10:.1f},{1000 * k}" for k in range(300))
    assert read_cycle_csv(write(tmp_path, f"{HEAD}{rows}\n")).dt_s == 0.1


def test_what_is_written_is_read_to_the_bit(tmp_path):
    demand_w = np.array([1 / 3, -0.1, 1e5, 123456.789e-7, 0.0])
    cycle = DutyCycle("mine", demand_w, 0.1, "csv")
    write_cycle_csv(tmp_path / "mine.csv", cycle)
    assert cycle_hash(read_cycle_csv(tmp_path / "mine.csv")) == cycle_hash(cycle)


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("", "0 rows"),
        (HEAD, "0 rows"),
        (f"{HEAD}0,5\n", "mine.csv:2: 1 row,"),
        ("time_s,power_w\n0,1\n1,2\n", "mine.csv:1: column power_demand_w"),
        (f"{HEAD}0,1\n1,nan\n", "mine.csv:3: power_demand_w is nan"),
        (f"{HEAD}0,1\n1,inf\n", "mine.csv:3: power_demand_w is inf"),
        (
            f"{HEAD}0,1\n1,-2e9\n",
            "mine.csv:3: power_demand_w is -2e9, allowed -2000000..2000000 W",
        ),
        (f"{HEAD}0,1\n1,2000001\n", "mine.csv:3: power_demand_w is 2000001, allowed"),
        ("time_s,power_demand_w,power_demand_w\n0,1,2\n", "power_demand_w is there 2 times"),
        ("time_s;power_demand_w\n0;1\n1;2\n", "separated by ';', must be a comma"),
        ("time_s,power_w\n0,1\n", "has 'time_s,power_w'"),
        (f"{HEAD}0,1\n1,2\n1e18,3\n", "mine.csv:4: time_s is 1e+18 after 1"),
        (f"{HEAD}0,1\n1e9,2\n2e9,3\n", "mine.csv:3: time_s advances by 1e+09, allowed"),
        (f"{HEAD}0,1\n1,2\n1,3\n", "mine.csv:4: time_s is 1 after 1"),
        (f"{HEAD}0,1\nnan,1\n", "mine.csv:3: time_s is nan"),
        (f"{HEAD}0,1\n1,abc\n", "'abc'"),
        (f"{HEAD}0,1\n1,\n", "mine.csv:3"),
        (f"{HEAD}0,1\n1\n", "mine.csv:3"),
        (f"{HEAD}0,1\n1,2\n2,2\n4,4\n", "mine.csv:5: time_s is 4 after 2"),
        (f"{HEAD}0,1\n1,2\n1,2\n2,4\n", "mine.csv:4: time_s is 1 after 1"),
        (f"{HEAD}1,1\n0,2\n", "mine.csv:3: time_s is 0 after 1"),
    ],
)
def test_a_malformed_csv_is_refused_by_line(tmp_path, text, named):
    with pytest.raises(CycleError) as caught:
        read_cycle_csv(write(tmp_path, text))
    assert named in str(caught.value)
    assert "\n" not in str(caught.value)


def test_an_uneven_csv_is_refused_with_the_way_out(tmp_path):
    with pytest.raises(CycleError, match="ems cycle import"):
        read_cycle_csv(write(tmp_path, f"{HEAD}0,1\n1,2\n1.5,3\n"))


def test_demand_up_to_the_limit_is_read(tmp_path):
    text = f"{HEAD}0,{-DEMAND_LIMIT_W}\n1,{DEMAND_LIMIT_W}\n"
    expected = [-DEMAND_LIMIT_W, DEMAND_LIMIT_W]
    assert read_cycle_csv(write(tmp_path, text)).power_demand_w.tolist() == expected


@pytest.mark.parametrize("text", ["x" * 5000 + "\n1\n", f"{HEAD}0,1\n1,{'y' * 5000}\n"])
def test_a_long_foreign_text_is_cut_in_the_message(tmp_path, text):
    with pytest.raises(CycleError) as caught:
        read_cycle_csv(write(tmp_path, text))
    shown = max(str(caught.value).count("x"), str(caught.value).count("y"))
    assert 60 < shown < 90


def test_a_cycle_of_one_sample_is_not_written_as_no_reader_could_know_its_step(tmp_path):
    with pytest.raises(CycleError, match=r"one.csv: cycle mine has 1 sample"):
        write_cycle_csv(tmp_path / "one.csv", DutyCycle("mine", np.ones(1), 1.0, "csv"))
    assert not (tmp_path / "one.csv").exists()
