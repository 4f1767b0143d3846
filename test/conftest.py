"""Options and the order of the whole suite. Here, and not beside the tests that use them: pytest
takes them only from the conftest files it finds before it looks for tests, and this one it always
finds."""

from typing import Any

import hypothesis
import pytest

# How long an example takes says how busy the machine is, and the first one loads libraries.
hypothesis.settings.register_profile("timeless", deadline=None)
hypothesis.settings.load_profile("timeless")

ROS_PROCESSES = (
    "test/bags/test_bag_recorder.py",
    "test/bags/test_sigkill.py",
    "test/cli/test_demo.py",
    "test/evaluate/test_evaluate_set.py",
    "test/evaluate/test_parity.py",
    "test/learning/test_trainer_node.py",
    "test/nodes/",
    "test/package/test_installation.py",
)
"""Files and folders whose tests start nodes as processes, which need the second core."""


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--bag",
        action="append",
        default=[],
        metavar="PATH",
        help="check this bag, or every bag below this folder, instead of the golden ones; "
        "may be given several times",
    )


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """With ``--dist loadfile`` a file's tests share a worker, and all that start nodes share one:
    no two graphs of processes run at a time."""
    if config.getvalue("dist") != "loadfile":
        return None
    from xdist.scheduler import LoadFileScheduling

    class OneGraphAtATime(LoadFileScheduling):
        def _split_scope(self, nodeid: str) -> str:
            return "ros" if nodeid.startswith(ROS_PROCESSES) else super()._split_scope(nodeid)

    return OneGraphAtATime(config, log)
