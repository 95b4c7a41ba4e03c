"""How many parameters a lens earns: leave-one-view-out prediction error, compared view by view.

Residuals of real pictures are systematic (boards bend, paper is printed askew, light moves edges), and alike within a
view: information criteria, which count corners as independent, then favour any extra parameter. What counts is whether
a lens with the parameter predicts views it has not seen. With board poses projected out, the error of a view left out
follows from one solution (Allen's PRESS with a view as the group): ``e_v = r_v + A_v (N - A_v' A_v)^-1 A_v' r_v``,
``N = sum A_v' A_v``, where r_v are the residuals and A_v their derivatives by the lens.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tubesight.calibration.bundle import Adjusted, adjust
from tubesight.calibration.correlation import views_apart
from tubesight.calibration.scene import Free, Observation, Scene
from tubesight.core import Array

BASE: tuple[str, ...] = ("f", "cx", "cy", "k1", "k2", "p1", "p2")
# An extra parameter has to lower the error of unseen views by this many standard errors of the mean change ...
_STANDARD_ERRORS = 2.0
# ... and by this share: a gain of less moves no point of the scene by anything that matters.
_GAIN = 0.02


def select_lens(scene: Scene, observations: Sequence[Observation]) -> tuple[str, ...]:
    """Choose the free parameters of one camera's lens: fx = fy and k3 = 0 unless the data earn more.

    Parameters
    ----------
    scene
        With the camera and the views of the observations; the camera's pose is kept.
    observations
        All of one camera, one a view.
    """
    chosen = BASE
    errors = view_errors(scene, observations, chosen)
    while len(observations) > 2:
        best: tuple[float, tuple[str, ...], Array] | None = None
        for names in _richer(chosen):
            tried = view_errors(scene, observations, names)
            change = errors - tried
            spread = change.std(ddof=1) * np.sqrt(len(change))
            if change.sum() > max(_STANDARD_ERRORS * spread, _GAIN * errors.sum()) and (
                best is None or change.sum() > best[0]
            ):
                best = float(change.sum()), names, tried
        if best is None:
            break
        chosen, errors = best[1], best[2]
    return chosen


def _richer(names: tuple[str, ...]) -> list[tuple[str, ...]]:
    options = []
    if "f" in names:
        options.append(("fx", "fy", *names[1:]))
    if "k3" not in names:
        options.append((*names, "k3"))
    return options


def view_errors(scene: Scene, observations: Sequence[Observation], names: tuple[str, ...]) -> Array:
    """Squared error, pixels squared, of each view as predicted by the others, with its own board pose fitted."""
    camera = observations[0].camera
    solved = adjust(scene, observations, Free({camera: names}, (), tuple(o.view for o in observations)))
    return _left_out(solved, camera, names)


def _left_out(solved: Adjusted, camera: str, names: tuple[str, ...]) -> Array:
    apart = views_apart(solved, {camera: names})
    squares = [a.T @ a for _, a in apart]
    total = np.sum(squares, axis=0)
    errors = []
    for (r, a), square in zip(apart, squares, strict=True):
        # Views left may not fix every parameter: the pseudo-inverse leaves out what they do not say.
        e = r + a @ (np.linalg.pinv(total - square, rcond=1e-10, hermitian=True) @ (a.T @ r))
        errors.append(float(e @ e))
    return np.array(errors)
