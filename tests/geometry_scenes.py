"""Random poses, cameras, tubes and rigs for the tests of the geometry (hypothesis strategies)."""

from dataclasses import dataclass

import numpy as np
from hypothesis import settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from tubesight.geometry.camera import Camera
from tubesight.geometry.cone import epipolar_crossing
from tubesight.geometry.pose import Pose
from tubesight.geometry.rig import Rig
from tubesight.simulate import Arc

Array = NDArray[np.float64]

# Fixed seeds, so that a failure of today is a failure of tomorrow; no deadline on a machine that others use too.
few = settings(max_examples=50, deadline=None, derandomize=True)
fewer = settings(max_examples=20, deadline=None, derandomize=True)

EPS = float(np.finfo(float).eps)
LENGTH_MM = 160.0


def triples(limit: float) -> st.SearchStrategy[Array]:
    """Vectors (3,) in a cube."""
    return st.tuples(*[st.floats(-limit, limit)] * 3).map(np.array)


seeds = st.integers(0, 2**32 - 1)
poses = st.builds(Pose.from_rotvec, triples(np.pi), triples(500.0))
rotations = st.builds(Pose.from_rotvec, triples(np.pi), st.just(np.zeros(3)))

# Down to a millionth of a degree beside the ordinary tubes: the near-straight ones are where formulas break.
small_angles = st.floats(-8, 0).map(lambda e: float(10.0**e))
bendings = st.one_of(st.floats(np.radians(1), np.radians(90)), st.sampled_from([np.radians(1), np.pi / 4, np.pi / 2]))
azimuths = st.one_of(st.floats(0, 2 * np.pi), st.sampled_from([0.0, np.pi / 2, np.pi]), small_angles)
tubes = st.builds(Arc, bendings, azimuths, st.just(LENGTH_MM))


@st.composite
def cameras(draw: st.DrawFn, lens: str | None = None) -> Camera:
    """Cameras with non-square pixels, skew, an off-centre axis and a lens that is regular over 60 degrees of field."""
    lens = draw(st.sampled_from(["brown", "rational", "equidistant"])) if lens is None else lens
    fx, fy = draw(st.floats(800, 3000)), draw(st.floats(800, 3000))
    matrix = [[fx, draw(st.floats(-20, 20)), draw(st.floats(900, 1000))], [0, fy, draw(st.floats(500, 600))], [0, 0, 1]]
    # Webcams, machine vision lenses and endoscopes stay inside; with these bounds the derivative of the radius by the
    # angle is positive out to x^2 + y^2 = 0.5: brown 1 - 3 * 0.25 * 0.5 - 5 * 0.1 * 0.25 - 7 * 0.05 * 0.125 > 0.4.
    bounds = {
        "brown": [0.25, 0.1, 0.005, 0.005, 0.05],
        "rational": [0.12, 0.05, 0.005, 0.005, 0.02, 0.12, 0.05, 0.02],
        "equidistant": [0.1, 0.05, 0.02, 0.01],
    }[lens]
    return Camera(np.array(matrix), (1920, 1080), np.array([draw(st.floats(-b, b)) for b in bounds]), lens)


def looking(centre_mm: Array, target_mm: Array, roll_rad: float) -> Pose:
    """``camera_from_base`` of a camera that looks from one point at another."""
    z = (target_mm - centre_mm) / np.linalg.norm(target_mm - centre_mm)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    y = np.cross(z, x)
    cos, sin = np.cos(roll_rad), np.sin(roll_rad)
    rotation = np.stack([cos * x + sin * y, cos * y - sin * x, z])
    return Pose(rotation, -rotation @ centre_mm)


IDEAL = Camera(np.array([[1500.0, 0, 960], [0, 1500, 540], [0, 0, 1]]), (1920, 1080))


@st.composite
def rigs(draw: st.DrawFn) -> Rig:
    """Two cameras 0.3 to 0.5 m from a hanging tube of 160 mm, 10 to 170 degrees apart, rolled at will.

    Half of them are exactly symmetric: level, aimed at the tube's middle, at round angles. That is where tangent rays,
    coplanar axes and vanishing coordinates live.
    """
    symmetric = draw(st.booleans())
    apart = np.radians(draw(st.sampled_from([10.0, 60.0, 90.0, 92.0, 170.0]) if symmetric else st.floats(10, 170)))
    first = draw(st.sampled_from([0.0, np.pi / 2, -apart / 2]) if symmetric else st.floats(0, 2 * np.pi))
    found = {}
    for name, azimuth in (("left", first), ("right", first + apart)):
        distance = 400.0 if symmetric else draw(st.floats(300, 500))
        up = 0.0 if symmetric else draw(st.floats(-0.3, 0.3))
        toward = np.array([np.cos(up) * np.cos(azimuth), np.cos(up) * np.sin(azimuth), np.sin(up)])
        target = np.array([0, 0, LENGTH_MM / 2]) + (0.0 if symmetric else draw(triples(15.0)))
        roll = 0.0 if symmetric else draw(st.floats(-np.pi, np.pi))
        found[name] = looking(np.array([0, 0, LENGTH_MM / 2]) + distance * toward, target, roll)
    return Rig({"left": IDEAL, "right": IDEAL}, found)


def rays_of(rig: Rig, name: str, points_mm: Array) -> Array:
    """Exact rays ``v = (x, y, 1)`` (N, 3) of points in the base frame."""
    local = rig.camera_from_base[name].apply(points_mm)
    return np.asarray(local / local[:, 2:])


@dataclass(frozen=True)
class Sight:
    """Exact images of one tube in two cameras, sorted into the one that makes the cone and the one with the rays."""

    cone_from_ray: Pose
    arc: Array  # (N, 2) centreline on the cone camera's ideal image plane
    slope: Array  # (N, 2) its unit tangents
    rays: Array  # (N, 3)
    depths_mm: Array  # (N,) of the points along the rays
    in_cone_mm: Array  # (N, 3) the points in the cone camera's frame
    crossing: float

    @property
    def sweep(self) -> Array:
        """(N,) how far the image of each point moves across the conic for a relative change of its depth by one.

        ``|dx / dln r|`` times the sine of its angle with the curve: zero for a tangent ray.
        """
        rate = self.rays @ self.cone_from_ray.rotation.T
        p = self.in_cone_mm
        moved = (rate[:, :2] - self.arc * rate[:, 2:]) / p[:, 2:] * self.depths_mm[:, None]
        return np.asarray(np.abs(moved[:, 0] * self.slope[:, 1] - moved[:, 1] * self.slope[:, 0]))


def sight(rig: Rig, tube: Arc, count: int = 41) -> Sight:
    """Photograph a tube without noise; the camera with the larger `epipolar_crossing` makes the cone."""
    s = np.linspace(0, LENGTH_MM, count)
    points, tangents = tube.at(s), tube.tangent(s)
    names = rig.names
    crossing = {
        a: epipolar_crossing(rays_of(rig, a, points)[:, :2], rig.relative_pose(a, b).translation_mm)
        for a, b in (names, names[::-1])
    }
    cone, ray = sorted(names, key=lambda n: -crossing[n])
    p, t = rig.camera_from_base[cone].apply(points), rig.camera_from_base[cone].rotate(tangents)
    arc = p[:, :2] / p[:, 2:]
    slope = (t[:, :2] - arc * t[:, 2:]) / p[:, 2:]
    slope /= np.linalg.norm(slope, axis=1, keepdims=True)
    depths = rig.camera_from_base[ray].apply(points)[:, 2]
    return Sight(rig.relative_pose(cone, ray), arc, slope, rays_of(rig, ray, points), depths, p, crossing[cone])
