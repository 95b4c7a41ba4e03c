"""Sub-pixel edges on profiles of the tube's share, and scans across a curve."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter1d

from tubesight.core import Array
from tubesight.vision.signal import Signal

# Spacing of samples along a profile. Half a pixel loses nothing of a bilinear picture.
SPACING_PX = 0.5
# Parallel lines averaged into one profile, this far apart along the tube.
LINES_PX = (-1.5, -0.5, 0.5, 1.5)
# Plateaus of the half level: this far inside and outside of the edge for a sharp picture (limb shading makes the inside
# rise within pixels, gamma and sharpening disturb the outside), and this many sigmas for a blurred one.
_INSIDE_PX, _OUTSIDE_PX = 1.0, 2.5
_INSIDE_SIGMAS, _OUTSIDE_SIGMAS = 1.0, 3.0
_PASSES = 2
# Cameras and JPEG record colour at half resolution, so edges are measured by brightness first; where tube and background
# are equally bright colour has to help. Both are tried and the smoother edge is taken.
_CHROMA = (1 / 3, 1.0)
_LUMA_BGR = np.array([0.114, 0.587, 0.299])


@dataclass(frozen=True, slots=True, eq=False)
class Edges:
    """Edges found on profiles.

    Attributes
    ----------
    position_px
        (N,) distance along each profile; NaN where no edge was found.
    sigma_px
        (N,) width of the edge as the sigma of a Gaussian.
    drop
        (N,) fall of the tube's share over the edge.
    """

    position_px: Array
    sigma_px: Array
    drop: Array


def left_of(direction: Array) -> Array:
    """Unit normal (..., 2) to the left of a way in a picture (y down): facing down, left is +x."""
    return np.stack([direction[..., 1], -direction[..., 0]], -1)


def profiles(signal: Signal, origin_px: Array, direction: Array, along: Array) -> Array:
    """Share of tube along lines, each the mean of a few parallel ones.

    Parameters
    ----------
    origin_px, direction
        (N, 2) each; unit directions of the profiles.
    along
        (L,) distances from the origin, pixels.

    Returns
    -------
    Array
        (N, L); NaN outside the picture.
    """
    side = left_of(direction)
    points = origin_px[:, None, :] + along[:, None] * direction[:, None, :]
    shifted = [points + offset * side[:, None, :] for offset in LINES_PX]
    return np.asarray(np.mean([signal(p) for p in shifted], axis=0))


def measure_edges(
    signal: Signal, origin_px: Array, direction: Array, along: Array, guess_px: Array, lines_px: tuple[float, ...] = LINES_PX
) -> Edges:
    """Measure falling edges on neighbouring profiles with the colours just inside and outside of each.

    Parameters
    ----------
    origin_px, direction
        (N, 2) each, in order along the contour.
    along
        (L,) distances from the origin.
    guess_px
        (N,) first guess of the edges; NaN where there is none.
    lines_px
        Offsets of the parallel lines that are averaged.
    """
    side = left_of(direction)
    points = origin_px[:, None, :] + along[:, None] * direction[:, None, :]
    samples = [signal.colours(points + offset * side[:, None, :]) for offset in lines_px]
    colour = np.mean([c for c, _ in samples], axis=0)
    behind = None if signal.background is None else np.mean([b for _, b in samples], axis=0)
    measured = [_measure(colour, behind, along, guess_px, chroma) for chroma in (_CHROMA if colour.shape[-1] == 3 else (1.0,))]
    return min(measured, key=_scatter)


def _measure(colour: Array, behind: Array | None, along: Array, guess_px: Array, chroma: float) -> Edges:
    sigma = 0.6
    edges = Edges(guess_px, guess_px, guess_px)
    for _ in range(_PASSES):
        edges = refine(local_share(colour, behind, along, edges.position_px, sigma, chroma), along, edges.position_px)
        if np.isfinite(edges.sigma_px).any():
            sigma = float(np.nanmedian(edges.sigma_px))
    return edges


def _scatter(edges: Edges) -> float:
    """How rough a row of edges is, px: median second difference, plus the share that was not found."""
    found = np.isfinite(edges.position_px)
    if found.sum() < 5:
        return float("inf")
    return float(np.median(np.abs(np.diff(edges.position_px[found], 2))) + (~found).mean())


def local_share(
    colour: Array, behind: Array | None, along: Array, edge_px: Array, sigma_px: float, chroma: float
) -> Array:
    """Share of tube from the colours T and B on both sides of an edge: ``(I - B) . (T - B) / |T - B|^2``.

    T is the colour just inside of the edge and B that of the background picture, or else just outside; both are running
    medians over neighbouring profiles. Shading moves T along the contour, and with it the direction of best contrast.

    Parameters
    ----------
    colour, behind
        (N, L, C) profiles in linear light, of the picture and of the background picture or None.
    edge_px
        (N,) places of the edges.
    chroma
        Weight of differences of colour against differences of brightness in the scalar product.
    """
    start, step = float(along[0]), float(along[1] - along[0])
    inside, outside = max(_INSIDE_PX, _INSIDE_SIGMAS * sigma_px), max(_OUTSIDE_PX, _OUTSIDE_SIGMAS * sigma_px)

    def plateau(low: Array, high: Array) -> Array:
        means = [_mean_between(colour[..., c], start, step, low, high) for c in range(colour.shape[-1])]
        return _running_median(np.stack(means, -1))

    tube = plateau(edge_px - inside - 1.0, edge_px - inside)[:, None, :]
    cloth = plateau(edge_px + outside, edge_px + outside + 2.0)[:, None, :] if behind is None else behind
    contrast = _features(tube - cloth, chroma)
    power = (contrast**2).sum(-1)
    return np.asarray((_features(colour - cloth, chroma) * contrast).sum(-1) / np.maximum(power, 1e-7))


def _features(colour: Array, chroma: float) -> Array:
    """Brightness and weighted colour differences of a (..., 3) BGR colour; gray is left alone."""
    if colour.shape[-1] == 1:
        return colour
    y = colour @ _LUMA_BGR
    return np.stack([y, chroma * (colour[..., 0] - y), chroma * (colour[..., 2] - y)], -1)


def _running_median(rows: Array) -> Array:
    """Median over 9 neighbouring rows (N, C), NaN-safe."""
    half = min(4, len(rows) - 1)
    padded = np.pad(rows, ((half, half), (0, 0)), mode="reflect")
    windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * half + 1, axis=0)
    missing = ~np.isfinite(windows).any(-1)
    return np.asarray(np.where(missing, np.nan, np.nanmedian(np.where(missing[..., None], 0.0, windows), axis=-1)))


def steepest(profile: Array, along: Array, sigma_px: float = 1.0) -> tuple[Array, Array]:
    """Smoothed profile (N, L) and its falling slope (N, L) per pixel, NaN-safe (NaN becomes flat)."""
    filled = np.where(np.isfinite(profile), profile, 0.0)
    step = float(along[1] - along[0])
    smooth = gaussian_filter1d(filled, sigma_px / step, axis=-1, mode="nearest")
    return smooth, -np.gradient(smooth, step, axis=-1)


def refine(profile: Array, along: Array, guess_px: Array) -> Edges:
    """Half-level crossing nearest a guess on profiles that fall outwards.

    Two passes: the level is half way between the plateaus just inside and outside of the current edge, at distances that
    scale with the measured width of the edge.

    Parameters
    ----------
    profile
        (N, L) share of tube, falling with `along` at the edge.
    along
        (L,) evenly spaced.
    guess_px
        (N,) first guess of the edge.
    """
    start, step = float(along[0]), float(along[1] - along[0])
    position = np.array(guess_px, dtype=float)
    sigma = np.full(len(position), 0.6)
    drop = np.zeros(len(position))
    for _ in range(_PASSES):
        inside = np.maximum(_INSIDE_PX, _INSIDE_SIGMAS * sigma)
        outside = np.maximum(_OUTSIDE_PX, _OUTSIDE_SIGMAS * sigma)
        high = _mean_between(profile, start, step, position - inside - 1.0, position - inside)
        low = _mean_between(profile, start, step, position + outside, position + outside + 2.0)
        drop = high - low
        reach = np.maximum(2.0, 2.5 * sigma)
        found, slope = _crossing(profile, start, step, position, reach, (high + low) / 2)
        position = found
        with np.errstate(divide="ignore", invalid="ignore"):
            sigma = np.clip(drop / (np.sqrt(2 * np.pi) * slope), 0.3, 6.0)
    good = drop > 0
    return Edges(np.where(good, position, np.nan), np.where(good, sigma, np.nan), np.where(good, drop, np.nan))


def _mean_between(profile: Array, start: float, step: float, low: Array, high: Array) -> Array:
    """Mean of each profile (N, L) between two places (N,), by five samples."""
    places = low[:, None] + np.linspace(0, 1, 5) * (high - low)[:, None]
    return np.asarray(interpolate(profile, start, step, places).mean(1))


def interpolate(profile: Array, start: float, step: float, places: Array) -> Array:
    """Linear interpolation of profiles (N, L) at places (N, K); NaN outside."""
    position = (places - start) / step
    inside = (position >= 0) & (position <= profile.shape[1] - 1)
    position = np.where(inside, position, 0.0)
    left = np.minimum(position.astype(np.intp), profile.shape[1] - 2)
    t = position - left
    rows = np.arange(len(profile))[:, None]
    return np.where(inside, profile[rows, left] * (1 - t) + profile[rows, left + 1] * t, np.nan)


def _crossing(
    profile: Array, start: float, step: float, position: Array, reach: Array, level: Array
) -> tuple[Array, Array]:
    """Falling crossing of a level nearest to `position` within `reach`, and the steepest fall there."""
    count = 33
    places = position[:, None] + np.linspace(-1, 1, count) * reach[:, None]
    values = interpolate(profile, start, step, places)
    gap = places[:, 1:2] - places[:, :1]
    above, below = values[:, :-1] - level[:, None], values[:, 1:] - level[:, None]
    falls = (above >= 0) & (below < 0)
    middle = (places[:, :-1] + places[:, 1:]) / 2
    distance = np.where(falls, np.abs(middle - position[:, None]), np.inf)
    best = distance.argmin(1)
    rows = np.arange(len(profile))
    found = np.isfinite(distance[rows, best])
    with np.errstate(divide="ignore", invalid="ignore"):
        share = above[rows, best] / (above[rows, best] - below[rows, best])
    crossing = places[rows, best] + share * gap[:, 0]
    slope = np.nanmax(np.where(np.isfinite(values[:, :-1]), values[:, :-1] - values[:, 1:], 0.0), axis=1) / gap[:, 0]
    return np.where(found, crossing, np.nan), slope
