"""Small simulated cameras for the live tests: two of 320 x 180, rendered once."""

from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from tubesight.core import Frame, Image
from tubesight.files.recording import FORMAT
from tubesight.files.rig import rig_from_text, rig_text
from tubesight.files.tube import tube_from_text, tube_text
from tubesight.geometry.rig import Rig
from tubesight.outputs.mcap_file import McapFile
from tubesight.outputs.recorder import Recorder
from tubesight.sensor import ShapeSensor
from tubesight.sources.reader import Picture, Source, Wanted
from tubesight.sources.simulated import SIM_TUBE, sim_picture, sim_rig
from tubesight.tracking.pairing import Matched
from tubesight.tracking.tracker import Tracked, Tracker

SIZE = (480, 270)


@lru_cache(maxsize=1)
def small_rig() -> Rig:
    return sim_rig(SIZE, ("left", "right"))


def wanted(camera: str, gray: bool = True) -> Wanted:
    return Wanted(camera, SIZE, gray=gray, timeout_s=0.5, rig=small_rig(), tube=SIM_TUBE)


def picture(camera: str, number: int) -> Image:
    return sim_picture(wanted(camera), number)


def frame(camera: str, time_s: float, number: int = 0) -> Frame:
    """A frame whose picture does not matter."""
    return Frame(camera, np.zeros((1, 1), np.uint8), time_s, number)


class Listed:
    """A reader of pictures that are given; raises what is raised among them."""

    def __init__(self, pictures: Iterator[Picture | Exception]) -> None:
        self._pictures = pictures
        self.closed = 0

    def read(self) -> Picture | None:
        following = next(self._pictures, None)
        if isinstance(following, Exception):
            raise following
        return following

    def close(self) -> None:
        self.closed += 1


def listed(pictures: list[Picture | Exception], live: bool = True, raw: bool = True) -> Source:
    """A source that goes on where it failed, like a camera that is opened anew."""
    shared = iter(pictures)
    return Source("listed", lambda: Listed(shared), live, raw)


def measured_moments(pairs: int, tracker: Tracker) -> list[Tracked]:
    """Measure pairs of the small cameras with the rig and tube that a recording gives back."""
    rig = rig_from_text(rig_text(small_rig()), Path("rig")).rig
    tube = tube_from_text(tube_text(SIM_TUBE), Path("tube"))
    sensor = ShapeSensor(rig, tube)
    moments = []
    for k in range(pairs):
        frames = {n: Frame(n, picture(n, k), 100 + k / 30 + 0.001 * (n == "right"), k) for n in rig.names}
        matched = Matched(MappingProxyType(frames), 100 + k / 30, 0.001)
        moments.append(tracker.step(sensor(matched.pair(str(k))), matched))
    return moments


def configuration(pictures: str = "lossless", every: int = 1) -> dict[str, Any]:
    return {
        "format": FORMAT,
        "rig": rig_text(small_rig()),
        "tube": tube_text(SIM_TUBE),
        "method": "silhouette",
        "base_px": {},
        "backgrounds": {},
        "gray": True,
        "filtered": True,
        "pictures": pictures,
        "every": every,
    }


def record(path: Path, moments: list[Tracked], pictures: str = "lossless", every: int = 1) -> dict[str, Any]:
    recorder = Recorder(McapFile(path), configuration(pictures, every), pictures, every)
    for moment in moments:
        recorder.publish(moment)
    recorder.close()
    return recorder.state()
