"""The viewer as a subscriber of a live session."""

from __future__ import annotations

from tubesight.apps.live.publishing import result_of
from tubesight.apps.live.steering import Steering
from tubesight.apps.viewer.controls import controls_of
from tubesight.apps.viewer.viewer import Viewer
from tubesight.tracking.tracker import Tracked


class ViewerSubscriber:
    """Shows live results in the browser, where the session is steered too.

    Parameters
    ----------
    steering
        The sensor, and the recording.
    port
        Of the page.
    """

    def __init__(self, steering: Steering, port: int) -> None:
        sensor = steering.switch.current
        self._viewer = Viewer(sensor.rig, sensor.tube, port, controls_of(steering.switch, steering.recording))
        self._viewer.__enter__()
        self.address = self._viewer.address

    @property
    def windows(self) -> int:
        """Browser windows that show it now."""
        return len(self._viewer.server.get_clients())

    def publish(self, tracked: Tracked) -> None:
        """Hand a result over; returns at once."""
        remarks = [str(tracked.state), *tracked.notes]
        if tracked.result is not None:
            result = tracked.result
            remarks.insert(0, f"{result.total_ms:.1f} ms, latency {1e3 * tracked.latency_s:.1f} ms, {result.method}")
        pair = tracked.pair.pair("") if tracked.pair is not None else None
        self._viewer.publish(result_of(tracked), pair, tracked.time_s, "; ".join(remarks))

    def close(self) -> None:
        """End the page."""
        self._viewer.__exit__()
