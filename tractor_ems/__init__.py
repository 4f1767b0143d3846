"""Energy management: policies, learning from bags, and the nodes and commands that run them."""

from tractor_ems.compiled import keep_apart
from tractor_msgs_py import __version__

__all__ = ["__version__"]

keep_apart()
