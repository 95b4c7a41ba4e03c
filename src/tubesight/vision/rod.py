"""A rod in one picture: both edges from end to end, and where it ends; it may leave the picture and needs no tip."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from tubesight.core import Array, Image, Status, Unmeasurable, readonly
from tubesight.geometry.camera import Camera
from tubesight.vision.edges import SPACING_PX, colour_profiles, left_of, measure_edges
from tubesight.vision.pairs import find_pair
from tubesight.vision.search import find_seed
from tubesight.vision.signal import Signal
from tubesight.vision.silhouette import choose
from tubesight.vision.walker import Track, measure, walk

# Fewest scans that make a rod: 60 px of it.
_SCANS_MIN = 10
# An end nearer than this to the border of the picture is where the rod leaves it, widths.
_BORDER_WIDTHS = 0.6
# The contour of an end is looked for this far before and behind where the rod was lost, widths.
_BEFORE_WIDTHS, _BEHIND_WIDTHS = 0.8, 1.2
# Share of the width, to both sides of the middle, over which it is measured: beyond, it bends round with the rod.
_FACE_WIDTHS = 0.4
_FACE_LINES = 25
# Colours before and behind a step are averaged over this part of the width.
_STEP_WIDTHS = 0.3
# Where the colours around an end are compared: ahead of it, and to both sides of the rod before it (widths).
_AHEAD_WIDTHS, _AHEAD_HALF = (0.4, 1.2), 0.4
_BESIDE_WIDTHS, _ASIDE_WIDTHS = (-3.0, -1.0), (1.0, 1.5)
# Light that counts as dark when colours are compared: below it differences are noise.
_DARK = 0.02


@dataclass(frozen=True, slots=True, eq=False)
class RodView:
    """A rod in one picture.

    Attributes
    ----------
    camera
        Name.
    edges_px
        (N, 2, 2) left and right edge of each scan, in order from one end to the other.
    path_px
        (M, 2) middles of the rod as far as it was followed, in the same order: shadows and rims near an end may hide
        its edges.
    edge_rays
        (N, 2, 3) the same as undistorted unit rays.
    row_sd_px
        (2,) how far each row of edges may be off as a whole.
    blur_px
        Width of the picture's edges.
    signal
        How rod and surroundings are told apart.
    """

    camera: str
    edges_px: Array
    path_px: Array
    edge_rays: Array
    row_sd_px: Array
    blur_px: float
    signal: Signal

    def __post_init__(self) -> None:
        n = len(self.edges_px)
        shapes = {"edges_px": (n, 2, 2), "path_px": (None, 2), "edge_rays": (n, 2, 3), "row_sd_px": (2,)}
        for name, shape in shapes.items():
            object.__setattr__(self, name, readonly(getattr(self, name), shape, name))

    @property
    def width_px(self) -> float:
        """Median distance between the two edges."""
        return float(np.median(np.linalg.norm(self.edges_px[:, 0] - self.edges_px[:, 1], axis=1)))

    def reversed(self) -> RodView:
        """Return the same rod, followed the other way: left becomes right."""
        return replace(
            self,
            edges_px=self.edges_px[::-1, ::-1],
            path_px=self.path_px[::-1],
            edge_rays=self.edge_rays[::-1, ::-1],
            row_sd_px=self.row_sd_px[::-1],
        )


def see_rod(name: str, image: Image, background: Image | None, camera: Camera, near_px: Array | None = None) -> RodView:
    """See a rod in one picture, wherever it is.

    Parameters
    ----------
    near_px
        (2,) a pixel on it, where one is known.

    Raises
    ------
    Unmeasurable
        If nothing slender with two edges stands out.
    """
    seed = find_seed(image, background, near_px)
    signal = choose(image, background, seed.px, seed.way, seed.width_px)
    found = find_pair(signal, seed.px, seed.way, seed.width_px, known_width=False)
    if found is None:
        raise Unmeasurable(Status.TUBE_NOT_FOUND, name, "what stands out has no two parallel edges")
    ahead, behind = (walk(signal, found[0], way, found[1]) for way in (seed.way, -seed.way))
    track = Track(
        np.concatenate([behind.middle_px[:0:-1], ahead.middle_px]),
        np.concatenate([behind.width_px[:0:-1], ahead.width_px]),
        behind.gaps + ahead.gaps,
    )
    if len(track.middle_px) < 4:
        raise Unmeasurable(Status.TUBE_NOT_FOUND, name, "the edges of what stands out are soon lost")
    edges, blur, doubt, _ = measure(signal, track)
    if len(edges) < _SCANS_MIN:
        raise Unmeasurable(Status.TOO_FEW_POINTS, name, f"{len(edges)} scans")
    rays = camera.unproject(edges)
    unit = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    return RodView(name, edges, track.middle_px, unit, doubt, blur, signal)


def leaves_picture(view: RodView, camera: Camera) -> bool:
    """Whether the rod's end lies at the border of the picture."""
    return not bool(camera.contains(view.path_px[-1:], (0.5 + _BORDER_WIDTHS) * view.width_px).all())


def step_ahead(view: RodView, contour_px: Array) -> float:
    """How much what lies ahead of the rod's end differs from what lies beside the rod before it.

    Ahead of a free end the surroundings go on; a clamp is something else.

    Parameters
    ----------
    contour_px
        (K, 2) contour of the end (`end_contour`).

    Returns
    -------
    float
        Difference of the colours in linear light over their brightness, of the more similar side; 0 where one of them
        is outside the picture.
    """
    _, heading = _last(view)
    end, width = contour_px.mean(0), view.width_px
    ahead = _mean_colour(view, end, heading, _AHEAD_WIDTHS, (-_AHEAD_HALF, _AHEAD_HALF), width)
    offs = []
    for sign in (1, -1):
        low, high = (sign * offset for offset in _ASIDE_WIDTHS)
        side = _mean_colour(view, end, heading, _BESIDE_WIDTHS, (low, high), width)
        offs.append(float(np.abs(ahead - side).max() / (np.abs(side).max() + _DARK)))
    return float(np.nan_to_num(min(offs)))


def _mean_colour(
    view: RodView, end: Array, heading: Array, along: tuple[float, float], across: tuple[float, float], width: float
) -> Array:
    """Median colour (C,) of a patch beside or ahead of an end, its sides in widths."""
    a, b = np.linspace(*along, 15)[:, None, None] * width, np.linspace(*across, 9)[:, None] * width
    colours = view.signal.colours(end + a * heading + b * left_of(heading))[0]
    return np.asarray(np.median(colours.reshape(-1, colours.shape[-1]), axis=0))


def _last(view: RodView) -> tuple[Array, Array]:
    """Where the rod was lost (2,) and its unit way (2,) there."""
    middle = view.edges_px.mean(1)
    way = middle[-1] - middle[max(len(middle) - 10, 0)]
    return view.path_px[-1], way / np.linalg.norm(way)


def end_contour(view: RodView) -> Array:
    """Contour (K, 2) of the end where the rod was lost, pixels.

    Profiles run along the rod on its face; the end is the strongest step of colour there, then
    each profile's half level with the colours on both sides of it.

    Raises
    ------
    Unmeasurable
        If no end stands out.
    """
    end, heading = _last(view)
    width, left = view.width_px, left_of(heading)
    offsets = np.linspace(-_FACE_WIDTHS, _FACE_WIDTHS, _FACE_LINES) * width
    origins = end + offsets[:, None] * left
    along = np.arange(-(_BEFORE_WIDTHS + 1.0) * width - 6.0, (_BEHIND_WIDTHS + 1.0) * width + 6.0, SPACING_PX)
    directions = np.broadcast_to(heading, origins.shape)
    lines = colour_profiles(view.signal, origins, directions, along, width, (0.0,))
    guess = _strongest_step(lines.colour, along, width)
    edges = measure_edges(lines, np.full(len(offsets), guess), view.blur_px)
    good = np.isfinite(edges.position_px)
    if good.sum() < 0.4 * len(offsets):
        raise Unmeasurable(Status.BASE_HIDDEN, view.camera, "where the rod ends does not stand out")
    return np.asarray(origins[good] + heading * edges.position_px[good][:, None])


def _strongest_step(colour: Array, along: Array, width: float) -> float:
    """Place along profiles (N, L, C) where their median colour changes most, near the origin; NaN where all is dark."""
    middle = np.median(np.nan_to_num(colour), axis=0)
    n = max(int(_STEP_WIDTHS * width / SPACING_PX), 2)
    total = np.concatenate([np.zeros((1, middle.shape[1])), np.cumsum(middle, axis=0)])
    before, after = (total[n:-n] - total[: -2 * n]) / n, (total[2 * n :] - total[n:-n]) / n
    # The two means meet between the samples n - 1 and n of the profile.
    places = along[n : n + len(before)] - SPACING_PX / 2
    strength = np.abs(after - before).max(-1) / (np.abs(before).max(-1) + np.abs(after).max(-1) + _DARK)
    near = (places > -_BEFORE_WIDTHS * width) & (places < _BEHIND_WIDTHS * width)
    return float(places[near][int(strength[near].argmax())])
