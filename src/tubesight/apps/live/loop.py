"""The live loop: cameras -> pairs -> shape -> track -> subscribers."""

from __future__ import annotations

import gc
import math
import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from types import FrameType
from typing import Any

from tubesight.apps.live.options import LiveOptions, Setup
from tubesight.apps.live.rig_watch import RigWatch
from tubesight.apps.live.stats import Figures, Stats
from tubesight.apps.switch import SensorSwitch
from tubesight.core import InputError
from tubesight.outputs.machine import give_back_memory
from tubesight.outputs.publish import Subscriber
from tubesight.sensor import ShapeSensor
from tubesight.simulate import render_pair
from tubesight.sources.jpeg import to_gray
from tubesight.sources.live import LiveCameras
from tubesight.sources.simulated import SIM_TUBE, sim_phantom
from tubesight.tracking.pairing import PairingRule
from tubesight.tracking.tracker import Tracked, Tracker
from tubesight.tracking.watch import CameraFault, Watched

# How long the loop waits for a pair before it looks after the cameras: a third of the least time in which a silent
# camera has to be flagged.
_TICK_S = 0.01
# Cameras that gave nothing so long after the start are not there.
_FIRST_S = 15.0
# Old objects are looked through and free memory is handed back this often, between two pairs; young objects are looked
# through after every pair.
_COLLECT_S = 10.0


@dataclass(frozen=True, slots=True, eq=False)
class Moment:
    """One turn of the loop, for the screen.

    Attributes
    ----------
    tracked
        The newest result.
    figures
        Computed when called: a screen needs them a few times a second only.
    """

    tracked: Tracked
    figures: Callable[[], Figures]


def run_live(
    options: LiveOptions,
    setup: Setup,
    switch: SensorSwitch,
    subscribers: Sequence[Subscriber] = (),
    tell: Callable[[Moment], None] = lambda moment: None,
    recorded: Callable[[], Mapping[str, Any]] = dict,
    measuring: bool = True,
) -> Figures:
    """Measure until the sources end, the time is over, or Ctrl-C.

    Parameters
    ----------
    switch
        What measures; a new sensor is taken from it between two pairs.
    subscribers
        Where results go; not closed here.
    tell
        Called after every result on this thread: has to be quick.
    recorded
        What the recorder has to say, for the figures.
    measuring
        Whether to measure: else pairs are passed on as they are.

    Raises
    ------
    InputError
        If a camera gives no first picture.
    """
    if measuring:
        warm_up(switch.current)
    rule = PairingRule(tuple(setup.sources), options.tolerance_s, options.offset_s)
    tracker = Tracker(options.filtered, designation=setup.designation())
    stats, watch = Stats(), RigWatch(setup.rig, setup.tube.clamped)
    with quiet_collector() as collect, _stop_signals() as stopped, LiveCameras(setup.sources, rule) as cameras:

        def figures() -> Figures:
            return stats.figures(cameras.counts(), recorded())

        with suppress(KeyboardInterrupt):
            for tracked in _results(options, cameras, tracker, watch, switch if measuring else None, stopped):
                stats.add(tracked)
                for subscriber in subscribers:
                    subscriber.publish(tracked)
                tell(Moment(tracked, figures))
                if cameras.idle:
                    collect()
        return replace(figures(), rig=watch.remarks())


def _results(
    options: LiveOptions,
    cameras: LiveCameras,
    tracker: Tracker,
    watch: RigWatch,
    switch: SensorSwitch | None,
    stopped: Callable[[], bool],
) -> Iterator[Tracked]:
    """Measure pairs as they come, and say when cameras fail and return."""
    start = time.monotonic()
    end = math.inf
    index, alive = 0, False
    last_faults: dict[str, CameraFault] = {}
    while not (cameras.ended and cameras.idle) and time.monotonic() < end and not stopped():
        pair = cameras.take(_TICK_S)
        now = time.monotonic()
        watched = cameras.watched()
        if not alive:
            _refuse_dead(watched, now - start)
            alive = pair is not None
            end = now + options.seconds if alive and options.seconds is not None else math.inf
        faults = {name: fault for name, w in watched.items() if (fault := w.fault(now)) is not None}
        # A source that came to its end is silent for good.
        if faults != last_faults and not cameras.ended:
            told = tracker.watch(faults, now)
            if told is not None:
                yield told
            last_faults = faults
        if pair is None or faults:
            continue
        if switch is None:
            yield Tracked(None, tracker.state, pair.time_s, pair.skew_s, pair=pair)
            continue
        if switch.adopt():
            watch.begin_anew(switch.current.tube.clamped)
            tracker.begin_anew()
        family = tracker.family
        tracked = tracker.step(switch.current(pair.pair(str(index)), family), pair)
        latency = time.monotonic() - pair.time_s
        moved = watch.add(tracked.result, pair.time_s) if tracked.result is not None else ""
        yield replace(tracked, latency_s=latency, late=latency > options.deadline_s, moved=moved, family=family)
        index += 1


def _refuse_dead(watched: Mapping[str, Watched], seconds: float) -> None:
    """Refuse to wait for a camera that never gave a picture."""
    silent = {name: w for name, w in watched.items() if math.isnan(w.arrived_s)}
    for name, w in silent.items():
        if w.failure and seconds > _FIRST_S / 10:
            raise InputError(f"{name}: {w.failure}")
    if silent and seconds > _FIRST_S:
        raise InputError(f"{next(iter(silent))}: gave no picture for {_FIRST_S:g} s; check the cable and the source")


def warm_up(sensor: ShapeSensor) -> None:
    """Measure a simulated tube, so that everything is compiled and loaded before the first camera runs.

    In colour and in gray: code is compiled for each kind of picture apart.
    """
    tube = sensor.tube if sensor.tube.diameter_mm is not None else SIM_TUBE
    with suppress(ValueError):
        pair = render_pair(sensor.rig, sim_phantom(0), tube, name="warm-up")
        for images in (pair.images, {name: to_gray(image) for name, image in pair.images.items()}):
            for _ in range(2):
                sensor(replace(pair, images=images))


@contextmanager
def quiet_collector() -> Iterator[Callable[[], None]]:
    """Keep the garbage collector from running when it likes (20 to 400 ms); gives what to call between two pairs."""
    gc.collect()
    gc.freeze()
    gc.disable()
    last = [time.monotonic()]

    def collect() -> None:
        if time.monotonic() - last[0] > _COLLECT_S:
            gc.collect()
            give_back_memory()
            last[0] = time.monotonic()
        else:
            gc.collect(0)

    try:
        yield collect
    finally:
        gc.enable()
        gc.unfreeze()


@contextmanager
def _stop_signals() -> Iterator[Callable[[], bool]]:
    """Let Ctrl-C and SIGTERM end the loop between two pairs; gives what tells whether one came.

    An exception could come anywhere, also where it is swallowed. A second Ctrl-C raises one all the same.
    """
    if threading.current_thread() is not threading.main_thread():
        yield lambda: False
        return
    asked = threading.Event()

    def stop(signum: int, frame: FrameType | None) -> None:
        if asked.is_set():
            raise KeyboardInterrupt
        asked.set()

    before = {number: signal.signal(number, stop) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield asked.is_set
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
