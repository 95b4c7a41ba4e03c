"""The memory that measuring takes, and whether it grows."""

from __future__ import annotations

import math
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tubesight.core import FramePair, Tube
from tubesight.files.rig import save_rig
from tubesight.geometry.rig import Rig
from tubesight.outputs.machine import resident_mb
from tubesight.sensor import ShapeSensor

Progress = Callable[[int, int], None]

# Most pairs before memory is looked at, and how often it is: allocators and caches have filled by then.
_WARM, _LOOKS = 500, 100

# What the process runs whose memory is told: it has no simulator and nothing else of the benchmark's.
_ALONE = """
import sys
from pathlib import Path
import numpy as np
from tubesight.core import FramePair, Tip, Tube
from tubesight.files.rig import load_rig
from tubesight.outputs.machine import resident_mb
from tubesight.sensor import ShapeSensor
folder, method, diameter, ball = Path(sys.argv[1]), sys.argv[2], *map(float, sys.argv[3:])
pair = FramePair(dict(np.load(folder / "pair.npz")))
sensor = ShapeSensor(load_rig(folder / "rig.yaml").rig, Tube(diameter, Tip("ball", ball), clamped=True), method)
for _ in range(20):
    sensor(pair)
print(resident_mb() - sum(image.nbytes for image in pair.images.values()) / 1e6)
"""


def alone_mb(rig: Rig, tube: Tube, pair: FramePair, method: str) -> float:
    """Resident memory, without the pictures, of a process of its own that measures one pair a few times, megabytes.

    The tube has to have a ball. NaN where the system does not tell.
    """
    with tempfile.TemporaryDirectory() as folder:
        save_rig(Path(folder) / "rig.yaml", rig)
        np.savez(Path(folder) / "pair.npz", allow_pickle=False, **dict(pair.images))
        sizes = (str(tube.diameter_mm), str(tube.tip.diameter_mm))
        done = subprocess.run(
            [sys.executable, "-c", _ALONE, folder, method, *sizes], capture_output=True, text=True, check=False
        )
    return float(done.stdout) if done.returncode == 0 else math.nan


@dataclass(frozen=True, slots=True)
class Soak:
    """Resident memory over many pairs.

    Attributes
    ----------
    pairs
        How many were measured, after those that warm up.
    first_mb, last_mb
        Memory at the first and last look.
    bytes_per_pair
        Slope of the line through all looks.
    """

    pairs: int
    first_mb: float
    last_mb: float
    bytes_per_pair: float


def soak(sensor: ShapeSensor, few: Sequence[FramePair], pairs: int, progress: Progress | None = None) -> Soak:
    """Measure pairs one after the other in this process, and how its memory grows.

    Parameters
    ----------
    few
        Pairs that are measured in turn.
    pairs
        How many are measured.
    progress
        Called with the number of pairs done and their total.
    """
    for k in range(min(_WARM, pairs)):
        sensor(few[k % len(few)])
    looks = []
    every = max(pairs // _LOOKS, 1)
    for k in range(pairs):
        sensor(few[k % len(few)])
        if k % every == 0:
            looks.append((k, resident_mb()))
            if progress is not None:
                progress(k, pairs)
    at, memory = np.array(looks).T
    slope = 1e6 * float(np.polyfit(at, memory, 1)[0]) if len(looks) > 1 else math.nan
    return Soak(pairs, float(memory[0]), float(memory[-1]), slope)
