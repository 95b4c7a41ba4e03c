"""How many parameters a lens earns: fx = fy, no skew and k3 = 0 unless the data contradict it.

Residuals of real pictures are systematic (boards bend, paper is printed askew, light moves edges) and alike within a
view: information criteria, which count corners as independent, then favour any extra parameter. So the likelihood ratio
of nested lenses is divided by the variance of the richest one and by its design effect (quasi-likelihood, McCullagh &
Nelder 1989, section 9; see `correlation`): where a parameter is not needed it follows chi-squared with one degree of
freedom whatever the boards do. It stayed below 8 in 70 calibrations without need (flat and bent boards, published
photographs) and was 22 to 35000 where pixels were not square or k3 was not 0.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tubesight.calibration.bundle import Adjusted, adjust, loss
from tubesight.calibration.correlation import design_effect
from tubesight.calibration.scene import Free, Observation, Scene

BASE: tuple[str, ...] = ("f", "cx", "cy", "k1", "k2", "p1", "p2")
_RICHEST: tuple[str, ...] = ("fx", "fy", *BASE[1:], "k3", "skew")
# Four standard deviations: a parameter that is not needed passes once in 16000 calibrations.
_EARNED = 16.0


def select_lens(scene: Scene, observations: Sequence[Observation]) -> tuple[str, ...]:
    """Choose the free parameters of one camera's lens: drop from the richest one by one what is not earned.

    Parameters
    ----------
    scene
        With the camera and the views of the observations; the camera's pose is kept.
    observations
        All of one camera, one a view.
    """
    camera = observations[0].camera
    names, solved = _RICHEST, _solve(scene, observations, _RICHEST)
    sigma = solved.sigma_px
    residuals = 2 * sum(len(o.px) for o in observations)
    freedom = max(residuals - solved.free.count, 1)
    variance = max(loss(solved, sigma) / freedom, np.finfo(float).tiny) * design_effect(solved, {camera: _RICHEST})
    while True:
        best: tuple[float, tuple[str, ...], Adjusted] | None = None
        for simpler in _simpler(names):
            tried = _solve(scene, observations, simpler)
            ratio = (loss(tried, sigma) - loss(solved, sigma)) / variance
            if ratio < _EARNED and (best is None or ratio < best[0]):
                best = ratio, simpler, tried
        if best is None:
            return names
        _, names, solved = best


def _simpler(names: tuple[str, ...]) -> list[tuple[str, ...]]:
    """Lenses with one parameter fewer."""
    options = []
    if "fx" in names:
        options.append(("f", *names[2:]))
    options += [tuple(n for n in names if n != extra) for extra in ("k3", "skew") if extra in names]
    return options


def _solve(scene: Scene, observations: Sequence[Observation], names: tuple[str, ...]) -> Adjusted:
    """Adjust lens and board poses of one camera."""
    return adjust(scene, observations, Free({observations[0].camera: names}, (), tuple(o.view for o in observations)))
