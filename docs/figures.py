"""Draw the figures of the theory and conventions pages with the code that they explain: ``python docs/figures.py``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Polygon

from tubesight.core import Array
from tubesight.geometry.arcs import clamped_arc
from tubesight.geometry.cone import Cone
from tubesight.geometry.conic import fit_taubin
from tubesight.geometry.curve import Curve3D
from tubesight.geometry.rig import Rig
from tubesight.geometry.shape import shape_of
from tubesight.simulate import rig_around

IMAGES = Path(__file__).parent / "images"
TUBE, CONE, RAY, OTHER, GREY = "#1f4e79", "#c98a00", "#c0392b", "#1e7d4f", "#666666"


class Sketch:
    """A picture in space, drawn in parallel projection with +z down, as a tube hangs.

    Parameters
    ----------
    azimuth_deg, elevation_deg
        Where the viewer stands: about +z from +x, and above the tube.
    """

    def __init__(self, azimuth_deg: float, elevation_deg: float) -> None:
        a, e = np.radians([azimuth_deg, elevation_deg])
        right = np.array([np.sin(a), -np.cos(a), 0.0])
        towards = np.array([np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), -np.sin(e)])
        self.onto = np.stack([right, np.cross(right, -towards)], 1)
        self.figure, self.axes = blank(8.2, 5.4)

    def flat(self, points: Any) -> Array:
        """Places (N, 2) of points (N, 3)."""
        return np.asarray(np.asarray(points, float) @ self.onto)

    def line(self, points: Any, colour: str, width: float = 1.3, style: str = "-") -> None:
        """Draw a polyline."""
        self.axes.plot(*self.flat(points).T, style, color=colour, linewidth=width, solid_capstyle="round")

    def dot(self, point: Any, colour: str) -> None:
        """Draw a point."""
        self.axes.plot(*self.flat(point), "o", color=colour, markersize=8, zorder=5)

    def text(
        self, point: Any, words: str, colour: str, right: float = 0.0, up: float = 0.0, side: str = "left"
    ) -> None:
        """Write beside a point, so many millimetres to the right and above it."""
        x, y = self.flat(point)
        self.axes.text(x + right, y + up, words, color=colour, fontsize=12, ha=side, va="center")

    def arrow(self, start: Any, end: Any, colour: str) -> None:
        """Draw an arrow."""
        look = {"arrowstyle": "-|>", "color": colour, "linewidth": 1.3, "shrinkA": 0, "shrinkB": 0}
        self.axes.annotate("", self.flat(end), self.flat(start), arrowprops=look, annotation_clip=False)
        self.line([start, end], colour, 0.0)

    def surface(self, points: Any, colour: str) -> None:
        """Fill a polygon, faintly."""
        self.axes.add_patch(Polygon(self.flat(points), color=colour, alpha=0.16, linewidth=0))


def blank(width: float, height: float) -> tuple[Figure, Any]:
    """Make a white picture without axes; the dark theme of the pages leaves it readable."""
    figure = Figure(figsize=(width, height), layout="constrained", facecolor="white")
    axes = figure.add_subplot()
    axes.set_aspect("equal")
    axes.axis("off")
    return figure, axes


def draw_camera(sketch: Sketch, rig: Rig, name: str, colour: str) -> None:
    """Draw a camera as the pyramid of its sight, down to its picture 60 mm away."""
    camera, base_from_camera = rig.cameras[name], rig.camera_from_base[name].inverse()
    width, height = camera.size_px
    corners = camera.unproject(np.array([[0, 0], [width, 0], [width, height], [0, height]], float))
    far = base_from_camera.apply(60.0 * corners)
    for k in range(4):
        sketch.line([rig.centre_mm(name), far[k]], colour, 0.8)
    sketch.line(far[[0, 1, 2, 3, 0]], colour, 1.1)
    sketch.dot(rig.centre_mm(name), colour)


def cone_and_ray() -> Figure:
    """Draw the cone over one view's conic, a ray of the other, and the place where they meet."""
    rig = rig_around(90.0, distance_mm=270.0, distortion=(0.0,) * 5)
    curve: Curve3D = clamped_arc(np.array([-25.0, 75.0, 100.0]))
    points = curve.at(np.linspace(0.0, curve.length_mm, 61))
    centre, eye = rig.centre_mm("left"), rig.centre_mm("right")
    in_cone, in_ray = (rig.camera_from_base[name].apply(points) for name in ("left", "right"))
    ray = in_ray[40] / in_ray[40, 2]
    hits = Cone(fit_taubin(in_cone[:, :2] / in_cone[:, 2:])).intersect(rig.relative_pose("left", "right"), ray[None])
    meeting = rig.camera_from_base["right"].inverse().apply(ray * hits.depths_mm[0][:, None])
    meeting = meeting[np.linalg.norm(meeting - points[40], axis=1).argmin()]
    beyond, image = centre + 1.2 * (points - centre), centre + 60.0 * (points - centre) / in_cone[:, 2:]

    sketch = Sketch(azimuth_deg=20.0, elevation_deg=38.0)
    sketch.surface([centre, *beyond], CONE)
    for k in range(0, 61, 5):
        sketch.line([centre, beyond[k]], CONE, 0.5)
    sketch.line(beyond, CONE, 0.8)
    draw_camera(sketch, rig, "left", CONE)
    draw_camera(sketch, rig, "right", RAY)
    sketch.line(image, CONE, 2.4)
    sketch.line([eye, eye + 1.25 * (meeting - eye)], RAY, 1.6)
    sketch.line(points, TUBE, 4.0)
    sketch.dot(meeting, RAY)
    sketch.text(meeting, "p = r v", RAY, right=5, up=-10)
    sketch.text(points[0], "tube", TUBE, up=10, side="center")
    sketch.text(image[30], "conic C", CONE, right=6)
    sketch.text(centre, "camera i: cone", CONE, up=-14, side="center")
    sketch.text(eye, "camera j: ray", RAY, right=10, up=-14, side="right")
    return sketch.figure


def theta_and_phi() -> Figure:
    """Draw bending and orientation of a curve in the base frame."""
    curve: Curve3D = clamped_arc(np.array([62.0, 48.0, 105.0]))
    shape = shape_of(curve, 0.0)
    points = curve.at(np.linspace(0.0, curve.length_mm, 80))
    tip, end, down = points[-1], curve.tangent([curve.length_mm])[0], np.array([0.0, 0.0, 1.0])
    foot, across = tip * [1, 1, 0], np.array([np.cos(shape.orientation_rad), np.sin(shape.orientation_rad), 0.0])

    sketch = Sketch(azimuth_deg=72.0, elevation_deg=28.0)
    for axis, name, reach in zip(np.eye(3), "xyz", (75.0, 75.0, 165.0), strict=True):
        sketch.arrow(np.zeros(3), reach * axis, GREY)
        sketch.text((reach + 6.0) * axis, name, GREY, side="center")
    sketch.line([np.zeros(3), foot], OTHER, 1.2)
    sketch.line([foot, tip], OTHER, 1.2, ":")
    turn = np.linspace(0.0, shape.orientation_rad, 40)
    arc = 34.0 * np.stack([np.cos(turn), np.sin(turn), 0.0 * turn], 1)
    sketch.line(arc, OTHER, 2.0)
    sketch.text(arc[20], "phi", OTHER, right=4)
    sketch.line(points, TUBE, 4.0)
    sketch.line([tip, tip + 50.0 * down], RAY, 1.2, "--")
    sketch.arrow(tip, tip + 50.0 * end, RAY)
    turn = np.linspace(0.0, shape.bending_rad, 40)[:, None]
    arc = tip + 34.0 * (np.cos(turn) * down + np.sin(turn) * across)
    sketch.line(arc, RAY, 2.0)
    sketch.text(arc[22], "theta", RAY, right=4, up=-5)
    sketch.dot(tip, TUBE)
    sketch.text(tip, "tip", TUBE, right=-7, up=-4, side="right")
    sketch.text(points[38], "length", TUBE, right=6, up=6)
    sketch.text(np.zeros(3), "O, the clamp", GREY, up=8, side="center")
    return sketch.figure


def edge_rays() -> Figure:
    """Draw a section across the tube, with its edge rays, their bisector, and the residual of a curve beside it."""
    figure, axes = blank(8.2, 4.8)
    middle, guess, radius = np.array([0.0, 10.0]), np.array([1.3, 10.0]), 3.0
    half = float(np.arcsin(radius / middle[1]))
    for place, colour, style in ((middle, TUBE, "-"), (guess, CONE, "--")):
        axes.add_patch(Circle((place[0], place[1]), radius, fill=False, color=colour, linewidth=2.2, linestyle=style))
        axes.plot(*place, "+", color=colour, markersize=12, markeredgewidth=2)
    for side in (-1, 1):
        way = np.array([np.sin(side * half), np.cos(half)])
        touch = way * middle[1] * np.cos(half)
        axes.plot(*np.stack([np.zeros(2), 15.0 * way]).T, color=RAY, linewidth=1.5)
        axes.plot(*np.stack([middle, touch]).T, color=GREY, linewidth=1.2)
        axes.plot(*touch, "o", color=RAY, markersize=6)
    axes.plot([0, 0], [0, 15.0], "--", color=OTHER, linewidth=1.4)
    # The right ray passes the guessed middle at a distance that is not the radius: the difference is its residual.
    normal = np.array([np.cos(half), -np.sin(half)])
    on_ray, on_rim = guess - (guess @ normal) * normal, guess + radius * normal
    axes.annotate(
        "",
        on_rim,
        on_ray,
        arrowprops={"arrowstyle": "<->", "color": CONE, "linewidth": 1.8, "shrinkA": 0, "shrinkB": 0},
    )
    axes.text(
        on_rim[0] + 0.5, on_rim[1] - 0.3, "residual of this ray:\ndistance - radius", color=CONE, fontsize=12, va="top"
    )
    axes.text(-4.9, 14.4, "edge rays", color=RAY, fontsize=12, ha="right")
    axes.text(0.25, 14.4, "bisector", color=OTHER, fontsize=12)
    axes.text(-3.3, 10.6, "tube", color=TUBE, fontsize=12, ha="right")
    axes.text(4.5, 11.2, "tube about the curve of the fit", color=CONE, fontsize=12)
    axes.text(-0.5, 0.0, "camera", color=GREY, fontsize=12, ha="right")
    axes.text(-1.5, 8.65, "R", color=GREY, fontsize=12)
    axes.plot(0, 0, "o", color=GREY, markersize=8)
    axes.set(xlim=(-8.5, 12.5), ylim=(-0.7, 15.4))
    return figure


FIGURES = {"cone-and-ray": cone_and_ray, "theta-and-phi": theta_and_phi, "edge-rays": edge_rays}


def main(folder: Path = IMAGES) -> None:
    """Write every figure as SVG, always the same bytes."""
    with mpl.rc_context({"svg.hashsalt": "tubesight", "svg.fonttype": "path"}):
        for name, draw in FIGURES.items():
            figure = draw()
            FigureCanvasSVG(figure)
            figure.savefig(folder / f"{name}.svg", metadata={"Date": None})


if __name__ == "__main__":
    main()
