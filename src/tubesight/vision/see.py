"""One picture to one View: choose the segmenter, walk from the base, measure edges, find the tip."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from itertools import chain

import numpy as np

from tubesight.core import Array, Image, Status, Tube, Unmeasurable
from tubesight.geometry.camera import Camera
from tubesight.geometry.pose import Pose
from tubesight.vision.corner import leads_on, other_ways, walk_on, walks_on
from tubesight.vision.ending import FOUND, Ending, last_way
from tubesight.vision.follow import follow
from tubesight.vision.locate import find_tip, open_tip
from tubesight.vision.search import find_seed
from tubesight.vision.signal import Signal
from tubesight.vision.silhouette import signal_of
from tubesight.vision.stages import Stages, stages
from tubesight.vision.view import TipView, View
from tubesight.vision.walker import Track, walked_edges

# Fewest scans a view needs: below it neither a conic nor a bend can be fitted.
SCANS_MIN = 8
# Fewest places of a track: with fewer its way is not known.
PLACES_MIN = 4
# A base that is known to be near is believed where it is nearer to one end than this share of the other end's distance.
_NEARER = 0.5
# Far above the picture: the upper end of a tube is nearer to it than the lower one.
_ABOVE = np.array([np.nan, -1e9])
# The start of a free tube is looked for within this many widths of the first pair of edges.
_BEFORE_WIDTHS = 3.0
# The colours just inside of an edge of a sharp picture are those 1 to 2 px from it: a tube needs more than twice that
# much room. Edges of thinner ones are those of the walk, of which a whole row may be off by so much.
_THIN_PX, _WALKED_PX = 6.0, 0.1
# A camera that looks along the tube from above sees its first piece behind a clamp that is wider: a tube bends by less
# than its width over so many widths.
_HIDDEN_WIDTHS = (0.0, 2.5, 5.0)
# Near the tip (widths) scans count only if they lie before it, by so many pixels and, at a flat end, widths.
NEAR_WIDTHS, ROOM_PX, ROOM_FLAT_WIDTHS = 1.5, 2.0, 0.15
# A tip whose contour is so smooth, and so much of it seen, is no corner of the tube: on photographs of bent tubes
# corners that passed for tips left 0.26 to 0.93 px or showed 10 places of their contour, true tips 0.03 to 0.14 px and
# 26 places.
SURE_TIP_PX, SURE_CONTOUR = 0.2, 20

# What `walker.measure` tells of a track: edges (N, 2, 2), blur, doubts (2,), and how far outwards the edges lie.
Measured = tuple[Array, float, Array, float]


@dataclass(frozen=True, slots=True, eq=False)
class Start:
    """Where the tube starts in a picture: place (2,), unit way (2,), width."""

    px: Array
    way: Array
    width_px: float


@lru_cache(maxsize=64)
def clamp_start(camera: Camera, camera_from_base: Pose, diameter_mm: float) -> Start:
    """Project the clamp: the base origin, the +z axis there, and the width of the tube.

    Raises
    ------
    Unmeasurable
        If the origin is behind the camera or outside of the picture.
    """
    origin = camera_from_base.translation_mm
    axis = camera_from_base.rotation[:, 2]
    across = np.cross(axis, origin)
    across = across / np.linalg.norm(across) * diameter_mm / 2
    px, ahead, one, other = camera.project(
        np.stack([origin, origin + axis * diameter_mm / 4, origin + across, origin - across])
    )
    if not (np.isfinite(px).all() and np.isfinite(ahead).all() and camera.contains(px)):
        raise Unmeasurable(Status.BASE_HIDDEN, detail="the base origin projects outside of the picture")
    return Start(px, (ahead - px) / np.linalg.norm(ahead - px), float(np.linalg.norm(one - other)))


def see(
    name: str,
    image: Image,
    background: Image | None,
    camera: Camera,
    tube: Tube,
    start: Start | None,
    base_px: Array | None = None,
) -> View:
    """See the tube in one picture.

    Parameters
    ----------
    name
        Name of the camera.
    image, background
        The picture, and the scene without the tube or None.
    start
        Where the tube starts, or None to find it in the picture.
    base_px
        (2,) a pixel at or nearest the base, where one is known; it tells the two ends of a free tube apart.

    Raises
    ------
    Unmeasurable
        If the tube, its tip or enough of it is not found.
    """
    run = stages()
    if start is not None:
        if run.see_from_base is not None:
            view = run.see_from_base(name, image, background, camera, tube, start.px, start.way, start.width_px)
            if view is not None:
                return view
        signal, track = _from_base(run, image, background, start)
        if tube.tip.shape == "open":
            return _open_view(name, run, camera, *follow(run, image, background, signal, track), start.px)
        base = start.px
        track, found = _with_tip(run, signal, camera, tube, track, start.way)
    else:
        signal, last, forward = _both_ways(run, image, background, resume=tube.tip.shape == "open")
        if tube.tip.shape == "open":
            signal, track = _from_nearer(signal, last, forward, base_px)
            return _open_view(name, run, camera, signal, track, _first_of(run, signal, track))
        track, found = _to_tip(run, signal, forward, camera, tube, base_px)
        base = _first_of(run, signal, track)
    return view_of(name, run, signal, camera, tube, track, found, measured(run, signal, track), base)


def view_of(
    name: str,
    run: Stages,
    signal: Signal,
    camera: Camera,
    tube: Tube,
    track: Track,
    found: tuple[TipView, Ending, float],
    edges_of: Measured,
    base: Array,
) -> View:
    """View of a tube whose track, tip (`find_tip`), edges (`measured`) and base (2,) are known.

    Raises
    ------
    Unmeasurable
        If too few of its edges lie before its tip.
    """
    (tip, ending, radius), (edges, blur, doubt, _) = found, edges_of
    room = ROOM_PX + (radius if tube.tip.shape == "ball" else 0.0)
    if tube.tip.shape == "flat":
        room += ROOM_FLAT_WIDTHS * ending.width_px
    near = NEAR_WIDTHS * ending.width_px + room
    edges, unit, rays, centreline, first, rough = run.tube_rays(camera, edges, ending.heading, tip.px, near, room, base)
    if len(edges) < SCANS_MIN:
        raise Unmeasurable(Status.TOO_FEW_POINTS, detail=f"{len(edges)} scans")
    return View(name, edges, unit, rays, centreline, first, tip, rough, doubt, blur, signal.why, _notes(track))


def _open_view(name: str, run: Stages, camera: Camera, signal: Signal, track: Track, base: Array) -> View:
    """View of a tube whose end is not looked for: its last scan stands for the tip."""
    edges, blur, doubt, _ = measured(run, signal, track)
    last, heading, _ = last_way(track.middle_px)
    edges, unit, rays, centreline, first, rough = run.tube_rays(camera, edges, heading, last, 0.0, 0.0, base)
    if len(edges) < SCANS_MIN:
        raise Unmeasurable(Status.TOO_FEW_POINTS, detail=f"{len(edges)} scans")
    tip = open_tip(rays[-1], centreline[-1])
    return View(name, edges, unit, rays, centreline, first, tip, rough, doubt, blur, signal.why, _notes(track))


def measured(run: Stages, signal: Signal, track: Track) -> Measured:
    """Edges, blur and doubts of a track; those of the walk where the tube is too thin to be measured."""
    edges, blur, doubt, outwards = run.measure(signal, track)
    if len(edges) >= SCANS_MIN or float(np.median(track.width_px)) > _THIN_PX:
        return edges, blur, doubt, outwards
    return walked_edges(track), blur, np.full(2, _WALKED_PX), outwards


def _notes(track: Track) -> tuple[str, ...]:
    return tuple(f"bridged a gap of {gap:.1f} widths" for gap in track.gaps)


def _from_base(run: Stages, image: Image, background: Image | None, start: Start) -> tuple[Signal, Track]:
    """Walk from the clamp, or from a little farther on where a clamp wider than the tube hides its first piece."""
    if not 0 < start.width_px < max(image.shape[:2]):
        raise Unmeasurable(Status.TUBE_NOT_FOUND, detail=f"it would be {start.width_px:.0f} px wide at the base")
    failure = None
    for widths in _HIDDEN_WIDTHS:
        try:
            return _walked(run, image, background, start, start.px + widths * start.width_px * start.way)
        except Unmeasurable as caught:
            failure = failure or caught
    raise failure or Unmeasurable(Status.TUBE_NOT_FOUND)


def _walked(run: Stages, image: Image, background: Image | None, start: Start, px: Array) -> tuple[Signal, Track]:
    """Walk from a place (2,) on the axis of the clamp."""
    colours = run.learn(image, background, px, start.way, start.width_px)
    signal = signal_of(image, background, colours)
    track = run.walk_from_base(signal, px, start.way, start.width_px)
    if track is None:
        raise Unmeasurable(Status.TUBE_NOT_FOUND, detail="no pair of edges beside the base")
    if len(track.middle_px) < PLACES_MIN and (longer := walk_on(run, signal, track, start.way)) is not None:
        track = longer
    if len(track.middle_px) < PLACES_MIN:
        raise Unmeasurable(Status.TUBE_NOT_FOUND, detail="its edges are lost right after the base")
    return signal, track


def _with_tip(
    run: Stages, signal: Signal, camera: Camera, tube: Tube, track: Track, way: Array
) -> tuple[Track, tuple[TipView, Ending, float]]:
    """Track to the tip, and the tip.

    Where the walk does not end in a tip, or something leads on from there, it is continued round corners; of all walks
    that end in a tip the longest counts, since a corner may look like one.

    Raises
    ------
    Unmeasurable
        As of the first walk, where no other one leads to a tip.
    """
    found: list[tuple[Track, tuple[TipView, Ending, float]]] = []
    failure: Unmeasurable | None = None
    for longer in chain(walks_on(run, signal, track, way), other_ways(run, signal, track, way) if track.gaps else ()):
        try:
            _, blur, _, outwards = run.measure(signal, longer)
            found.append((longer, find_tip(run, signal, camera, tube, longer, blur, outwards)))
        except Unmeasurable as caught:
            failure = failure or caught
        if longer is track and found and not track.gaps and _is_end(signal, track, found[0][1]):
            break
    if not found:
        raise failure or Unmeasurable(Status.TIP_NOT_FOUND)
    return max(found, key=lambda each: len(each[0].middle_px))


def _is_end(signal: Signal, track: Track, found: tuple[TipView, Ending, float]) -> bool:
    """Whether a tip is surely the end of the tube, or at least nothing leads away from it."""
    tip, _, radius = found
    sure = tip.rms_px < SURE_TIP_PX and len(tip.contour_px) >= SURE_CONTOUR
    return sure or not leads_on(signal, tip.px, radius, track)


def _both_ways(run: Stages, image: Image, background: Image | None, resume: bool) -> tuple[Signal, Signal, Track]:
    """Find the tube and walk from its middle to both ends; signals of its first and last piece, and the track.

    With `resume` the colours may change along the tube.
    """
    seed = find_seed(image, background)
    signal = signal_of(image, background, run.learn(image, background, seed.px, seed.way, seed.width_px))
    found = run.find_pair(signal, seed.px, seed.way, seed.width_px, False)
    if found is None:
        raise Unmeasurable(Status.TUBE_NOT_FOUND, detail="what stands out has no two parallel edges")
    ahead, behind = (run.walk(signal, found[0], way, found[1]) for way in (seed.way, -seed.way))
    first = last = signal
    if resume:
        last, ahead = follow(run, image, background, signal, ahead)
        first, behind = follow(run, image, background, signal, behind)
    forward = Track(
        np.concatenate([behind.middle_px[:0:-1], ahead.middle_px]),
        np.concatenate([behind.width_px[:0:-1], ahead.width_px]),
        behind.gaps + ahead.gaps,
    )
    if len(forward.middle_px) < PLACES_MIN:
        raise Unmeasurable(Status.TUBE_NOT_FOUND, detail="the edges of what stands out are soon lost")
    return first, last, forward


def _reversed(track: Track) -> Track:
    return Track(track.middle_px[::-1], track.width_px[::-1], track.gaps)


def _from_nearer(first: Signal, last: Signal, forward: Track, base_px: Array | None) -> tuple[Signal, Track]:
    """Signal and track from the end that is clearly nearer to `base_px`, or else the upper one."""
    hint = _ABOVE if base_px is None else base_px
    ahead, back = (_distance(forward.middle_px[k], hint) for k in (0, -1))
    if base_px is not None and not min(ahead, back) < _NEARER * max(ahead, back):
        raise Unmeasurable(Status.BASE_HIDDEN, detail="no end of the tube is near the base; mark its base (--base)")
    return (first, forward) if ahead <= back else (last, _reversed(forward))


def _to_tip(
    run: Stages, signal: Signal, forward: Track, camera: Camera, tube: Tube, base_px: Array | None
) -> tuple[Track, tuple[TipView, Ending, float]]:
    """Take for the tip the end that looks like one.

    Where both do, the base is the end nearer to `base_px`, or else the upper one.
    """
    hint = _ABOVE if base_px is None else base_px
    _, blur, _, outwards = run.measure(signal, forward)
    tracks = sorted((forward, _reversed(forward)), key=lambda t: _distance(t.middle_px[0], hint))
    near, far = (_distance(t.middle_px[0], hint) for t in tracks)
    if base_px is not None and near < _NEARER * far:
        tracks = tracks[:1]
    failure = Unmeasurable(Status.TIP_NOT_FOUND)
    for track in tracks:
        try:
            return track, find_tip(run, signal, camera, tube, track, blur, outwards)
        except Unmeasurable as caught:
            failure = caught
    raise failure


def _first_of(run: Stages, signal: Signal, track: Track) -> Array:
    """Pixel (2,) where a free tube starts: where its share ends when followed backwards, else its first scan."""
    ending = run.find_end(signal, track.middle_px[::-1], track.width_px[::-1], _BEFORE_WIDTHS)
    return ending.px if ending.outcome == FOUND else track.middle_px[0]


def _distance(a: Array, b: Array) -> float:
    return float(np.sqrt(np.nansum((a - b) ** 2)))
