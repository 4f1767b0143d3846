"""A ROS domain with a graph in this process and real nodes in others, for as long as it is wanted:
by the measuring scripts and by tests that share processes."""

import os
import signal
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import domain_coordinator
from nodes.conftest import BIN, Graph, Process

_STARTER = "import sys; from tractor_ems import executables; sys.exit(executables.{name}())"


class Stage:
    """A ROS domain of its own with a graph in this process and nodes in others."""

    def __init__(self, graph: Graph, folder: Path) -> None:
        self.graph, self.folder = graph, folder
        self._started: list[Process] = []

    def start(self, name: str, namespace: str = "", **parameters: Any) -> Process:
        """An executable with its parameters; ended with the stage at the latest."""
        command = [str(BIN / name)]
        if not (BIN / name).exists():  # an installation that is older than the node
            command = [sys.executable, "-c", _STARTER.format(name=name)]
        if parameters or namespace:
            command.append("--ros-args")
        if namespace:
            command += ["-r", f"__ns:={namespace}"]
        for key, value in parameters.items():
            command += ["-p", f"{key}:={value}"]
        self._started.append(Process(name, command, self.folder))
        return self._started[-1]

    def end(self, process: Process) -> int:
        """Terminate and reap; the exit code."""
        return process.end(signal.SIGTERM) if process.process.poll() is None else process.end()

    def tell(self) -> None:
        """What became of every node, for whoever looks for what went wrong."""
        for process in self._started:
            last = process.output.splitlines()[-3:]
            print(f"{process.name}: exit code {process.process.poll()}", *last, sep="\n    ")

    def close(self) -> None:
        """End what is left."""
        for process in self._started:
            if process.process.poll() is None:
                process.end(signal.SIGKILL)


@contextmanager
def stage() -> Iterator[Stage]:
    """A stage that nobody else on this machine hears."""
    with domain_coordinator.domain_id() as domain, tempfile.TemporaryDirectory() as folder:
        os.environ |= {
            "ROS_DOMAIN_ID": str(domain),
            "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
            "ROS_LOG_DIR": str(Path(folder) / "ros_log"),
        }
        os.environ.pop("ROS_LOCALHOST_ONLY", None)
        graph = Graph(domain, Path(folder))
        made = Stage(graph, Path(folder))
        try:
            yield made
        except BaseException:
            made.tell()
            raise
        finally:
            made.close()
            graph.close()
