"""Options of the whole suite. Here, and not beside the tests that use them: pytest takes options
only from the conftest files it finds before it looks for tests, and this one it always finds."""

import pytest


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--bag",
        action="append",
        default=[],
        metavar="PATH",
        help="check this bag, or every bag below this folder, instead of the golden ones; "
        "may be given several times",
    )
