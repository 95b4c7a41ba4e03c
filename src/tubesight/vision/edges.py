"""Sub-pixel edges on profiles of the tube's share, and scans across a curve."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import gaussian_filter1d

from tubesight.core import Array, Mask
from tubesight.vision.signal import Signal

# Spacing of samples along a profile. Half a pixel loses nothing of a bilinear picture.
SPACING_PX = 0.5
# Parallel lines averaged into one profile, this far apart along the tube.
LINES_PX = (-1.5, -0.5, 0.5, 1.5)
# Plateaus of the half level lie this far inside and outside of the edge of a sharp picture (limb shading makes the
# inside rise within pixels, gamma and sharpening disturb the outside), and clear of the edge itself where it is
# blurred: an edge of a sharp picture has a sigma of 0.7 to 1 px.
_INSIDE_PX, _OUTSIDE_PX = 1.0, 2.5
_SHARP_PX, _INSIDE_SIGMAS, _OUTSIDE_SIGMAS = 0.55, 2.2, 2.5
_SIGMA_FIRST_PX = 0.8
_SIGMA_RANGE_PX = (0.4, 4.0)
_PASSES = 3
# The width of an edge is measured between plateaus this far from it, but no deeper than a part of the tube.
_FAR_PX, _FAR_SHARE = 5.0, 0.5
# Shading inside may rise by this share of the edge's fall per pixel and is then extrapolated to the edge; more is a
# highlight.
_RISE_MAX = 0.12
# The extrapolation is right to about this part of what it changes.
_RISE_DOUBT = 0.3
# Cameras and JPEG record colour at half resolution, so edges are measured by brightness first; where tube and
# background are equally bright colour has to help. Both are tried and the smoother edge is taken.
_CHROMA = (1 / 3, 1.0)
_LUMA_BGR = np.array([0.114, 0.587, 0.299])


@dataclass(frozen=True, slots=True, eq=False)
class Edges:
    """Edges found on profiles.

    Attributes
    ----------
    position_px
        (N,) distance along each profile; NaN where no edge was found.
    drop
        (N,) fall of the tube's share over the edge.
    doubt_px
        How far the whole row may be off: what other ways to measure it, by colour or without shading, differ by.
    """

    position_px: Array
    drop: Array
    doubt_px: float = 0.0


def left_of(direction: Array) -> Array:
    """Return the unit normal (..., 2) to the left of a way in a picture (y down): facing down, left is +x."""
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


@dataclass(frozen=True, slots=True, eq=False)
class Profiles:
    """Colours along neighbouring lines across a contour.

    Attributes
    ----------
    colour, behind
        (N, L, C) in linear light, of the picture and of the background picture or None.
    along
        (L,) distances from the lines' origins.
    depth_px
        How much tube there is inside of the edges.
    """

    colour: Array
    behind: Array | None
    along: Array
    depth_px: float


def colour_profiles(
    signal: Signal,
    origin_px: Array,
    direction: Array,
    along: Array,
    depth_px: float,
    lines_px: tuple[float, ...] = LINES_PX,
) -> Profiles:
    """Sample colours along lines, each the mean of a few parallel ones.

    Parameters
    ----------
    origin_px, direction
        (N, 2) each, in order along the contour.
    along
        (L,) distances from the origin.
    lines_px
        Offsets of the parallel lines that are averaged.
    """
    side = left_of(direction)
    points = origin_px[:, None, :] + along[:, None] * direction[:, None, :]
    samples = [signal.colours(points + offset * side[:, None, :]) for offset in lines_px]
    colour = np.mean([c for c, _ in samples], axis=0)
    empty = [b for _, b in samples if b is not None]
    behind = np.mean(empty, axis=0) if empty else None
    return Profiles(colour, behind, along, depth_px)


def measure_edges(lines: Profiles, guess_px: Array, blur_px: float) -> Edges:
    """Measure falling edges with the colours just inside and outside of each.

    Parameters
    ----------
    guess_px
        (N,) first guess of the edges; NaN where there is none.
    blur_px
        Width of the picture's edges (`blur_of`).
    """
    weights = _CHROMA if lines.colour.shape[-1] == 3 else (1.0,)
    measured = [_measure(lines, guess_px, blur_px, chroma) for chroma in weights]
    best = min(measured, key=_scatter)
    return replace(
        best, doubt_px=best.doubt_px + max(_apart(best.position_px, other.position_px) for other in measured)
    )


def _measure(lines: Profiles, guess_px: Array, blur_px: float, chroma: float) -> Edges:
    position = guess_px
    drop = np.full(len(guess_px), np.nan)
    for _ in range(_PASSES):
        share = local_share(lines, position, blur_px, chroma)
        rise = _rise(share, lines.along, position, blur_px)
        position, drop = _half_level(share, lines.along, position, blur_px, rise)
    flat, _ = _half_level(share, lines.along, position, blur_px, 0 * rise)
    return Edges(position, drop, _RISE_DOUBT * _apart(position, flat))


def _apart(a: Array, b: Array) -> float:
    """Median distance between two rows of edges; NaN-safe, large where one of them was not found."""
    both = np.isfinite(a) & np.isfinite(b)
    return float(abs(np.median((a - b)[both]))) if both.sum() >= 0.3 * len(a) else 1.0


def blur_of(lines: Profiles, guess_px: Array) -> float:
    """Width of the edges as the sigma of a Gaussian: ``fall / (sqrt(2 pi) steepest slope)``, median over the profiles.

    Shading inside adds to the fall: of two sides the one with the smaller value tells the picture's blur.
    """
    share = local_share(lines, guess_px, _SIGMA_FIRST_PX, 1.0)
    start, step = float(lines.along[0]), float(lines.along[1] - lines.along[0])
    far = min(_FAR_PX, _FAR_SHARE * lines.depth_px)
    fall = _mean_between(share, start, step, guess_px - far - 1.0, guess_px - far)
    fall = fall - _mean_between(share, start, step, guess_px + far, guess_px + far + 1.0)
    near = interpolate(share, start, step, guess_px[:, None] + np.arange(-2.5, 2.6, 0.5))
    with np.errstate(invalid="ignore", divide="ignore"):
        sigma = fall / (np.sqrt(2 * np.pi) * (near[:, :-2] - near[:, 2:]).max(1))
    sigma = sigma[np.isfinite(sigma) & (sigma > 0)]
    return float(np.clip(np.median(sigma), *_SIGMA_RANGE_PX)) if len(sigma) else _SIGMA_FIRST_PX


def _rise(share: Array, along: Array, position: Array, sigma: float) -> Array:
    """Slope (N,) per pixel at which the share rises inwards from the edge, running median over the profiles."""
    start, step = float(along[0]), float(along[1] - along[0])
    inside, _ = _clear_of_edge(sigma)
    near = _mean_between(share, start, step, position - inside - 1.0, position - inside)
    far = _mean_between(share, start, step, position - inside - 3.0, position - inside - 2.0)
    return np.clip(_running_median(((far - near) / 2.0)[:, None])[:, 0], -_RISE_MAX, _RISE_MAX)


def _scatter(edges: Edges) -> float:
    """How rough a row of edges is, px: median second difference, plus the share that was not found."""
    found = np.isfinite(edges.position_px)
    if found.sum() < 5:
        return float("inf")
    return float(np.median(np.abs(np.diff(edges.position_px[found], 2))) + (~found).mean())


def local_share(lines: Profiles, edge_px: Array, sigma_px: float, chroma: float) -> Array:
    """Share of tube (N, L) from the colours T and B on both sides of an edge: ``(I - B) . (T - B) / |T - B|^2``.

    T is the colour just inside of the edge and B that of the background picture, or else just outside; both are running
    medians over neighbouring profiles. Shading moves T along the contour, and with it the direction of best contrast.

    Parameters
    ----------
    edge_px
        (N,) places of the edges.
    chroma
        Weight of differences of colour against differences of brightness in the scalar product.
    """
    colour, behind = lines.colour, lines.behind
    start, step = float(lines.along[0]), float(lines.along[1] - lines.along[0])
    inside, outside = _clear_of_edge(sigma_px)

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
    missing: Mask = np.asarray(np.isnan(windows).all(-1))
    return np.asarray(np.where(missing, np.nan, np.nanmedian(np.where(missing[..., None], 0.0, windows), axis=-1)))


def steepest(profile: Array, along: Array, sigma_px: float = 1.0) -> tuple[Array, Array]:
    """Smoothed profile (N, L) and its falling slope (N, L) per pixel, NaN-safe (NaN becomes flat)."""
    filled = np.where(np.isfinite(profile), profile, 0.0)
    step = float(along[1] - along[0])
    smooth = gaussian_filter1d(filled, sigma_px / step, axis=-1, mode="nearest")
    return smooth, -np.gradient(smooth, step, axis=-1)


def refine(profile: Array, along: Array, guess_px: Array) -> Array:
    """Find half-level crossings (N,) nearest a guess, on profiles (N, L) that fall outwards; NaN where none is."""
    position = np.array(guess_px, dtype=float)
    for _ in range(2):
        position, drop = _half_level(profile, along, position, _SIGMA_FIRST_PX, np.zeros(len(position)))
    return np.where(drop > 0, position, np.nan)


def _half_level(share: Array, along: Array, position: Array, sigma: float, rise: Array) -> tuple[Array, Array]:
    """Crossing (N,) of the level half way between the plateaus inside and outside, and the fall (N,) over the edge.

    The inside is extrapolated to the edge by its rise g; blurring a step C with such a ramp behind it leaves
    ``C / 2 + g sigma / sqrt(2 pi)`` at the edge itself.
    """
    start, step = float(along[0]), float(along[1] - along[0])
    inside, outside = _clear_of_edge(sigma)
    high = _mean_between(share, start, step, position - inside - 1.0, position - inside)
    low = _mean_between(share, start, step, position + outside, position + outside + 2.0)
    drop = high - rise * (inside + 0.5) - low
    level = low + drop / 2 + rise * sigma / np.sqrt(2 * np.pi)
    found = _crossing(share, start, step, position, max(2.0, 2.5 * sigma), level)
    return np.where(drop > 0, found, np.nan), np.where(drop > 0, drop, np.nan)


def _clear_of_edge(sigma_px: float) -> tuple[float, float]:
    """Distances inside and outside of an edge of a given width at which its plateaus begin."""
    return (
        max(_INSIDE_PX, _INSIDE_SIGMAS * (sigma_px - _SHARP_PX)),
        max(_OUTSIDE_PX, _OUTSIDE_SIGMAS * sigma_px),
    )


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


def _crossing(profile: Array, start: float, step: float, position: Array, reach: float, level: Array) -> Array:
    """Falling crossing (N,) of a level nearest to `position` within `reach`; NaN where there is none."""
    places = position[:, None] + np.linspace(-1, 1, 33) * reach
    values = interpolate(profile, start, step, places)
    above, below = values[:, :-1] - level[:, None], values[:, 1:] - level[:, None]
    falls = (above >= 0) & (below < 0)
    middle = (places[:, :-1] + places[:, 1:]) / 2
    distance = np.where(falls, np.abs(middle - position[:, None]), np.inf)
    best = distance.argmin(1)
    rows = np.arange(len(profile))
    with np.errstate(divide="ignore", invalid="ignore"):
        part = above[rows, best] / (above[rows, best] - below[rows, best])
    crossing = places[rows, best] + part * (places[:, 1] - places[:, 0])
    return np.where(np.isfinite(distance[rows, best]), crossing, np.nan)
