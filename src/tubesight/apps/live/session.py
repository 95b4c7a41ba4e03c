"""A session from its options to its end: cameras, loop, recording."""

from __future__ import annotations

import base64
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import replace
from datetime import UTC, datetime
from typing import Any

import cv2

from tubesight import __version__
from tubesight.apps.live.loop import Moment, run_live
from tubesight.apps.live.options import LiveOptions, Setup
from tubesight.apps.live.stats import Figures
from tubesight.files.nested import plain
from tubesight.files.recording import FORMAT
from tubesight.files.tube import tube_text
from tubesight.outputs.machine import machine
from tubesight.outputs.mcap_file import McapFile
from tubesight.outputs.publish import Subscriber
from tubesight.outputs.recorder import Recorder


def run_session(
    options: LiveOptions,
    setup: Setup,
    tell: Callable[[Moment], None] = lambda moment: None,
    subscribers: Sequence[Subscriber] = (),
    measuring: bool = True,
) -> Figures:
    """Run the live loop, with a recorder where one is asked for; closes all subscribers.

    Raises
    ------
    InputError
        If the recording cannot be made, or a camera gives no first picture.
    """
    with ExitStack() as stack:
        for subscriber in subscribers:
            stack.callback(subscriber.close)
        if options.record is None:
            return run_live(options, setup, subscribers, tell, measuring=measuring)
        file = McapFile(options.record.path)
        recorder = Recorder(file, configuration(options, setup), options.record.pictures, options.record.every)
        stack.callback(recorder.close)
        figures = run_live(options, setup, (*subscribers, recorder), tell, recorder.state, measuring)
        recorder.close()
        return replace(figures, recorded=recorder.state())


def configuration(options: LiveOptions, setup: Setup) -> dict[str, Any]:
    """Collect what made the results: a recording is measured again from it alone."""
    record = options.record
    return {
        "format": FORMAT,
        "version": __version__,
        "started": datetime.now(UTC).isoformat(timespec="seconds"),
        "sources": {name: source.name for name, source in setup.sources.items()},
        "rig": setup.rig_text,
        "tube": tube_text(setup.tube),
        "method": setup.method,
        "base_px": plain(setup.base_px),
        "tip_px": plain(setup.tip_px),
        "backgrounds": {
            name: base64.b64encode(cv2.imencode(".png", image)[1].tobytes()).decode()
            for name, image in setup.backgrounds.items()
        },
        "gray": options.gray,
        "filtered": options.filtered,
        "tolerance_s": options.tolerance_s,
        "offset_s": dict(options.offset_s),
        "deadline_s": options.deadline_s,
        "pictures": record.pictures if record is not None else "none",
        "every": record.every if record is not None else 1,
        "machine": machine(),
    }
