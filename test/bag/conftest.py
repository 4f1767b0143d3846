"""Gives every test here that asks for ``bag`` each golden bag, or the user's own (``--bag``)."""

from pathlib import Path

import pytest

from tractor_ems.bags.check import CheckReport, check
from tractor_ems.bags.read import find_bags
from tractor_msgs_py.errors import BagError

GOLDEN = Path(__file__).resolve().parents[2] / "bags"
FOREIGN = {"vehicle_planter"}
"""Golden bags of other topics than the contract's."""


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    given = [Path(text) for text in metafunc.config.getoption("--bag")]
    if "bag" in metafunc.fixturenames:
        try:
            bags = find_bags(given or [GOLDEN])
            bags = bags if given else [bag for bag in bags if bag.name not in FOREIGN]
        except BagError as error:
            raise pytest.UsageError(f"--bag {error}") from None
        metafunc.parametrize("bag", bags, ids=[path.name for path in bags], scope="session")


@pytest.fixture(scope="session")
def golden_only(pytestconfig: pytest.Config) -> None:
    """Skips what only the golden bags promise."""
    if pytestconfig.getoption("--bag"):
        pytest.skip("about the golden bags, and --bag was given")


@pytest.fixture(scope="session")
def report(bag: Path) -> CheckReport:
    return check(bag)
