"""Views of a tube that no walk follows: from the pieces of its whole silhouette, in each order that may be right."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from tubesight.core import Array, Mask, Status, Tube, Unmeasurable
from tubesight.geometry.camera import Camera
from tubesight.geometry.polyline import lengths_along, points_at
from tubesight.vision.chains import Chain, chains
from tubesight.vision.locate import find_tip
from tubesight.vision.pairs import FIRST_COUNT, FIRST_STEP, FIRST_WIDTHS
from tubesight.vision.pieces import Piece, silhouette_of
from tubesight.vision.see import Start, measured, view_of
from tubesight.vision.signal import TUBE, Signal
from tubesight.vision.stages import Stages, stages
from tubesight.vision.view import View
from tubesight.vision.walker import FINE_STEP_PX, GAP_TOLD, STEP_MAX_PX, STEP_MIN_PX, STEP_WIDTHS, Track

# Views of one picture.
_VIEWS = 3
# Edges are on the tube's own outline where this far outside of them (widths, pixels) is no tube.
_OUTSIDE_WIDTHS, _OUTSIDE_PX = 0.15, 2.0
# So far from its base (widths) a walk looks for the first edges: what is hidden there is not told of.
_AT_BASE = FIRST_WIDTHS + FIRST_COUNT * FIRST_STEP
# Places of a part of the tube whose way is known.
_FEWEST = 3
# Scans of a view: so many along the whole tube.
_SCANS = 64


def see_whole(name: str, signal: Signal, camera: Camera, tube: Tube, start: Start) -> list[tuple[float, View]]:
    """See the tube in one picture by its pieces: views and what their orders cost, the likeliest first.

    Raises
    ------
    Unmeasurable
        If none of them ends in a tip.
    """
    run = stages()
    silhouette = silhouette_of(signal, start.width_px)
    found: list[tuple[float, View]] = []
    failure: Unmeasurable | None = None
    for chain in chains(silhouette, start.px, start.way, start.width_px):
        try:
            found.append((chain.cost, _view(run, name, signal, camera, tube, start, chain)))
        except Unmeasurable as caught:
            failure = failure or caught
        if len(found) == _VIEWS:
            break
    if not found:
        raise failure or Unmeasurable(Status.TUBE_NOT_FOUND, detail="no piece of it is as wide as the tube")
    return found


def _view(run: Stages, name: str, signal: Signal, camera: Camera, tube: Tube, start: Start, chain: Chain) -> View:
    """View of a tube whose pieces lie in this order."""
    step = float(np.clip(STEP_WIDTHS * start.width_px, STEP_MIN_PX, STEP_MAX_PX))
    parts = [part for piece in chain.pieces for part in _followed(run, signal, piece, step)]
    if not parts:
        raise Unmeasurable(Status.TUBE_NOT_FOUND, detail="no piece of it shows both edges")
    track = _joined(parts, start)
    seen = [measured(run, signal, part) for part in parts]
    blur = float(np.median([each[1] for each in seen]))
    outwards = float(np.median([each[3] for each in seen]))
    found = find_tip(run, signal, camera, tube, track, blur, outwards)
    spacing = max(sum(_length(part) for part in parts) / _SCANS, FINE_STEP_PX)
    edges = np.concatenate([_thinned(each[0], spacing) for each in seen])
    doubt = np.max([each[2] for each in seen], axis=0)
    edges = edges[_free(signal, edges)]
    return view_of(name, run, signal, camera, tube, track, found, (edges, blur, doubt, outwards), start.px)


def _followed(run: Stages, signal: Signal, piece: Piece, step_px: float) -> list[Track]:
    """Tracks along a piece: the middles of its pairs of edges, apart where there are none."""
    along = lengths_along(piece.middle_px)
    places = np.linspace(0, along[-1], max(int(along[-1] / step_px) + 1, _FEWEST))
    middle = points_at(piece.middle_px, along, places)
    width = 2 * np.interp(places, along, piece.half_px)
    ways = np.gradient(middle, axis=0)
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    tracks, pairs = [], list[tuple[Array, float]]()
    for place, way, size in zip(middle, ways, width, strict=True):
        pair = run.find_pair(signal, place, way, float(size), True)
        if pair is not None:
            pairs.append(pair)
            continue
        tracks.append(pairs)
        pairs = []
    tracks.append(pairs)
    return [Track(np.array([p for p, _ in t]), np.array([w for _, w in t]), ()) for t in tracks if len(t) >= _FEWEST]


def _joined(parts: list[Track], start: Start) -> Track:
    """One track of several, with the gaps between them, and before them where the base is hidden."""
    gaps = [float(np.linalg.norm(b.middle_px[0] - a.middle_px[-1])) / start.width_px for a, b in pairwise(parts)]
    before = float(np.linalg.norm(parts[0].middle_px[0] - start.px)) / start.width_px
    return Track(
        np.concatenate([part.middle_px for part in parts]),
        np.concatenate([part.width_px for part in parts]),
        tuple(gap for gap in (*((before,) if before > _AT_BASE else ()), *gaps) if gap > GAP_TOLD),
    )


def _length(track: Track) -> float:
    return float(np.linalg.norm(np.diff(track.middle_px, axis=0), axis=1).sum())


def _thinned(edges: Array, spacing_px: float) -> Array:
    """Leave out scans (N, 2, 2) so that they are about so far from each other in all parts of the tube."""
    if len(edges) < 2:
        return edges
    usual = float(np.median(np.linalg.norm(np.diff(edges.mean(1), axis=0), axis=1)))
    return edges[:: max(round(spacing_px / usual), 1)]


def _free(signal: Signal, edges: Array) -> Mask:
    """Tell which scans (N, 2, 2) have surroundings on both sides: before another strand, an edge is that strand's."""
    across = edges[:, 0] - edges[:, 1]
    width = np.linalg.norm(across, axis=1, keepdims=True)
    outward = across / width * (_OUTSIDE_WIDTHS * width + _OUTSIDE_PX)
    outside = signal(np.stack([edges[:, 0] + outward, edges[:, 1] - outward]))
    return np.asarray((np.nan_to_num(outside) < TUBE).all(0))
