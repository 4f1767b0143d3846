"""``ems tune sdp``: from recorded demand to a policy file that drives."""

import json

import numpy as np
import pytest

from tractor_ems.bags.in_process import write_demand_bag
from tractor_ems.cli import main
from tractor_ems.drive import drive
from tractor_ems.optimal.sdp_fit import SdpSettings
from tractor_ems.policies.made import load_made
from tractor_ems.tuning.sdp_bags import sdp_of_bags, sdp_settings
from tractor_ems.tuning.squeeze import squeezed
from tractor_msgs_py.errors import BagError, ConfigError
from tractor_sim.config import load_powertrain

FIELD = load_powertrain("field")
WORK_W = np.where(np.arange(300) % 100 < 60, 30e3, 120e3)


@pytest.fixture
def bag(tmp_path):
    """A recording of demand alone."""
    stamps = 1_700_000_000_000_000_000 + 1_000_000_000 * np.arange(len(WORK_W))
    write_demand_bag(tmp_path / "bag", stamps, WORK_W)
    return tmp_path / "bag"


def test_squeezed_work_keeps_its_auxiliaries_and_is_repeated():
    short_w = squeezed(WORK_W, 4e3, 0.5, 0.5)
    assert len(short_w) == 1800
    assert short_w.min() == pytest.approx(4e3 + 0.5 * 26e3)
    assert np.array_equal(short_w[:150], short_w[150:300])


@pytest.mark.parametrize(
    ("given", "named"),
    [
        ({"gain": 1.0}, "gain: unknown"),
        ({"planned": False}, "planned: unknown"),
        ({"price": "dear"}, "price: 'dear'"),
        ({"slow": 3.0}, "slow: 3.0"),
        ({"sweeps": 1.5}, "sweeps: 1.5"),
        ({"end_kg": -1.0}, "end_kg: -1.0"),
    ],
)
def test_a_wrong_setting_is_refused_by_name(given, named):
    with pytest.raises(ConfigError, match=named):
        sdp_settings(FIELD, planned=True, given=given)


def test_bags_of_another_step_are_refused(bag):
    with pytest.raises(BagError, match="dt_s"):
        sdp_of_bags([bag], load_powertrain("field:dt_s=0.5"))


@pytest.mark.slow
def test_equal_bags_give_equal_policies_with_their_provenance(bag, tmp_path, capsys):
    first, second = tmp_path / "1.safetensors", tmp_path / "2.safetensors"
    for path in (first, second):
        command = ["tune", "sdp", "--bags", str(bag), "--out", str(path), "--unplanned"]
        assert main([*command, "--json"]) == 0
        report = json.loads(capsys.readouterr().out)
    one, two = load_made(first), load_made(second)
    assert np.array_equal(one.value_kg, two.value_kg)
    assert one.name == report["name"] == "sdp_unplanned"
    assert one.metadata["bag_hashes"] == report["bags"] and len(report["bags"]) == 1
    assert one.metadata["envelope"]["power_demand_w"] == [30e3, 120e3]
    (run,) = drive(one, FIELD, WORK_W[None, :], 0.55, 0.55)
    assert run.shortfall_j.sum() == 0.0


@pytest.mark.slow
def test_squeezed_demand_is_counted_beside_the_recorded(bag):
    settings = SdpSettings(planned=False, sweeps=2, varied=3.0)
    plain = sdp_of_bags([bag], FIELD, SdpSettings(planned=False, sweeps=2))
    more = sdp_of_bags([bag], FIELD, settings)
    assert more.number.max() > plain.number.max()
    assert more.filters == plain.filters, "the prior is the mean of what was recorded"
