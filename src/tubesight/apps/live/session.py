"""A session from its options to its end: cameras, loop, recording."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import replace

from tubesight.apps.live.loop import Moment, run_live
from tubesight.apps.live.options import LiveOptions, Setup
from tubesight.apps.live.stats import Figures
from tubesight.apps.live.steering import Steering, steering_of
from tubesight.outputs.publish import Subscriber


def run_session(
    options: LiveOptions,
    setup: Setup,
    tell: Callable[[Moment], None] = lambda moment: None,
    subscribers: Sequence[Subscriber] = (),
    measuring: bool = True,
    steering: Steering | None = None,
) -> Figures:
    """Run the live loop, recording from the start where that is asked for; closes all subscribers.

    Parameters
    ----------
    steering
        What others may change meanwhile; nobody does where it is not given.

    Raises
    ------
    InputError
        If the recording cannot be made, or a camera gives no first picture.
    """
    steering = steering or steering_of(options, setup)
    recording = steering.recording
    with ExitStack() as stack:
        for subscriber in subscribers:
            stack.callback(subscriber.close)
        stack.callback(recording.close)
        if options.record is not None:
            recording.start(options.record)
        figures = run_live(options, setup, steering.switch, (*subscribers, recording), tell, recording.state, measuring)
        recording.stop()
        return replace(figures, recorded=recording.state())
