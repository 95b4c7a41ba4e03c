"""One picture to one View: choose the segmenter, walk from the base, measure edges, find the tip."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tubesight.core import Array, Image, Status, Tube, Unmeasurable
from tubesight.geometry.camera import Camera
from tubesight.geometry.pose import Pose
from tubesight.vision.edges import left_of
from tubesight.vision.search import find_seed
from tubesight.vision.signal import Signal
from tubesight.vision.silhouette import choose
from tubesight.vision.tip import end_of_tube, find_tip
from tubesight.vision.view import TipView, View
from tubesight.vision.walker import Track, find_pair, measure, walk

# Fewest scans a view needs: below it neither a conic nor a bend can be fitted.
_SCANS_MIN = 8
# The tube may be hidden in the clamp's shadow or rim: its first pair of edges is looked for this far from the base, in
# widths.
_FIRST_WIDTHS = np.arange(0.3, 3.0, 0.15)


# Ratios of ball and tube that are tried where they are not known; each finds balls a quarter larger or smaller.
_RATIOS_TRIED = (1.0, 1.25, 1.6, 2.0)
# A base that is known to be near is believed where it is nearer to one end than this share of the other end's distance.
_NEARER = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class Start:
    """Where the tube starts in a picture: place (2,), unit way (2,), width."""

    px: Array
    way: Array
    width_px: float


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
    if start is not None:
        signal, track = _from_base(image, background, start)
        base = start.px
        edges, blur, doubt = measure(signal, track)
        tip = _tip_of(signal, camera, tube, track, blur)
    else:
        signal, track, tip = _from_middle(image, background, camera, tube, base_px)
        base = _first_of(signal, camera, track)
        edges, blur, doubt = measure(signal, track)
    edges = _before_tip(edges, tip, track, tube)
    if len(edges) < _SCANS_MIN:
        raise Unmeasurable(Status.TOO_FEW_POINTS, detail=f"{len(edges)} scans")
    rays = camera.unproject(edges)
    unit = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    bisector = unit.sum(1)
    middle = bisector / bisector[:, 2:]
    notes = tuple(f"bridged a gap of {g:.1f} widths" for g in track.gaps)
    return View(
        name,
        edges,
        unit,
        middle,
        camera.project(middle),
        camera.unproject(base),
        tip,
        _roughness(edges),
        doubt,
        blur,
        signal.why,
        notes,
    )


def _from_base(image: Image, background: Image | None, start: Start) -> tuple[Signal, Track]:
    """Walk from the clamp."""
    signal = choose(image, background, start.px, start.way, start.width_px)
    track = walk(signal, *_first_pair(signal, start))
    if len(track.middle_px) < 4:
        raise Unmeasurable(Status.TUBE_NOT_FOUND, detail="its edges are lost right after the base")
    return signal, track


def _from_middle(
    image: Image, background: Image | None, camera: Camera, tube: Tube, base_px: Array | None
) -> tuple[Signal, Track, TipView]:
    """Find the tube, walk from its middle to both ends, and take for the tip the end that looks like one.

    Where both do, the base is the end nearer to `base_px`, or else the upper one.
    """
    seed = find_seed(image, background)
    signal = choose(image, background, seed.px, seed.way, seed.width_px)
    found = find_pair(signal, seed.px, seed.way, seed.width_px, known_width=False)
    if found is None:
        raise Unmeasurable(Status.TUBE_NOT_FOUND, detail="what stands out has no two parallel edges")
    ahead, behind = (walk(signal, found[0], way, found[1]) for way in (seed.way, -seed.way))
    forward = Track(
        np.concatenate([behind.middle_px[:0:-1], ahead.middle_px]),
        np.concatenate([behind.width_px[:0:-1], ahead.width_px]),
        behind.gaps + ahead.gaps,
    )
    if len(forward.middle_px) < 4:
        raise Unmeasurable(Status.TUBE_NOT_FOUND, detail="the edges of what stands out are soon lost")
    backward = Track(forward.middle_px[::-1], forward.width_px[::-1], forward.gaps)
    hint = np.array([np.nan, -1e9]) if base_px is None else base_px
    _, blur, _ = measure(signal, forward)
    tracks = sorted((forward, backward), key=lambda t: _distance(t.middle_px[0], hint))
    near, far = (_distance(t.middle_px[0], hint) for t in tracks)
    if base_px is not None and near < _NEARER * far:
        tracks = tracks[:1]
    failure = Unmeasurable(Status.TIP_NOT_FOUND)
    for track in tracks:
        try:
            return signal, track, _tip_of(signal, camera, tube, track, blur)
        except Unmeasurable as caught:
            failure = caught
    raise failure


def _first_of(signal: Signal, camera: Camera, track: Track) -> Array:
    """Pixel (2,) where a free tube starts: where its share ends when followed backwards, else its first scan."""
    start, way, bend = _last_way(Track(track.middle_px[::-1], track.width_px[::-1], ()))
    width = float(np.median(track.width_px[:5]))
    try:
        end = end_of_tube(signal, camera, start, way, bend, width, 3 * width)
    except Unmeasurable:
        return start
    return np.asarray(start + end * way + bend * end**2 / 2 * left_of(way))


def _last_way(track: Track) -> tuple[Array, Array, float]:
    """Place (2,), unit way (2,) and bend (1 / px, positive to the left) at the end of a track."""
    middle = track.middle_px[-min(len(track.middle_px), 9) :]
    chord = np.linalg.norm(middle - middle[-1], axis=1)
    order = 2 if len(middle) >= 6 else 1
    coefficients = np.polynomial.polynomial.polyfit(-chord, middle, order)
    way = coefficients[1] / np.linalg.norm(coefficients[1])
    return coefficients[0], way, float(2 * coefficients[2] @ left_of(way)) if order == 2 else 0.0


def _distance(a: Array, b: Array) -> float:
    return float(np.sqrt(np.nansum((a - b) ** 2)))


def _first_pair(signal: Signal, start: Start) -> tuple[Array, Array, float]:
    """First place from the base on where the tube shows both edges."""
    for widths in _FIRST_WIDTHS:
        found = find_pair(signal, start.px + widths * start.width_px * start.way, start.way, start.width_px)
        if found is not None:
            return found[0], start.way, found[1]
    raise Unmeasurable(Status.TUBE_NOT_FOUND, detail="no pair of edges beside the base")


def _tip_of(signal: Signal, camera: Camera, tube: Tube, track: Track, blur_px: float) -> TipView:
    """Find the tip from the last part of the track, extrapolated by its way and bend."""
    start, way, bend = _last_way(track)
    width = float(np.median(track.width_px[-5:]))
    views = []
    failure = Unmeasurable(Status.TIP_NOT_FOUND)
    for ratio in _ball_ratios(tube):
        try:
            views.append(find_tip(signal, camera, tube.tip, start, way, bend, width, ratio, blur_px))
        except Unmeasurable as caught:
            failure = caught
    if not views:
        raise failure
    return min(views, key=lambda view: view.rms_px)


def _ball_ratios(tube: Tube) -> tuple[float, ...]:
    """Diameter of ball over tube: known, or to be tried; the round end of an unknown tube may be a ball."""
    if tube.diameter_mm is None and tube.tip.shape != "flat":
        return _RATIOS_TRIED
    if tube.tip.shape == "ball" and tube.tip.diameter_mm is not None and tube.diameter_mm is not None:
        return (tube.tip.diameter_mm / tube.diameter_mm,)
    return (1.0,)


def _before_tip(edges: Array, tip: TipView, track: Track, tube: Tube) -> Array:
    """Leave out scans on the ball or past the end: only the tube itself has parallel edges."""
    way = track.middle_px[-1] - track.middle_px[max(len(track.middle_px) - 4, 0)]
    way = way / np.linalg.norm(way)
    width = float(np.median(track.width_px[-5:]))
    if tube.tip.shape == "ball":
        radius = float(np.median(np.linalg.norm(tip.contour_px - tip.px, axis=1)))
        room = radius + 2.0
    else:
        room = 0.15 * width + 2.0 if tube.tip.shape == "flat" else 2.0
    middle = edges.mean(1)
    near = np.linalg.norm(middle - tip.px, axis=1) < 1.5 * width + room
    keep = ~near | ((tip.px - middle) @ way > room)
    return np.asarray(edges[keep])


def _roughness(edges: Array) -> Array:
    """Robust deviation (2,) of each row of edges (N, 2, 2) from the line of its neighbours, across the tube."""
    across = edges[:, 0] - edges[:, 1]
    across = across / np.linalg.norm(across, axis=1, keepdims=True)
    second = np.diff(edges, 2, axis=0)
    off = np.abs(np.einsum("nsk,nk->ns", second, across[1:-1]))
    # A second difference of independent deviations has sqrt(6) times their deviation.
    return np.asarray(np.maximum(1.4826 * np.median(off, axis=0) / np.sqrt(6), 0.02))
