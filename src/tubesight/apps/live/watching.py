"""The viewer as a subscriber of a live session."""

from __future__ import annotations

from tubesight.apps.live.options import Setup
from tubesight.apps.live.publishing import result_of
from tubesight.apps.viewer.viewer import Viewer
from tubesight.tracking.tracker import Tracked


class ViewerSubscriber:
    """Shows live results in the browser.

    Parameters
    ----------
    setup
        Rig and tube.
    port
        Of the page.
    """

    def __init__(self, setup: Setup, port: int) -> None:
        self._viewer = Viewer(setup.rig, setup.tube, port)
        self._viewer.__enter__()
        self.address = self._viewer.address

    def publish(self, tracked: Tracked) -> None:
        """Hand a result over; returns at once."""
        remarks = [str(tracked.state), *tracked.notes]
        if tracked.result is not None:
            remarks.insert(0, f"{tracked.result.total_ms:.1f} ms, latency {1e3 * tracked.latency_s:.1f} ms")
        pair = tracked.pair.pair("") if tracked.pair is not None else None
        self._viewer.publish(result_of(tracked), pair, tracked.time_s, "; ".join(remarks))

    def close(self) -> None:
        """End the page."""
        self._viewer.__exit__()
