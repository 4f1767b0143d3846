"""``ems``: one command, subcommands in the modules of this folder.

Exit codes: 0 done, 2 bad input, 3 run aborted, 130 interrupted. With ``--json`` stdout carries
one JSON document and nothing else.
"""

import sys
from collections.abc import Sequence

from tractor_msgs_py.errors import TractorEmsError

_LISTS = ("--bags", "--rule-bags")


def main(argv: Sequence[str] | None = None) -> int:
    """Run ``ems`` and return its exit code."""
    from tractor_ems.cli.app import app

    try:
        args = _spread(sys.argv[1:] if argv is None else argv)
        code = app(args=args, standalone_mode=False)
        return code if isinstance(code, int) else 0
    except TractorEmsError as error:
        print(f"ems: {' '.join(str(error).split())}", file=sys.stderr)
        return error.exit_code
    except KeyboardInterrupt:
        print("ems: interrupted", file=sys.stderr)
        return 130
    except Exception as error:  # typer's usage errors, whichever click they come from
        if type(error).__name__ == "Abort":
            return 130
        if not hasattr(error, "format_message"):
            raise
        print(f"ems: {error.format_message()}", file=sys.stderr)
        return int(getattr(error, "exit_code", 2))


def _spread(argv: Sequence[str]) -> list[str]:
    """``--bags A B`` as ``--bags A --bags B``: typer's options take one value each."""
    spread: list[str] = []
    option = ""
    for word in argv:
        if word.startswith("-"):
            option = word if word in _LISTS else ""
        elif option and spread[-1] != option:
            spread.append(option)
        spread.append(word)
    return spread
