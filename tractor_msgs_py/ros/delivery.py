"""Makes sure that messages have arrived before going on, in milliseconds instead of seconds.

A Fast DDS writer asks for acknowledgement every 3 s, and with each sample once its KEEP_LAST
history is full. Repeating a message is therefore the quick way to be acknowledged (measured:
0.1-0.2 s instead of up to 3); readers of this wire contract drop repetitions. Each repetition
wants an acknowledgement of its own, so the pauses grow for the sake of a loaded machine.
"""

from collections.abc import Iterable
from typing import Any

from rclpy.duration import Duration
from rclpy.publisher import Publisher

FIRST_PAUSE_S = 0.02
GROWTH = 1.1
LONGEST_PAUSE_S = 0.5


class Delivery:
    """Repeats one message per publisher until every subscriber has acknowledged it."""

    def __init__(self, messages: Iterable[tuple[Publisher, Any]]) -> None:
        self._unheard = list(messages)
        self._pause_s = FIRST_PAUSE_S
        self._due_s = 0.0

    def complete(self, now_s: float) -> bool:
        """True once all are acknowledged; else repeats what is not, when it is time to."""
        nothing_s = Duration()
        self._unheard = [m for m in self._unheard if not m[0].wait_for_all_acked(nothing_s)]
        if self._unheard and now_s >= self._due_s:
            self._due_s = now_s + self._pause_s
            self._pause_s = min(GROWTH * self._pause_s, LONGEST_PAUSE_S)
            for publisher, msg in self._unheard:
                publisher.publish(msg)
        return not self._unheard
