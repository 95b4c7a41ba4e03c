"""The constant delay of one camera's times against another's, from the motion of the tube itself."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from tubesight.core import Array
from tubesight.geometry.rig import Rig
from tubesight.tracking.health import epipolar_px

# Moments that are needed, and how much the tip has to move across its epipolar line for a delay to show: 1 ms is 0.02
# px then, which 300 moments with 0.05 px of noise resolve six times over.
_MOMENTS_MIN, _SPEED_MIN_PX_PER_S = 50, 20.0


@dataclass(frozen=True, slots=True)
class Offset:
    """How much later camera b's times are than camera a's for one instant, with its standard deviation."""

    offset_s: float
    sd_s: float


def estimate_offset(rig: Rig, a: str, b: str, times_s: Array, rays_a: Array, rays_b: Array) -> Offset | None:
    """Estimate the delay of camera b from the tips both saw at the same stated times.

    Where b's picture of time t was taken a little earlier, at t - d, its tip is where it was then, and the epipolar
    residual is ``e(t) = e_0 - d g(t)`` with g the rate at which e changes with the motion of b's tip alone. Least
    squares over all moments gives d, and with it e_0, what the calibration is off.

    Parameters
    ----------
    times_s
        (N,) increasing.
    rays_a, rays_b
        (N, 3) rays of the tip.

    Returns
    -------
    Offset or None
        None where the tube does not move enough across its epipolar lines to tell.
    """
    n = len(times_s)
    if n < _MOMENTS_MIN:
        return None
    residual = np.array([epipolar_px(rig, a, b, ra, rb) for ra, rb in zip(rays_a, rays_b, strict=True)])
    rates = np.full(n, math.nan)
    for k in range(1, n - 1):
        span = times_s[k + 1] - times_s[k - 1]
        after = epipolar_px(rig, a, b, rays_a[k], rays_b[k + 1])
        before = epipolar_px(rig, a, b, rays_a[k], rays_b[k - 1])
        rates[k] = (after - before) / span if span > 0 else math.nan
    known = np.isfinite(residual) & np.isfinite(rates)
    if known.sum() < _MOMENTS_MIN or float(np.std(rates[known])) < _SPEED_MIN_PX_PER_S:
        return None
    design = np.stack([-rates[known], np.ones(int(known.sum()))], 1)
    solution, *_ = np.linalg.lstsq(design, residual[known], rcond=None)
    left = residual[known] - design @ solution
    variance = float(left @ left) / max(len(left) - 2, 1)
    covariance = variance * np.linalg.inv(design.T @ design)
    return Offset(float(solution[0]), math.sqrt(float(covariance[0, 0])))
