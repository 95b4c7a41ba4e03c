"""Where live results go: subscribers that never make the measurement wait."""

from __future__ import annotations

import threading
from typing import Protocol

from tubesight.tracking.tracker import Tracked


class Subscriber(Protocol):
    """Takes live results. `publish` returns at once, whatever becomes of them."""

    def publish(self, tracked: Tracked) -> None:
        """Take one result; called by the measuring thread, must neither block nor raise."""

    def close(self) -> None:
        """Finish; may take up to a second."""


class Mailbox:
    """A subscriber with one slot for another thread to empty: the newest result, older ones are replaced."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._newest: Tracked | None = None
        self._closed = False

    def publish(self, tracked: Tracked) -> None:
        """Put a result into the slot, in the place of what was not taken yet."""
        with self._changed:
            self._newest = tracked
            self._changed.notify_all()

    def take(self, timeout_s: float) -> Tracked | None:
        """Wait for a result not taken yet; None where none comes in time or the mailbox is closed."""
        with self._changed:
            self._changed.wait_for(lambda: self._newest is not None or self._closed, timeout_s)
            newest, self._newest = self._newest, None
            return newest

    def close(self) -> None:
        """Wake whoever waits."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
