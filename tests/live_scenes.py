"""Small simulated cameras for the live tests: two of 320 x 180, rendered once."""

from collections.abc import Iterator
from functools import lru_cache

import numpy as np

from tubesight.core import Frame, Image
from tubesight.geometry.rig import Rig
from tubesight.sources.reader import Picture, Source, Wanted
from tubesight.sources.simulated import SIM_TUBE, sim_picture, sim_rig

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
