"""Points that move: prediction and filtering with constant velocity and white acceleration."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tubesight.core import Array, readonly


@dataclass(frozen=True, slots=True, eq=False)
class Moving:
    """Positions and velocities with their covariance at one moment.

    Attributes
    ----------
    time_s
        The moment.
    position_mm, velocity_mm_per_s
        (n,) each.
    covariance
        (2n, 2n), positions first.
    """

    time_s: float
    position_mm: Array
    velocity_mm_per_s: Array
    covariance: Array

    def __post_init__(self) -> None:
        n = len(self.position_mm)
        shapes = {"position_mm": (n,), "velocity_mm_per_s": (n,), "covariance": (2 * n, 2 * n)}
        for name, shape in shapes.items():
            object.__setattr__(self, name, readonly(getattr(self, name), shape, name))

    @property
    def position_covariance(self) -> Array:
        """(n, n) covariance of the positions in mm^2."""
        n = len(self.position_mm)
        return self.covariance[:n, :n]


def begin(time_s: float, position_mm: Array, covariance: Array, speed_sd_mm_per_s: float) -> Moving:
    """Start from a measurement, at rest give or take `speed_sd_mm_per_s`."""
    n = len(position_mm)
    both = np.zeros((2 * n, 2 * n))
    both[:n, :n] = covariance
    both[n:, n:] = speed_sd_mm_per_s**2 * np.eye(n)
    return Moving(time_s, position_mm, np.zeros(n), both)


def predict(state: Moving, time_s: float, acceleration_mm_per_s2: float) -> Moving:
    """Carry on to another moment with constant velocity.

    The covariance grows by that of an acceleration that is constant over the step and drawn anew for each:
    ``Q = a^2 [[h^4/4, h^3/2], [h^3/2, h^2]]``.
    """
    n, h = len(state.position_mm), time_s - state.time_s
    step = np.kron(np.array([[1.0, h], [0.0, 1.0]]), np.eye(n))
    noise = np.kron(np.array([[h**4 / 4, h**3 / 2], [h**3 / 2, h**2]]), np.eye(n))
    return Moving(
        time_s,
        state.position_mm + h * state.velocity_mm_per_s,
        state.velocity_mm_per_s,
        step @ state.covariance @ step.T + acceleration_mm_per_s2**2 * noise,
    )


def distance_squared(predicted: Moving, position_mm: Array, covariance: Array) -> float:
    """Squared Mahalanobis distance of a measurement from its prediction: chi squared with n degrees of freedom."""
    off = position_mm - predicted.position_mm
    return float(off @ np.linalg.solve(predicted.position_covariance + covariance, off))


def correct(predicted: Moving, position_mm: Array, covariance: Array) -> Moving:
    """Take a measurement of the positions into account: the Kalman update in Joseph's form, which stays symmetric."""
    n = len(position_mm)
    both = predicted.covariance
    gain = np.linalg.solve(both[:n, :n] + covariance, both[:n, :]).T
    off = gain @ (position_mm - predicted.position_mm)
    keep = np.eye(2 * n)
    keep[:, :n] -= gain
    new = keep @ both @ keep.T + gain @ covariance @ gain.T
    return Moving(predicted.time_s, predicted.position_mm + off[:n], predicted.velocity_mm_per_s + off[n:], new)
