"""How much more the views of a calibration pull at its lenses than independent corners would.

A board that is bent, or light that moves its edges, shifts the corners of a view together. The energy of a view's
residuals in the space of the lens's derivatives (board poses projected out) is then larger than its share by dimension:
the ratio is the design effect of survey statistics (Kish 1965) with a view as the cluster, and scales the covariance
that takes corners as independent. It is 0.8 to 0.9 on renders, 5 to 8 on photographs of a hand-held board.
"""

from __future__ import annotations

import numpy as np

from tubesight.calibration.bundle import Adjusted, covariance, linearised
from tubesight.core import Array
from tubesight.geometry.rig import RigCovariance


def _views_apart(adjusted: Adjusted, lens: dict[str, tuple[str, ...]]) -> list[tuple[Array, Array]]:
    """Residuals (2 N,) of each observation and their derivatives (2 N, P) by its lens, board poses projected out."""
    rows = []
    for by_lens, by_pose, residuals in linearised(adjusted, lens):
        basis, _ = np.linalg.qr(by_pose)
        rows.append((residuals - basis @ (basis.T @ residuals), by_lens - basis @ (basis.T @ by_lens)))
    return rows


def design_effect(adjusted: Adjusted, lens: dict[str, tuple[str, ...]]) -> float:
    """Ratio of the variance of lens parameters to that under independent corners; at least 1."""
    energy = dimensions = 0.0
    total = freedom = 0.0
    for residuals, derivatives in _views_apart(adjusted, lens):
        basis, strengths, _ = np.linalg.svd(derivatives / np.linalg.norm(derivatives, axis=0), full_matrices=False)
        # Directions that rounding alone gives a length are none.
        basis = basis[:, strengths > 1e-9 * strengths[0]]
        energy += float(((basis.T @ residuals) ** 2).sum())
        dimensions += basis.shape[1]
        total += float(residuals @ residuals)
        # Six numbers of each view went into its board's pose.
        freedom += len(residuals) - 6
    count = len(adjusted.observations)
    if count < 2 or not (total > 0 and freedom > 0 and dimensions > 0):
        return 1.0
    # The fit has taken its own direction out of every view: one view in `count`.
    return max(1.0, energy / dimensions / (total / freedom) * count / (count - 1))


def inflated(adjusted: Adjusted, lens: dict[str, tuple[str, ...]]) -> RigCovariance | None:
    """Return the covariance of an adjustment scaled by its design effect."""
    plain = covariance(adjusted)
    return None if plain is None else RigCovariance(plain.names, plain.matrix * design_effect(adjusted, lens))
