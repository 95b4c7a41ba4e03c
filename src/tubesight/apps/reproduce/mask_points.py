"""How many points the mask of the paper gives, and how fast its closed form is on many sets of points."""

from __future__ import annotations

import time

import numpy as np

from tubesight.apps.reproduce.mockup import LENGTH_MM, TUBE, true_rig
from tubesight.apps.reproduce.noisy_points import draw_points, estimate
from tubesight.simulate.phantom import Arc

# Sets of points that are timed: a tenth of a second.
_TIMED = 2000


def mask_text() -> str:
    """Say how many points the mask gives on these photographs."""
    step, half, most = mask_steps()
    return (
        f"The mask of the paper steps by its own radius, which is at least the tube's half width of {half:.0f} px: on "
        f"these photographs it gives at most {most} points, and {step} at 1.5 half widths. More points, which every "
        "estimator needs against noise of millimetres, cannot come from it."
    )


def mask_steps() -> tuple[int, float, int]:
    """Count points at 1.5 half widths, give the half width in px, and count points at one half width."""
    assert TUBE.diameter_mm is not None
    per_mm = _px_per_mm()
    half = per_mm * TUBE.diameter_mm / 2
    return int(LENGTH_MM * per_mm / (1.5 * half)), half, int(LENGTH_MM * per_mm / half)


def _px_per_mm() -> float:
    rig = true_rig()
    scale = [rig.cameras[n].focal_px / np.linalg.norm(rig.camera_from_base[n].translation_mm) for n in rig.names]
    return float(np.mean(scale))


def speed_text(seed: int, count: int) -> str:
    """Time the batched closed form on one core, with the mask's number of points and with `count`; best of three."""
    rig, rng = true_rig(), np.random.default_rng(seed)
    phantoms = [Arc(0.5, azimuth, LENGTH_MM) for azimuth in np.linspace(0.0, 6.0, _TIMED).tolist()]
    rates = []
    for points_each in (mask_steps()[0], count):
        points = draw_points(rig, phantoms, points_each, np.ones(_TIMED), True, rng)
        times = []
        for _ in range(3):
            start = time.process_time()
            estimate("reference_tangent", points, rig)
            times.append(time.process_time() - start)
        rates.append(f"{_TIMED / min(times):,.0f} a second with {points_each} points")
    return f"The closed form, batched, on one core of this machine: {' and '.join(rates)}."
