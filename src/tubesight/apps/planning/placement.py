"""The best places of cameras around a workspace, within simple rules.

What pictures tell adds: each candidate place is looked at once, and a set of cameras is judged by the sum of its
members' information, so that all pairs are tried.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from tubesight.apps.planning.information import PARAMETERS, Errors, information
from tubesight.apps.planning.prediction import covariance_of, derivatives
from tubesight.core import Array, InputError, Mask, Tube
from tubesight.geometry.camera import Camera as Lens
from tubesight.geometry.pose import Pose
from tubesight.geometry.rig import Rig, RigCovariance
from tubesight.simulate.phantom import Arc
from tubesight.simulate.rigs import camera_pose

# Steps of the candidates. Deviations change by about 1 % over half a step of angle near their best.
_AZIMUTH_STEP_DEG, _ELEVATION_STEP_DEG, _DISTANCES = 15.0, 15.0, 3
# Placements that are reported.
_BEST = 5


@dataclass(frozen=True, slots=True)
class Camera:
    """A camera one has, without lens distortion: that moves edges, not what they tell."""

    size_px: tuple[int, int]
    focal_px: float
    portrait: bool = False


@dataclass(frozen=True, slots=True)
class Sector:
    """Directions seen from the middle of the workspace, from and to; azimuths may run past 360."""

    azimuth_deg: tuple[float, float]
    elevation_deg: tuple[float, float]

    def holds(self, azimuth_deg: float, elevation_deg: float) -> bool:
        """Tell whether a direction lies in the sector."""
        low, high = self.azimuth_deg
        low_e, high_e = self.elevation_deg
        around = (azimuth_deg - low) % 360 <= high - low
        return around and low_e <= elevation_deg <= high_e


@dataclass(frozen=True, slots=True)
class Rules:
    """Where cameras may stand, see `tubesight.apps.planning.config.EXAMPLE`."""

    distance_mm: tuple[float, float]
    allowed: Sector
    apart_deg: float
    forbidden: tuple[Sector, ...]
    margin_px: float


@dataclass(frozen=True, slots=True)
class Place:
    """Where a camera stands, seen from the point it looks at."""

    azimuth_deg: float
    elevation_deg: float
    distance_mm: float

    @property
    def direction(self) -> Array:
        """(3,) unit, from the target to the camera."""
        a, e = np.radians([self.azimuth_deg, self.elevation_deg])
        return np.array([np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), -np.sin(e)])


@dataclass(frozen=True, slots=True)
class Placement:
    """Places of all cameras, and how good they are.

    Attributes
    ----------
    tip_sd_mm
        Root mean square of the tip's deviation over the poses that all cameras see.
    seen
        Share of the poses that all cameras see.
    """

    places: tuple[Place, ...]
    tip_sd_mm: float
    seen: float


def target_of(phantoms: Sequence[Arc]) -> Array:
    """Point (3,) that all cameras look at: the middle of the box around the workspace."""
    points = np.concatenate([p.at(np.linspace(0.0, p.length_mm, 9)) for p in phantoms])
    return np.asarray((points.min(0) + points.max(0)) / 2)


def candidates(rules: Rules) -> list[Place]:
    """Places on a grid that the rules allow."""
    azimuths = _steps(rules.allowed.azimuth_deg, _AZIMUTH_STEP_DEG)
    if rules.allowed.azimuth_deg[1] - rules.allowed.azimuth_deg[0] >= 360:
        azimuths = azimuths[:-1]
    low, high = rules.distance_mm
    distances = np.unique(np.geomspace(low, high, _DISTANCES).round(3))
    return [
        Place(azimuth, elevation, distance)
        for azimuth in azimuths
        for elevation in _steps(rules.allowed.elevation_deg, _ELEVATION_STEP_DEG)
        # A camera on the axis of the base has no upright.
        if abs(elevation) < 90 and not any(s.holds(azimuth, elevation) for s in rules.forbidden)
        for distance in distances.tolist()
    ]


def _steps(ends: tuple[float, float], step: float) -> list[float]:
    """Both ends and even steps of at most `step` between them."""
    count = int(np.ceil((ends[1] - ends[0]) / step - 1e-9)) + 1
    return sorted(set(np.linspace(*ends, count).tolist()))


def rig_of(places: Iterable[Place], camera: Camera, target_mm: Array, calibration_px: float) -> Rig:
    """Rig with cameras at some places, named ``camera1`` ..., whose directions are known to `calibration_px`."""
    width, height = camera.size_px
    matrix = np.array([[camera.focal_px, 0, (width - 1) / 2], [0, camera.focal_px, (height - 1) / 2], [0, 0, 1.0]])
    # A quarter turn about the line of sight: the picture's x along the tube.
    turn = Pose(np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]]) if camera.portrait else np.eye(3), np.zeros(3))
    lenses, poses = {}, {}
    for k, place in enumerate(places, start=1):
        upright = camera_pose(place.azimuth_deg, place.distance_mm, target_mm.tolist(), place.elevation_deg)
        lenses[f"camera{k}"] = Lens(matrix, camera.size_px)
        poses[f"camera{k}"] = turn @ upright
    if calibration_px == 0:
        return Rig(lenses, poses)
    names = tuple(f"{name}.{axis}" for name in lenses for axis in ("cx", "cy"))
    return Rig(lenses, poses, covariance=RigCovariance(names, calibration_px**2 * np.eye(len(names))))


@dataclass(frozen=True, slots=True, eq=False)
class _Looks:
    """What each of C candidates tells of each of M poses."""

    places: list[Place]
    seen: Mask  # (C, M)
    told: Array  # (C, M, 7, 7)
    calibration: Array  # (C, M, 7, 7) B B^T


def best_places(
    phantoms: Sequence[Arc],
    tube: Tube,
    count: int,
    camera: Camera,
    rules: Rules,
    errors: Errors,
    calibration_px: float,
    progress: Callable[[str, int, int], None] = lambda stage, done, total: None,
) -> list[Placement]:
    """Find the best placements, best first; each has another angle between its cameras, or other elevations.

    Placements that show more of the workspace to all cameras come first, then those of the smaller deviation of the
    tip. All pairs of candidates are tried; further cameras are added one by one where they help most, and then each is
    moved as long as that helps.

    Raises
    ------
    InputError
        If the rules leave too few places, or none from which a tube is seen.
    """
    places = candidates(rules)
    looks = _look(places, phantoms, tube, camera, rules, errors, calibration_px, progress)
    useful = np.flatnonzero(looks.seen.any(1))
    if len(useful) < count:
        raise InputError(
            f"placement: {len(useful)} of {len(places)} places show a whole tube and {count} are needed; "
            "widen distance_mm or the directions, or use a wider lens"
        )
    judge = _Judge(looks, phantoms, errors)
    far = judge.far_apart(rules.apart_deg)
    pairs = [(a, b) for a, b in combinations(useful.tolist(), 2) if far[a, b]]
    if not pairs:
        raise InputError(f"placement: no two places are {rules.apart_deg:g} degrees apart; lower apart_deg")
    found: list[Placement] = []
    tried: set[tuple[float, ...]] = set()
    for _, _, pair in sorted(judge.rank(pairs)):
        kind = _kind([places[k] for k in pair])
        if kind in tried:
            continue
        tried.add(kind)
        chosen = judge.completed(pair, count, useful.tolist(), far)
        if chosen is None:
            continue
        final = _kind([places[k] for k in chosen])
        if chosen == pair or final not in tried:
            tried.add(final)
            ((unseen, tip_sd_mm, _),) = judge.rank([chosen])
            found.append(Placement(tuple(places[k] for k in sorted(chosen)), tip_sd_mm, 1 - unseen))
        if len(found) == _BEST:
            break
    if not found:
        raise InputError(f"placement: no {count} places are {rules.apart_deg:g} degrees apart; lower apart_deg")
    return sorted(found, key=lambda p: (-p.seen, p.tip_sd_mm))


def _kind(places: Sequence[Place]) -> tuple[float, ...]:
    """Describe what placements that differ by a turn about the base's axis have in common: angles and elevations."""
    ways = np.stack([place.direction for place in places])
    angles = np.sort((ways @ ways.T)[np.triu_indices(len(ways), 1)]).round(3)
    return (*angles.tolist(), *sorted(place.elevation_deg for place in places))


def _look(
    places: list[Place],
    phantoms: Sequence[Arc],
    tube: Tube,
    camera: Camera,
    rules: Rules,
    errors: Errors,
    calibration_px: float,
    progress: Callable[[str, int, int], None],
) -> _Looks:
    target = target_of(phantoms)
    shape = (len(places), len(phantoms))
    seen, told = np.zeros(shape, bool), np.zeros((*shape, PARAMETERS, PARAMETERS))
    calibration = np.zeros((*shape, PARAMETERS, PARAMETERS))
    for c, place in enumerate(places):
        rig = rig_of([place], camera, target, calibration_px)
        for m, phantom in enumerate(phantoms):
            view = information(phantom, rig, "camera1", tube, errors, rules.margin_px)
            seen[c, m], told[c, m] = view.seen, view.matrix
            calibration[c, m] = view.by_calibration @ view.by_calibration.T
        progress("places", c + 1, len(places))
    return _Looks(places, seen, told, calibration)


class _Judge:
    """Judges sets of candidates by what they tell together."""

    def __init__(self, looks: _Looks, phantoms: Sequence[Arc], errors: Errors) -> None:
        self._looks = looks
        self._tip = np.stack([_tip_form(phantom) for phantom in phantoms])
        self._prior = np.linalg.inv(covariance_of([np.eye(PARAMETERS)], errors)) - np.eye(PARAMETERS)

    def far_apart(self, apart_deg: float) -> Mask:
        """Tell which candidates (C, C) stand far enough apart, also as seen from opposite sides."""
        ways = np.stack([place.direction for place in self._looks.places])
        angle = np.degrees(np.arccos(np.clip(np.abs(ways @ ways.T), 0, 1)))
        return np.asarray(angle >= apart_deg - 1e-6)

    def rank(self, sets: Sequence[tuple[int, ...]]) -> list[tuple[float, float, tuple[int, ...]]]:
        """Share of poses not seen by all, and the tip's deviation (mm), of sets of candidates."""
        return [(*self._measure(chosen), chosen) for chosen in sets]

    def _measure(self, chosen: tuple[int, ...]) -> tuple[float, float]:
        index = list(chosen)
        seen = self._looks.seen[index].all(0)
        if not seen.any():
            return 1.0, float("inf")
        at = np.ix_(np.array(index), np.flatnonzero(seen))
        covariance = np.linalg.inv(self._looks.told[at].sum(0) + self._prior)
        covariance = covariance + covariance @ self._looks.calibration[at].sum(0) @ covariance
        variance = (covariance * self._tip[seen]).sum((1, 2))
        return 1 - float(seen.mean()), float(np.sqrt(variance.mean()))

    def completed(self, pair: tuple[int, ...], count: int, useful: Sequence[int], far: Mask) -> tuple[int, ...] | None:
        """Add cameras to a pair and move each while that helps; None where no place is left."""
        chosen = pair
        while len(chosen) < count:
            more = [(*chosen, k) for k in useful if far[k, list(chosen)].all()]
            if not more:
                return None
            chosen = min(self.rank(more))[2]
        while count > 2:
            moved = [
                (*others, k)
                for i in range(count)
                for others in [chosen[:i] + chosen[i + 1 :]]
                for k in useful
                if far[k, list(others)].all()
            ]
            better = min(self.rank(moved))
            if better[:2] >= self._measure(chosen):
                break
            chosen = better[2]
        return chosen


def _tip_form(phantom: Arc) -> Array:
    """Matrix (7, 7) whose inner product with the covariance of the unknowns is the variance of the tip's place."""
    tip = derivatives(phantom)[:3]
    return np.asarray(tip.T @ tip)
