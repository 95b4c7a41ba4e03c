"""One picture to one View: choose the segmenter, walk from the base, measure edges, find the tip."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from tubesight.core import Array, Image, Status, Tube, Unmeasurable
from tubesight.geometry.camera import Camera
from tubesight.geometry.pose import Pose
from tubesight.vision.ending import FOUND, Ending
from tubesight.vision.locate import find_tip
from tubesight.vision.search import find_seed
from tubesight.vision.signal import Signal
from tubesight.vision.silhouette import signal_of
from tubesight.vision.stages import Stages, stages
from tubesight.vision.view import TipView, View
from tubesight.vision.walker import Track

# Fewest scans a view needs: below it neither a conic nor a bend can be fitted.
_SCANS_MIN = 8
# Fewest places of a track: with fewer its way is not known.
_PLACES_MIN = 4
# A base that is known to be near is believed where it is nearer to one end than this share of the other end's distance.
_NEARER = 0.5
# The start of a free tube is looked for within this many widths of the first pair of edges.
_BEFORE_WIDTHS = 3.0
# Near the tip (widths) scans count only if they lie before it, by so many pixels and, at a flat end, widths.
_NEAR_WIDTHS, _ROOM_PX, _ROOM_FLAT_WIDTHS = 1.5, 2.0, 0.15


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
        signal, track = _from_base(run, image, background, start)
        base = start.px
        edges, blur, doubt = run.measure(signal, track)
        tip, ending, radius = find_tip(run, signal, camera, tube, track, blur)
    else:
        signal, track, (tip, ending, radius) = _from_middle(run, image, background, camera, tube, base_px)
        base = _first_of(run, signal, track)
        edges, blur, doubt = run.measure(signal, track)
    room = _ROOM_PX + (radius if tube.tip.shape == "ball" else 0.0)
    if tube.tip.shape == "flat":
        room += _ROOM_FLAT_WIDTHS * ending.width_px
    near = _NEAR_WIDTHS * ending.width_px + room
    edges, unit, rays, centreline, first, rough = run.tube_rays(camera, edges, ending.heading, tip.px, near, room, base)
    if len(edges) < _SCANS_MIN:
        raise Unmeasurable(Status.TOO_FEW_POINTS, detail=f"{len(edges)} scans")
    notes = tuple(f"bridged a gap of {g:.1f} widths" for g in track.gaps)
    return View(name, edges, unit, rays, centreline, first, tip, rough, doubt, blur, signal.why, notes)


def _from_base(run: Stages, image: Image, background: Image | None, start: Start) -> tuple[Signal, Track]:
    """Walk from the clamp."""
    if not 0 < start.width_px < max(image.shape[:2]):
        raise Unmeasurable(Status.TUBE_NOT_FOUND, detail=f"it would be {start.width_px:.0f} px wide at the base")
    colours = run.learn(image, background, start.px, start.way, start.width_px)
    signal = signal_of(image, background, colours)
    track = run.walk_from_base(signal, start.px, start.way, start.width_px)
    if track is None:
        raise Unmeasurable(Status.TUBE_NOT_FOUND, detail="no pair of edges beside the base")
    if len(track.middle_px) < _PLACES_MIN:
        raise Unmeasurable(Status.TUBE_NOT_FOUND, detail="its edges are lost right after the base")
    return signal, track


def _from_middle(
    run: Stages, image: Image, background: Image | None, camera: Camera, tube: Tube, base_px: Array | None
) -> tuple[Signal, Track, tuple[TipView, Ending, float]]:
    """Find the tube, walk from its middle to both ends, and take for the tip the end that looks like one.

    Where both do, the base is the end nearer to `base_px`, or else the upper one.
    """
    seed = find_seed(image, background)
    signal = signal_of(image, background, run.learn(image, background, seed.px, seed.way, seed.width_px))
    found = run.find_pair(signal, seed.px, seed.way, seed.width_px, False)
    if found is None:
        raise Unmeasurable(Status.TUBE_NOT_FOUND, detail="what stands out has no two parallel edges")
    ahead, behind = (run.walk(signal, found[0], way, found[1]) for way in (seed.way, -seed.way))
    forward = Track(
        np.concatenate([behind.middle_px[:0:-1], ahead.middle_px]),
        np.concatenate([behind.width_px[:0:-1], ahead.width_px]),
        behind.gaps + ahead.gaps,
    )
    if len(forward.middle_px) < _PLACES_MIN:
        raise Unmeasurable(Status.TUBE_NOT_FOUND, detail="the edges of what stands out are soon lost")
    backward = Track(forward.middle_px[::-1], forward.width_px[::-1], forward.gaps)
    hint = np.array([np.nan, -1e9]) if base_px is None else base_px
    _, blur, _ = run.measure(signal, forward)
    tracks = sorted((forward, backward), key=lambda t: _distance(t.middle_px[0], hint))
    near, far = (_distance(t.middle_px[0], hint) for t in tracks)
    if base_px is not None and near < _NEARER * far:
        tracks = tracks[:1]
    failure = Unmeasurable(Status.TIP_NOT_FOUND)
    for track in tracks:
        try:
            return signal, track, find_tip(run, signal, camera, tube, track, blur)
        except Unmeasurable as caught:
            failure = caught
    raise failure


def _first_of(run: Stages, signal: Signal, track: Track) -> Array:
    """Pixel (2,) where a free tube starts: where its share ends when followed backwards, else its first scan."""
    ending = run.find_end(signal, track.middle_px[::-1], track.width_px[::-1], _BEFORE_WIDTHS)
    return ending.px if ending.outcome == FOUND else track.middle_px[0]


def _distance(a: Array, b: Array) -> float:
    return float(np.sqrt(np.nansum((a - b) ** 2)))
