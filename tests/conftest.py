"""Fixtures that several test files use."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import pytest
from hypothesis import settings

from tubesight.core import FramePair, Tip, Tube
from tubesight.geometry.rig import Rig
from tubesight.simulate import Phantom, Scene, render_pair, rig_around, truth

# No deadline on a machine that others use too.
settings.register_profile("untimed", deadline=None)
settings.load_profile("untimed")

# The tube of the mock-up: 12 mm, 16 mm ball, clamped.
MOCKUP_TUBE = Tube(12.0, Tip("ball", 16.0), clamped=True)


@dataclass(frozen=True)
class SimulatedPair:
    """A photographed phantom with everything that is true about it (`truth`: mm and degrees, as in truth.json)."""

    pair: FramePair
    rig: Rig
    tube: Tube
    truth: dict[str, Any]


@lru_cache(maxsize=24)
def _rig(angle_deg: float, size_px: tuple[int, int]) -> Rig:
    return rig_around(angle_deg, size_px=size_px)


@lru_cache(maxsize=24)
def _simulate(
    phantom: Phantom, tube: Tube, scene: Scene, angle_deg: float, size_px: tuple[int, int], name: str
) -> SimulatedPair:
    rig = _rig(angle_deg, size_px)
    return SimulatedPair(render_pair(rig, phantom, tube, scene, name), rig, tube, truth(phantom))


@pytest.fixture(scope="session")
def simulated_pair() -> Callable[..., SimulatedPair]:
    """Return a function that photographs a phantom with two cameras; equal calls give the same pictures.

    ``simulated_pair(phantom, tube=MOCKUP_TUBE, scene=Scene(), angle_deg=90, size_px=(1280, 720), name="")``; a pair
    takes about 0.2 s.
    """

    def simulate(
        phantom: Phantom,
        tube: Tube = MOCKUP_TUBE,
        scene: Scene | None = None,
        angle_deg: float = 90.0,
        size_px: tuple[int, int] = (1280, 720),
        name: str = "",
    ) -> SimulatedPair:
        return _simulate(phantom, tube, scene or Scene(), angle_deg, size_px, name)

    return simulate


@pytest.fixture
def cluster() -> Iterator[Any]:
    """A Dask cluster of two worker processes on this machine; one that dies is started again."""
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None, silence_logs=50
    ) as made:
        yield made
        # A worker that is being started again cannot be closed.
        made.wait_for_workers(2, timeout=30)
