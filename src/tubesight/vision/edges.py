"""Sub-pixel edges on lines across a contour, from the colours on both sides of each."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from tubesight.core import Array, Mask
from tubesight.vision.signal import Signal

# Spacing of samples along a line: at one pixel an edge of a sharp picture shifts by 0.05 px with their phase.
SPACING_PX = 0.75
# Parallel lines averaged into one, this far to both sides along the contour: nearer samples share their pixels.
LINE_PX = 0.75
LINES_PX = (-LINE_PX, LINE_PX)
# Plateaus of the half level lie this far inside and outside of the edge of a sharp picture (limb shading makes the
# inside rise within pixels, gamma and sharpening disturb the outside), and clear of the edge itself where it is
# blurred: an edge of a sharp picture has a sigma of 0.7 to 1 px.
INSIDE_PX, OUTSIDE_PX = 1.0, 2.5
SHARP_PX, INSIDE_SIGMAS, OUTSIDE_SIGMAS = 0.55, 2.2, 2.5
# Extent of the plateaus inside and outside, and samples averaged over each.
HIGH_PX, LOW_PX, PLATEAU_SAMPLES = 1.0, 2.0, 3
# The rise inside is measured from the plateau to another one this much deeper.
DEEPER_PX = 2.0
SIGMA_FIRST_PX = 0.8
SIGMA_RANGE_PX = (0.4, 4.0)
# How far an edge may lie from its guess.
SLACK_PX = 1.5
# Half levels are found this often, each with plateaus at the last place.
PASSES = 3
# The width of an edge is measured between plateaus this far from it, but no deeper than a part of the tube.
FAR_PX, FAR_SHARE = 5.0, 0.5
# Edges that may be anywhere within so many pixels of a guess are found between plateaus just inside of it and this far
# outside, where nothing is left of a blurred edge that the guess lies inside of by 2 px.
NEAR_PX, BEYOND_PX = (1.0, 2.0), (4.5, 6.0)
# Shading inside may rise by this share of the edge's fall per pixel and is then extrapolated to the edge; more is a
# highlight.
RISE_MAX = 0.12
# The extrapolation is right to about this part of what it changes.
RISE_DOUBT = 0.3
# Colours and rises are medians over this many neighbouring lines to both sides.
NEIGHBOURS = 2
# Cameras and JPEG record colour at half resolution, so edges are measured by brightness first; where tube and
# background are equally bright colour has to help: it is tried too and taken where it gives a smoother row. A row that
# is smoother than this needs no help; colour then only tells how far the row may be off.
CHROMA, SMOOTH_PX = (1 / 3, 1.0), 0.1
# Blue, green and red in brightness, linear light (ITU-R BT.601, what JPEG separates by).
_LUMA_BGR = np.array([0.114, 0.587, 0.299])
# Contrast, squared, below which a share is noise over noise.
POWER_MIN = 1e-7


@dataclass(frozen=True, slots=True, eq=False)
class Edges:
    """Edges found on lines.

    Attributes
    ----------
    position_px
        (N,) distance along each line; NaN where no edge was found.
    drop
        (N,) fall of the tube's share over the edge.
    doubt_px
        How far the whole row may be off: what other ways to measure it, by colour or without shading, differ by.
    """

    position_px: Array
    drop: Array
    doubt_px: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Profiles:
    """Colours along neighbouring lines across a contour.

    Attributes
    ----------
    colour, behind
        (N, L, C) in linear light, of the picture and of the background picture or None.
    along
        (L,) distances from the lines' origins, equally spaced.
    depth_px
        How much tube there is inside of the edges.
    """

    colour: Array
    behind: Array | None
    along: Array
    depth_px: float


def left_of(direction: Array) -> Array:
    """Return the unit normal (..., 2) to the left of a way in a picture (y down): facing down, left is +x."""
    return np.stack([direction[..., 1], -direction[..., 0]], -1)


def window(blur_px: float, depth_px: float = np.inf) -> Array:
    """Distances (L,) from a guess at which an edge of a given blur is sampled: its plateaus and room for the guess."""
    inside, outside = clear_of_edge(blur_px)
    low = max(-(inside + HIGH_PX + DEEPER_PX + SLACK_PX), -depth_px)
    return np.asarray(low + SPACING_PX * np.arange(int((outside + LOW_PX + SLACK_PX - low) / SPACING_PX) + 2.0))


def wide_window() -> Array:
    """Distances (L,) from a guess at which an edge of unknown blur is sampled (`blur_and_displacement`)."""
    reach = FAR_PX + 1.0
    return np.asarray(-reach + SPACING_PX * np.arange(int(2 * reach / SPACING_PX) + 2.0))


def _points(origin_px: Array, direction: Array, along: Array, lines_px: tuple[float, ...]) -> list[Array]:
    """Points (N, L, 2) along lines, once for each parallel one."""
    side = left_of(direction)
    points = origin_px[:, None, :] + along[:, None] * direction[:, None, :]
    return [points + offset * side[:, None, :] for offset in lines_px]


def profiles(
    signal: Signal, origin_px: Array, direction: Array, along: Array, lines_px: tuple[float, ...] = LINES_PX
) -> Array:
    """Likeness to tube (N, L) along lines, each the mean of a few parallel ones; NaN outside the picture.

    Parameters
    ----------
    origin_px, direction
        (N, 2) each; unit directions of the lines.
    along
        (L,) distances from the origin, pixels.
    lines_px
        Offsets of the parallel lines that are averaged.
    """
    return np.asarray(np.mean([signal(p) for p in _points(origin_px, direction, along, lines_px)], axis=0))


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
    samples = [signal.colours(p) for p in _points(origin_px, direction, along, lines_px)]
    colour = np.mean([c for c, _ in samples], axis=0)
    empty = [b for _, b in samples if b is not None]
    return Profiles(colour, np.mean(empty, axis=0) if empty else None, along, depth_px)


def measure_edges(lines: Profiles, guess_px: Array, blur_px: float) -> Edges:
    """Measure falling edges with the colours just inside and outside of each.

    Parameters
    ----------
    guess_px
        (N,) first guess of the edges; NaN where there is none.
    blur_px
        Width of the picture's edges (`blur_and_displacement`).
    """
    sides = both_sides(lines, guess_px, blur_px)
    gray = lines.colour.shape[-1] != 3
    one = _measure(local_share(lines, *sides, 1.0 if gray else CHROMA[0]), lines.along, guess_px, blur_px, PASSES)
    if gray:
        return one
    share = local_share(lines, *sides, CHROMA[1])
    rough = _scatter(one)
    if rough > SMOOTH_PX:
        other = _measure(share, lines.along, guess_px, blur_px, PASSES)
        one, other = (other, one) if _scatter(other) < rough else (one, other)
    else:
        other = _measure(share, lines.along, one.position_px, blur_px, 1)
    return replace(one, doubt_px=one.doubt_px + _apart(one.position_px, other.position_px))


def _measure(share: Array, along: Array, guess_px: Array, blur_px: float, passes: int) -> Edges:
    rise = np.zeros(len(guess_px))
    position, drop = guess_px, rise
    for _ in range(passes):
        rise = _rise(share, along, position, blur_px)
        position, drop = _half_level(share, along, position, blur_px, rise)
    flat, _ = _half_level(share, along, position, blur_px, 0 * rise)
    return Edges(position, drop, RISE_DOUBT * _apart(position, flat))


def _apart(a: Array, b: Array) -> float:
    """Median distance between two rows of edges; NaN-safe, large where one of them was not found."""
    both = np.isfinite(a) & np.isfinite(b)
    return float(abs(np.median((a - b)[both]))) if both.any() and both.sum() >= 0.3 * len(a) else 1.0


def _scatter(edges: Edges) -> float:
    """How rough a row of edges is, px: median second difference, plus the share that was not found."""
    found = np.isfinite(edges.position_px)
    if found.sum() < 5:
        return float("inf")
    return float(np.median(np.abs(np.diff(edges.position_px[found], 2))) + (~found).mean())


def blur_and_displacement(lines: Profiles) -> tuple[float, float]:
    """Width of a row of edges, and how far outwards of where its lines begin it lies; both medians over the lines.

    The width is the sigma of a Gaussian, ``fall / (sqrt(2 pi) steepest slope)``. Shading inside adds to the fall: of
    two sides the one with the smaller value tells the picture's blur. The displacement is 0 where the edges are not
    seen on most lines; it is for guesses by the likeness to tube, which calls the blurred rim of a dark tube a shadow
    on what is behind it.
    """
    share = local_share(lines, *both_sides(lines, np.zeros(len(lines.colour)), SIGMA_FIRST_PX), 1.0)
    return _blur(share, lines), _displacement(share, lines.along)


def _blur(share: Array, lines: Profiles) -> float:
    start = np.zeros(len(share))
    far = min(FAR_PX, FAR_SHARE * lines.depth_px)
    fall = _mean_between(share, lines.along, start - far - 1.0, start - far)
    fall = fall - _mean_between(share, lines.along, start + far, start + far + 1.0)
    near = interpolate(share, lines.along, start[:, None] + np.arange(-2.5, 2.6, 0.5))
    with np.errstate(invalid="ignore", divide="ignore"):
        sigma = fall / (np.sqrt(2 * np.pi) * (near[:, :-2] - near[:, 2:]).max(1))
    sigma = sigma[np.isfinite(sigma) & (sigma > 0)]
    return float(np.clip(np.median(sigma), *SIGMA_RANGE_PX)) if len(sigma) else SIGMA_FIRST_PX


def _displacement(share: Array, along: Array) -> float:
    start = np.zeros(len(share))
    high = _mean_between(share, along, start - NEAR_PX[1], start - NEAR_PX[0])
    low = _mean_between(share, along, start + BEYOND_PX[0], start + BEYOND_PX[1])
    found = _crossing(share, along, start, BEYOND_PX[0], (high + low) / 2)
    found = found[np.isfinite(found)]
    return float(np.median(found)) if 2 * len(found) > len(start) else 0.0


def both_sides(lines: Profiles, edge_px: Array, sigma_px: float) -> tuple[Array, Array]:
    """Colours of the tube (N, 1, C) just inside of the edges and of the cloth just outside.

    Both are running medians over neighbouring lines. Where there is a background picture its colours (N, L, C) are
    those of the cloth.
    """
    inside, outside = clear_of_edge(sigma_px)

    def plateau(low: Array, high: Array) -> Array:
        means = [_mean_between(lines.colour[..., c], lines.along, low, high) for c in range(lines.colour.shape[-1])]
        return _running_median(np.stack(means, -1))[:, None, :]

    tube = plateau(edge_px - inside - HIGH_PX, edge_px - inside)
    if lines.behind is not None:
        return tube, lines.behind
    return tube, plateau(edge_px + outside, edge_px + outside + LOW_PX)


def local_share(lines: Profiles, tube: Array, cloth: Array, chroma: float) -> Array:
    """Share of tube (N, L) from the colours T and B on both sides of an edge: ``(I - B) . (T - B) / |T - B|^2``.

    Shading moves T along the contour, and with it the direction of best contrast.

    Parameters
    ----------
    tube, cloth
        T and B (`both_sides`).
    chroma
        Weight of differences of colour against differences of brightness in the scalar product.
    """
    weighted = (tube - cloth) @ metric(tube.shape[-1], chroma)
    power = (weighted * (tube - cloth)).sum(-1)
    return np.asarray(((lines.colour - cloth) * weighted).sum(-1) / np.maximum(power, POWER_MIN))


def metric(channels: int, chroma: float) -> Array:
    """Scalar product (C, C) of colours: brightness y, and c (blue - y) and c (red - y)."""
    if channels != 3:
        return np.eye(channels)
    y = _LUMA_BGR
    features = np.stack([y, chroma * (np.array([1.0, 0.0, 0.0]) - y), chroma * (np.array([0.0, 0.0, 1.0]) - y)])
    return np.asarray(features.T @ features)


def _running_median(rows: Array) -> Array:
    """Median over neighbouring rows (N, C), NaN-safe; mirrored at the ends."""
    half = min(NEIGHBOURS, len(rows) - 1)
    padded = np.pad(rows, ((half, half), (0, 0)), mode="reflect")
    windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * half + 1, axis=0)
    missing: Mask = np.asarray(np.isnan(windows).all(-1))
    return np.asarray(np.where(missing, np.nan, np.nanmedian(np.where(missing[..., None], 0.0, windows), axis=-1)))


def _rise(share: Array, along: Array, position: Array, sigma: float) -> Array:
    """Slope (N,) per pixel at which the share rises inwards, running median; 0 where the tube ends before."""
    inside, _ = clear_of_edge(sigma)
    near = _mean_between(share, along, position - inside - HIGH_PX, position - inside)
    deep = position - inside - DEEPER_PX
    far = _mean_between(share, along, deep - HIGH_PX, deep)
    rise = _running_median(((far - near) / DEEPER_PX)[:, None])[:, 0]
    return np.where(np.isnan(rise), 0.0, np.clip(rise, -RISE_MAX, RISE_MAX))


def _half_level(share: Array, along: Array, position: Array, sigma: float, rise: Array) -> tuple[Array, Array]:
    """Crossing (N,) of the level half way between the plateaus inside and outside, and the fall (N,) over the edge.

    The inside is extrapolated to the edge by its rise g; blurring a step C with such a ramp behind it leaves
    ``C / 2 + g sigma / sqrt(2 pi)`` at the edge itself.
    """
    inside, outside = clear_of_edge(sigma)
    high = _mean_between(share, along, position - inside - HIGH_PX, position - inside)
    low = _mean_between(share, along, position + outside, position + outside + LOW_PX)
    drop = high - rise * (inside + HIGH_PX / 2) - low
    level = low + drop / 2 + rise * sigma / np.sqrt(2 * np.pi)
    found = _crossing(share, along, position, max(2.0, 2.5 * sigma), level)
    return np.where(drop > 0, found, np.nan), np.where(drop > 0, drop, np.nan)


def clear_of_edge(sigma_px: float) -> tuple[float, float]:
    """Distances inside and outside of an edge of a given width at which its plateaus begin."""
    return (
        max(INSIDE_PX, INSIDE_SIGMAS * (sigma_px - SHARP_PX)),
        max(OUTSIDE_PX, OUTSIDE_SIGMAS * sigma_px),
    )


def _mean_between(profile: Array, along: Array, low: Array, high: Array) -> Array:
    """Mean of each profile (N, L) between two places (N,), by a few samples."""
    places = low[:, None] + np.linspace(0, 1, PLATEAU_SAMPLES) * (high - low)[:, None]
    return np.asarray(interpolate(profile, along, places).mean(1))


def interpolate(profile: Array, along: Array, places: Array) -> Array:
    """Linear interpolation of profiles (N, L) at places (N, K); NaN outside."""
    position = (places - along[0]) / (along[1] - along[0])
    inside = (position >= 0) & (position <= profile.shape[1] - 1)
    position = np.where(inside, position, 0.0)
    left = np.minimum(position.astype(np.intp), profile.shape[1] - 2)
    t = position - left
    rows = np.arange(len(profile))[:, None]
    return np.where(inside, profile[rows, left] * (1 - t) + profile[rows, left + 1] * t, np.nan)


def _crossing(profile: Array, along: Array, position: Array, reach: float, level: Array) -> Array:
    """Falling crossing (N,) of a level nearest to `position` within `reach`; NaN where there is none."""
    above, below = profile[:, :-1] - level[:, None], profile[:, 1:] - level[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        place = along[:-1] + (along[1] - along[0]) * above / (above - below)
        distance = np.where((above >= 0) & (below < 0), np.abs(place - position[:, None]), np.inf)
    distance = np.where(distance <= reach, distance, np.inf)
    best = distance.argmin(1)
    rows = np.arange(len(profile))
    return np.where(np.isfinite(distance[rows, best]), place[rows, best], np.nan)
