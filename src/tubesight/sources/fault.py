"""Another source with faults by a seeded script, to see what they do: ``fault:drop=0.1,unplug@5+1:sim:``."""

from __future__ import annotations

import math
import random
import re
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np

from tubesight.core import Image, InputError
from tubesight.sources.jpeg import decode_picture
from tubesight.sources.reader import BrokenPictureError, Picture, Reader, Source, Wanted

KINDS = ("drop", "delay", "duplicate", "freeze", "tear", "truncate", "swap", "blur", "unplug")
_RANDOM = re.compile(r"(\w+)=([0-9.]+)")
_TIMED = re.compile(r"(\w+)@([0-9.]+)\+([0-9.]+)")
# A late picture comes up to this long after its time.
_DELAY_S = 0.03
# Sigma of a motion that smears the picture, px.
_BLUR_PX = 6.0
# Bytes lost within a JPEG: some network packets.
_LOST_BYTES = 3000


@dataclass(frozen=True, slots=True)
class FaultScript:
    """Which faults happen.

    Attributes
    ----------
    probability
        By kind: share of the pictures it happens to, drawn at random.
    spans_s
        Kind, start and duration in seconds from the first opening: it happens to all pictures in it.
    seed
        Equal seeds draw equally.
    """

    probability: tuple[tuple[str, float], ...] = ()
    spans_s: tuple[tuple[str, float, float], ...] = ()
    seed: int = 0


def parse_script(text: str) -> FaultScript:
    """Read ``drop=0.1,freeze@5+2,seed=3``: shares of the pictures, and kinds from a second on for a duration."""
    probability, spans, seed = [], [], 0
    for part in filter(None, text.split(",")):
        drawn, timed = _RANDOM.fullmatch(part), _TIMED.fullmatch(part)
        found = drawn or timed
        try:
            numbers = [float(n) for n in found.groups()[1:]] if found is not None else []
        except ValueError:
            numbers = []
        if found is None or not numbers or found[1] not in (*KINDS, "seed"):
            raise InputError(
                f"fault script {text!r}: {part!r} is none of KIND=SHARE, KIND@START+SECONDS, seed=N with KIND one of "
                f"{', '.join(KINDS)}"
            )
        if found[1] == "seed":
            seed = int(numbers[0])
        elif timed is not None:
            spans.append((found[1], numbers[0], numbers[1]))
        elif numbers[0] <= 1:
            probability.append((found[1], numbers[0]))
        else:
            raise InputError(f"fault script {text!r}: {part!r}: a share of the pictures is at most 1")
    return FaultScript(tuple(probability), tuple(spans), seed)


def fault_source(text: str, wanted: Wanted, open_inner: Callable[[str, Wanted], Source]) -> Source:
    """Wrap the source named in ``fault:SCRIPT:SOURCE``."""
    script, colon, inner = text.removeprefix("fault:").partition(":")
    if not colon:
        raise InputError(f"{text}: expected fault:SCRIPT:SOURCE, for example fault:drop=0.1:sim:")
    source = open_inner(inner, wanted)
    faults = _Faults(parse_script(script), wanted.camera)
    return replace(source, name=f"{source.name} with faults", open=lambda: _FaultReader(source, faults, wanted))


class _Faults:
    """Draws what happens; lives on when the camera is opened anew."""

    def __init__(self, script: FaultScript, camera: str) -> None:
        self._script, self._random = script, random.Random(f"{script.seed}/{camera}")
        self._start_s = math.nan

    def now(self, kinds: tuple[str, ...] = KINDS) -> set[str]:
        """Kinds that happen to this picture."""
        clock = time.monotonic()
        if math.isnan(self._start_s):
            self._start_s = clock
        t = clock - self._start_s
        spans = {kind for kind, start, length in self._script.spans_s if start <= t < start + length}
        # Drawn whether asked for or not, so that the draws do not depend on the times.
        drawn = {kind for kind, share in self._script.probability if self._random.random() < share}
        return (spans | drawn) & set(kinds)

    def unplugged(self) -> bool:
        """Whether the cable is out just now."""
        clock = time.monotonic()
        t = clock - self._start_s if math.isfinite(self._start_s) else 0.0
        return any(kind == "unplug" and start <= t < start + length for kind, start, length in self._script.spans_s)

    def share(self) -> float:
        """Draw a number from 0 to 1."""
        return self._random.random()


class _FaultReader:
    def __init__(self, source: Source, faults: _Faults, wanted: Wanted) -> None:
        self._name, self._faults, self._gray = source.name, faults, wanted.gray
        self._refuse_unplugged()
        self._inner: Reader = source.open()
        self._ready: deque[Picture] = deque()
        self._last: Picture | None = None

    def _refuse_unplugged(self) -> None:
        if self._faults.unplugged():
            raise InputError(f"{self._name}: unplugged by the script")

    def read(self) -> Picture | None:
        while True:
            if self._ready:
                return self._ready.popleft()
            picture = self._inner.read()
            if picture is None:
                return None
            self._refuse_unplugged()
            kinds = self._faults.now()
            if "unplug" in kinds:
                raise InputError(f"{self._name}: unplugged by the script")
            if "drop" in kinds:
                continue
            shown = self._spoil(picture, kinds)
            if "swap" in kinds:
                following = self._inner.read()
                self._ready.extend([p for p in (following,) if p is not None] + [shown])
                continue
            if "duplicate" in kinds:
                self._ready.append(shown)
            if "delay" in kinds:
                time.sleep(_DELAY_S * self._faults.share())
            self._last = picture if "freeze" not in kinds else self._last or picture
            return shown

    def _spoil(self, picture: Picture, kinds: set[str]) -> Picture:
        last = self._last
        if "freeze" in kinds and last is not None:
            return replace(picture, image=last.image, coded=last.coded)
        if "blur" in kinds:
            return Picture(np.asarray(cv2.GaussianBlur(picture.image, (0, 0), _BLUR_PX), np.uint8), picture.time_s)
        if "truncate" in kinds or "tear" in kinds:
            at = 0.2 + 0.6 * self._faults.share()
            if picture.coded:
                return self._damage(picture, at, cut="truncate" in kinds)
            return replace(picture, image=_torn(picture.image, last.image if last else None, at, "truncate" in kinds))
        return picture

    def _damage(self, picture: Picture, at: float, cut: bool) -> Picture:
        """Lose bytes of a JPEG: the rest, or some in the middle."""
        place = int(at * len(picture.coded))
        data = picture.coded[:place] + (b"" if cut else picture.coded[place + _LOST_BYTES :])
        try:
            return replace(picture, image=decode_picture(data, self._name, self._gray), coded=data)
        except BrokenPictureError:
            self._last = picture
            raise

    def close(self) -> None:
        self._inner.close()


def _torn(image: Image, before: Image | None, at: float, cut: bool) -> Image:
    """Rows from a place on that were not filled, or are still those of the picture before."""
    torn = image.copy()
    row = int(at * len(image))
    if cut or before is None or before.shape != image.shape:
        torn[row:] = 0
    else:
        torn[row:] = before[row:]
    return torn
