"""What a file says about the process that made it, without a path of the machine.

Recorder, plant and training all name their command line by the same rule.
"""

import shlex
import sys
from pathlib import Path


def command_line() -> str:
    """This process's command line as a shell would take it; the program without its folder."""
    return shlex.join([Path(sys.argv[0]).name, *sys.argv[1:]])
