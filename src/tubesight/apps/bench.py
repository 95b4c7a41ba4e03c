"""``tubesight bench``: what each method costs, on pictures that the processor's cache does not hold."""

from __future__ import annotations

import gc
import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from statistics import median
from typing import Any

import cv2
import numpy as np

from tubesight.apps.memory import Soak, alone_mb, soak
from tubesight.core import FramePair, Image, Tip, Tube
from tubesight.geometry.rig import Rig
from tubesight.methods import METHODS
from tubesight.outputs.machine import machine
from tubesight.sensor import ShapeSensor
from tubesight.simulate import Arc, render_pair, rig_around

# Dalvand et al. 2016, section 4: 5 ms a pair.
PAPER_US = 5000.0
# The ring of pictures is larger than any cache, so that every pair comes from memory as a camera's does.
_RING_MB = 256
# The rates that are compared with: the paper's own pipeline on full frames, and limited to the tube's surroundings.
REFERENCES = ("reference", "reference_crop")
_TUBE = Tube(12.0, Tip("ball", 16.0), clamped=True)
_JPEG_QUALITY = 90
_DECODES = 15

Progress = Callable[[int, int], None]


@dataclass(frozen=True, slots=True)
class Timing:
    """CPU time of one method, microseconds a pair.

    Attributes
    ----------
    median_us, p99_us
        Over all pairs.
    stages_us
        Medians by stage.
    failures
        Pairs that gave no shape.
    """

    median_us: float
    p99_us: float
    stages_us: Mapping[str, float]
    failures: int


@dataclass(frozen=True, slots=True)
class Benchmark:
    """What was measured, all in one process and one thread.

    Attributes
    ----------
    pairs, size_px
        Number of pairs a method saw, and the pictures' size.
    methods
        Timings by method.
    decoding_us
        Medians of decoding one picture, by format.
    yuyv_us
        Medians by method on the Y plane of YUYV pictures, taken as it lies in their buffers; NaN where no pair gave a
        shape (the reference needs colour).
    memory_mb
        Resident memory of a process that does nothing but measure with the first of the methods; NaN where the
        system does not tell.
    """

    pairs: int
    size_px: tuple[int, int]
    methods: Mapping[str, Timing]
    decoding_us: Mapping[str, float]
    yuyv_us: Mapping[str, float]
    memory_mb: float

    def ratios(self, name: str) -> dict[str, float]:
        """How many times faster a method is than each reference and than the paper's own figure."""
        own = self.methods[name].median_us
        against = {r: self.methods[r].median_us / own for r in REFERENCES if r in self.methods}
        return {**against, "paper": PAPER_US / own}

    def as_dict(self) -> dict[str, Any]:
        """As JSON."""
        methods = {
            name: {
                "median_us": timing.median_us,
                "p99_us": timing.p99_us,
                "stages_us": dict(timing.stages_us),
                "failures": timing.failures,
                "faster_than": self.ratios(name),
            }
            for name, timing in self.methods.items()
        }
        return {
            "machine": machine(),
            "pairs": self.pairs,
            "size_px": list(self.size_px),
            "methods": methods,
            "decoding_us": dict(self.decoding_us),
            "yuyv_us": dict(self.yuyv_us),
            "memory_mb": self.memory_mb,
        }


def run_benchmark(pairs: int, names: Sequence[str] = (), progress: Progress | None = None) -> Benchmark:
    """Time methods on simulated pictures of 1080p, interleaved, each pair cold.

    Parameters
    ----------
    pairs
        How many pairs each method sees.
    names
        Methods; where empty, all that need no more than the pictures of two cameras.
    progress
        Called with the number of pairs done and their total.
    """
    names = tuple(names) or tuple(n for n, m in METHODS.items() if m.scene == "plain" and not m.given)
    unknown = [name for name in names if name not in METHODS]
    if unknown:
        raise ValueError(f"method: expected one of {', '.join(METHODS)}, got {unknown[0]!r}")
    rig = rig_around(90.0)
    ring = _ring(rig)
    sensors = {name: ShapeSensor(rig, _TUBE, name) for name in names}
    times: dict[str, list[float]] = {name: [] for name in names}
    stages: dict[str, list[Mapping[str, float]]] = {name: [] for name in names}
    failures = dict.fromkeys(names, 0)
    with one_thread():
        for sensor in sensors.values():
            sensor(ring[0])
        for k in range(pairs):
            for shift, (name, sensor) in enumerate(sensors.items()):
                pair = ring[(k * len(names) + shift) % len(ring)]
                start = time.thread_time_ns()
                result = sensor(pair)
                times[name].append((time.thread_time_ns() - start) / 1e3)
                stages[name].append(result.ms)
                failures[name] += not result
            if progress is not None:
                progress(k + 1, pairs)
        decoding = _decoding(ring)
        yuyv = {name: _yuyv_us(sensor, ring) for name, sensor in sensors.items()}
    timings = {
        name: Timing(
            median(times[name]),
            float(np.percentile(times[name], 99)),
            {stage: 1e3 * median(ms.get(stage, 0.0) for ms in stages[name]) for stage in stages[name][0]},
            failures[name],
        )
        for name in names
    }
    size_px = rig.cameras[rig.names[0]].size_px
    return Benchmark(pairs, size_px, timings, decoding, yuyv, alone_mb(rig, _TUBE, ring[0], names[0]))


def _ring(rig: Rig) -> list[FramePair]:
    """Copy a few different pairs until they are larger than the cache together."""
    made = _rendered(rig)
    size_mb = sum(image.nbytes for image in made[0].images.values()) / 1e6
    count = max(int(_RING_MB / size_mb), len(made))
    return [
        FramePair({name: image.copy() for name, image in made[k % len(made)].images.items()}, str(k))
        for k in range(count)
    ]


def _rendered(rig: Rig) -> list[FramePair]:
    """Pictures of four arcs."""
    phantoms = [Arc(np.radians(10 + 20 * k), np.radians(47 * k), 160.0) for k in range(4)]
    return [render_pair(rig, phantom, _TUBE, name=str(k)) for k, phantom in enumerate(phantoms)]


@contextmanager
def one_thread() -> Iterator[None]:
    """One thread of OpenCV, and no garbage collection in between."""
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    gc.collect()
    gc.disable()
    try:
        yield
    finally:
        gc.enable()
        cv2.setNumThreads(threads)


def _decoding(ring: Sequence[FramePair]) -> dict[str, float]:
    """Medians, microseconds a picture, of what a camera's pictures cost before any method sees them."""
    image: Image = next(iter(ring[0].images.values()))
    quality = [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY]
    _, data = cv2.imencode(".jpg", image, quality)
    yuyv = np.zeros((*image.shape[:2], 2), np.uint8)
    yuyv[..., 0], yuyv[..., 1] = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), 128
    work: dict[str, Callable[[], object]] = {
        "jpeg_colour": lambda: cv2.imdecode(data, cv2.IMREAD_COLOR),
        "jpeg_gray": lambda: cv2.imdecode(data, cv2.IMREAD_GRAYSCALE),
        "yuyv_to_bgr": lambda: cv2.cvtColor(yuyv, cv2.COLOR_YUV2BGR_YUYV),
        "yuyv_gray_view": lambda: yuyv[..., 0],
    }
    return {name: median(_cpu_us(decode) for _ in range(_DECODES)) for name, decode in work.items()}


def _yuyv_us(sensor: ShapeSensor, ring: Sequence[FramePair]) -> float:
    """Median of pairs of Y planes, each a view of every second byte of its buffer."""
    times: list[float] = []
    for pair in ring[:_DECODES]:
        planes = {}
        for name, image in pair.images.items():
            buffer = np.full((*image.shape[:2], 2), 128, np.uint8)
            buffer[..., 0] = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
            planes[name] = buffer[..., 0]
        gray = FramePair(planes, pair.name)
        if not times and not sensor(gray):
            return math.nan
        times.append(_cpu_us(partial(sensor, gray)))
    return median(times)


def run_soak(pairs: int, method: str, progress: Progress | None = None) -> Soak:
    """Measure a few simulated pairs over and over, and how the memory of this process grows.

    Parameters
    ----------
    pairs
        How many pairs are measured.
    method
        Name of the method.
    progress
        Called with the number of pairs done and their total.
    """
    rig = rig_around(90.0)
    return soak(ShapeSensor(rig, _TUBE, method), _rendered(rig), pairs, progress)


def _cpu_us(work: Callable[[], object]) -> float:
    start = time.thread_time_ns()
    work()
    return (time.thread_time_ns() - start) / 1e3
