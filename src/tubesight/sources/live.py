"""All cameras of a rig at once: a thread each, pairs of one instant, the newest first."""

from __future__ import annotations

import math
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

from tubesight.core import Frame, Image, InputError
from tubesight.sources.integrity import BUFFERS, Wholeness, sampled, wholeness
from tubesight.sources.reader import BrokenPictureError, Picture, Reader, Source
from tubesight.tracking.pairing import Matched, PairingRule, Refusal, Waiting, offer
from tubesight.tracking.watch import Watched, arrived, failed

# A camera that is gone is tried again so often: a USB camera is back 0.5 to 1 s after it is plugged in.
_AGAIN_S = 0.25
# Two instants are further apart than this share of a frame time less the jitter of the times.
_TOLERANCE_FRAMES = 0.45
# So many damaged pictures in a row are a camera that does not work; single ones are a busy network.
_BROKEN_MAX = 30
# Pictures of a folder carry no times; they are shown so many times a second.
_STILLS_HZ = 30.0
# How long closing waits for a reader that hangs in its driver.
_CLOSE_S = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class CameraCounts:
    """Pictures of one camera so far: all that arrived, and those in no pair by reason."""

    arrived: int
    refused: Mapping[Refusal, int]


class LiveCameras:
    """Reads cameras on their own threads and pairs their pictures; at most one pair waits, the newest.

    Parameters
    ----------
    sources
        By camera name.
    rule
        How pictures are paired; its tolerance is lowered to 0.45 of the shortest frame time.
    """

    def __init__(self, sources: Mapping[str, Source], rule: PairingRule) -> None:
        self._rule = rule
        self._changed = threading.Condition()
        self._waiting = Waiting()
        self._queued: Matched | None = None
        self._watched = {name: Watched() for name in sources}
        self._counts: Counter[tuple[str, Refusal | None]] = Counter()
        self._ended: set[str] = set()
        self._stop = threading.Event()
        self._first_s: float | None = None
        self._threads = [
            # A driver may hang for ever in a call: a daemon does not keep the program.
            threading.Thread(target=_Camera(name, source, self).run, name=f"camera {name}", daemon=True)
            for name, source in sources.items()
        ]
        for thread in self._threads:
            thread.start()

    def take(self, timeout_s: float) -> Matched | None:
        """Wait for a pair that was not taken yet; None where none comes in time."""
        with self._changed:
            self._changed.wait_for(lambda: self._queued is not None or self.ended, timeout_s)
            matched, self._queued = self._queued, None
            return matched

    @property
    def idle(self) -> bool:
        """Whether no pair waits."""
        return self._queued is None

    @property
    def ended(self) -> bool:
        """Whether every source came to its end."""
        return len(self._ended) == len(self._watched)

    def watched(self) -> dict[str, Watched]:
        """Return what is known of each camera."""
        with self._changed:
            return dict(self._watched)

    def counts(self) -> dict[str, CameraCounts]:
        """Pictures so far, by camera."""
        with self._changed:
            return {
                name: CameraCounts(
                    self._counts[name, None], {r: self._counts[name, r] for r in Refusal if self._counts[name, r]}
                )
                for name in self._watched
            }

    def set_offsets(self, offset_s: Mapping[str, float]) -> None:
        """Take constant delays off the cameras' times from now on."""
        with self._changed:
            self._rule, self._waiting = replace(self._rule, offset_s=dict(offset_s)), Waiting()

    def close(self) -> None:
        """Stop reading; waits a second at most."""
        self._stop.set()
        deadline = time.monotonic() + _CLOSE_S
        for thread in self._threads:
            thread.join(max(deadline - time.monotonic(), 0.0))

    def __enter__(self) -> LiveCameras:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    # Called by the cameras' threads.

    def _arrived(self, frame: Frame, state: Wholeness) -> None:
        with self._changed:
            name = frame.camera
            self._counts[name, None] += 1
            if state is Wholeness.TORN:
                self._counts[name, Refusal.TORN] += 1
                return
            self._watched[name] = arrived(self._watched[name], time.monotonic(), state is Wholeness.REPEATED)
            if state is Wholeness.REPEATED:
                self._counts[name, Refusal.FROZEN] += 1
                return
            periods = [w.period_s for w in self._watched.values() if math.isfinite(w.period_s)]
            tolerance = min([self._rule.tolerance_s, *(_TOLERANCE_FRAMES * p for p in periods)])
            self._waiting, matched, refused = offer(replace(self._rule, tolerance_s=tolerance), self._waiting, frame)
            for out, reason in refused:
                self._counts[out.camera, reason] += 1
            if matched is not None:
                if self._queued is not None:
                    for superseded in self._queued.frames:
                        self._counts[superseded, Refusal.SUPERSEDED] += 1
                self._queued = matched
                self._changed.notify_all()

    def _start_s(self) -> float:
        """When stored pictures of all cameras began to be shown."""
        with self._changed:
            if self._first_s is None:
                self._first_s = time.monotonic()
            return self._first_s

    def _skipped(self, name: str, count: int) -> None:
        with self._changed:
            self._counts[name, None] += count
            self._counts[name, Refusal.SUPERSEDED] += count

    def _broken(self, name: str) -> None:
        with self._changed:
            self._counts[name, None] += 1
            self._counts[name, Refusal.BROKEN] += 1

    def _failed(self, name: str, reason: str) -> None:
        with self._changed:
            self._watched[name] = failed(self._watched[name], reason)
            self._changed.notify_all()

    def _end(self, name: str) -> None:
        with self._changed:
            self._ended.add(name)
            self._changed.notify_all()


class _Camera:
    """Reads one camera until it is told to stop, and opens it anew when it fails."""

    def __init__(self, name: str, source: Source, owner: LiveCameras) -> None:
        self._name, self._source, self._owner = name, source, owner
        self._number = 0
        self._before = b""
        self._rows: deque[Image] = deque(maxlen=BUFFERS)
        self._whole: tuple[Image, ...] = ()
        self._started_s = math.nan

    def run(self) -> None:
        stop: threading.Event = self._owner._stop
        while not stop.is_set():
            try:
                if self._read_all(stop.is_set):
                    self._owner._end(self._name)
                    return
            except InputError as failure:
                self._owner._failed(self._name, str(failure))
                stop.wait(_AGAIN_S)
            except Exception as failure:
                # A driver or another package's source may raise anything: the other cameras go on.
                self._owner._failed(self._name, f"{self._source.name}: {type(failure).__name__}: {failure}")
                stop.wait(_AGAIN_S)

    def _read_all(self, stopped: Callable[[], bool]) -> bool:
        """Read to the end; True where there is one."""
        reader: Reader = self._source.open()
        broken = 0
        try:
            while not stopped():
                try:
                    picture = reader.read()
                except BrokenPictureError:
                    self._owner._broken(self._name)
                    broken += 1
                    if broken >= _BROKEN_MAX:
                        raise
                    continue
                broken = 0
                if picture is None:
                    return True
                self._pass_on(picture)
        finally:
            reader.close()
        return False

    def _pass_on(self, picture: Picture) -> None:
        decoded_s = time.monotonic()
        time_s = picture.time_s
        if not self._source.live:
            time_s = self._in_time(time_s)
        state = self._state(picture)
        if picture.skipped:
            self._number += picture.skipped
            self._owner._skipped(self._name, picture.skipped)
        self._number += 1
        frame = Frame(self._name, picture.image, time_s, self._number, picture.coded, decoded_s)
        self._owner._arrived(frame, state)

    def _in_time(self, time_s: float) -> float:
        """Hold a stored picture back until its time has come."""
        if math.isnan(self._started_s):
            self._started_s = self._owner._start_s()
        due = self._started_s + (self._number / _STILLS_HZ if math.isnan(time_s) else time_s)
        self._owner._stop.wait(max(due - time.monotonic(), 0.0))
        return due

    def _state(self, picture: Picture) -> Wholeness:
        if picture.coded:
            before, self._before = self._before, picture.coded
            return Wholeness.REPEATED if picture.coded == before else Wholeness.NEW
        if not self._source.raw:
            return Wholeness.NEW
        rows = sampled(picture.image)
        state = wholeness(rows, (*self._rows, *self._whole))
        if state is not Wholeness.REPEATED:
            self._rows.append(rows)
        if state is Wholeness.NEW:
            self._whole = (rows,)
        return state
