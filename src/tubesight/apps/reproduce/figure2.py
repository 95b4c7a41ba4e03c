"""Figure 2: the geometry of two views, and the angles theta and phi."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from tubesight.apps.reproduce import drawing
from tubesight.apps.reproduce.mockup import phantom_of, true_rig
from tubesight.apps.reproduce.study import Context, StudyResult
from tubesight.core import Array
from tubesight.geometry.rig import Rig

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Drawing

# A pose in which both angles are seen well from where the drawing is seen.
_BENDING_DEG, _ORIENTATION_DEG = 70.0, 60.0
# Where point A lies along the tube, and where the virtual image planes are drawn, mm before the cameras.
_POINT_SHARE, _PLANE_MM = 0.7, 90.0
_AXIS_MM = 60.0


def run(context: Context) -> StudyResult:
    """Draw the geometry to scale, with the rig and a tube of the experiments."""
    figure = context.write_figure(
        "figure2",
        _geometry(),
        "Figure 2 of the paper, to scale: tube, base frame O, cameras C1 and C2 with their virtual image planes V1 and "
        "V2, a point A of the centreline with its rays and images, bending theta and orientation phi.",
    )
    text = (
        "The base frame has its origin O where the tube leaves the clamp and z along the tube there. The bending theta "
        "is the angle between the tangents at base and tip, the orientation phi the azimuth of the tip about z, "
        "counted from x. All studies use this rig: two cameras of 1920 x 1080 with a webcam's lens, 90 degrees apart."
    )
    return StudyResult("Figure 2: geometry", (text,), (figure,))


def _geometry() -> Drawing:
    made, axes = drawing.panels(1, 1, (8.0, 5.0), subplot_kw={"projection": "3d"})
    # Labels in space have no place in a layout.
    made.set_layout_engine("none")
    space: Any = axes[0][0]
    rig, phantom = true_rig(), phantom_of(_BENDING_DEG, _ORIENTATION_DEG)
    line = phantom.at(np.linspace(0, phantom.length_mm, 60))
    point = phantom.at(np.array([_POINT_SHARE * phantom.length_mm]))[0]
    for axis, name in zip(np.eye(3), "xyz", strict=True):
        space.plot(*np.stack([np.zeros(3), _AXIS_MM * axis]).T, color="black", linewidth=0.9)
        space.text(*(1.15 * _AXIS_MM * axis), name, style="italic", ha="center", va="center")
    for number, name in enumerate(rig.names, start=1):
        _camera(space, rig, name, number, line, point)
    space.plot(*line.T, color=drawing.COLOURS["silhouette"], linewidth=4, solid_capstyle="round", label="tube")
    space.plot(*point[:, None], marker="o", color="black", markersize=5)
    space.text(*(point + np.array([0, 0, -14])), "A", weight="bold", ha="center")
    space.text(-14, -14, -4, "O", weight="bold", ha="center")
    _angles(space, line, phantom.tangent(np.array([phantom.length_mm]))[0])
    space.set_axis_off()
    # Equal scales, z down; the bending plane is seen from the front.
    low, high = np.array([-90.0, -90.0, -10.0]), np.array([330.0, 330.0, 150.0])
    space.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(high[2], low[2]))
    space.set_box_aspect(tuple(high - low), zoom=1.65)
    space.view_init(elev=24, azim=_ORIENTATION_DEG - 82)
    # The drawing is wider than the square that holds its axes.
    for artist in space.get_children():
        artist.set_clip_on(False)
    return made


def _camera(space: Any, rig: Rig, name: str, number: int, line: Array, point: Array) -> None:
    """Draw a camera's centre, its virtual image plane with the tube's image, and the ray of the point."""
    camera, base_from_camera = rig.cameras[name], rig.camera_from_base[name].inverse()
    centre, colour = rig.centre_mm(name), (drawing.COLOURS["cone_ray"], drawing.COLOURS["reference"])[number - 1]
    width, height = camera.size_px
    corners = np.array([(0, 0), (width, 0), (width, height), (0, height), (0, 0)], float)

    def on_plane(px: Array) -> Array:
        return base_from_camera.apply(_PLANE_MM * camera.unproject(px))

    plane = on_plane(corners)
    space.plot(*plane.T, color=colour, linewidth=1)
    for corner in plane[:4]:
        space.plot(*np.stack([centre, corner]).T, color=colour, linewidth=0.5)
    space.plot(*on_plane(rig.project(name, line)).T, color=colour, linewidth=2)
    image = on_plane(rig.project(name, point[None]))[0]
    space.plot(*np.stack([centre, image, point]).T, color=colour, linestyle="--", linewidth=1, marker=".")
    space.text(
        *(centre + np.array([0, 0, 20 if number == 1 else -12])), f"C{number}", weight="bold", color=colour, ha="center"
    )
    space.text(*plane[3], f"V{number}", color=colour, va="top", ha="left" if number == 1 else "right")


def _angles(space: Any, line: Array, tangent: Array) -> None:
    """Draw theta between the tangents of base and tip, and phi in the plane of x and y."""
    grey = "#444444"
    tip = line[-1]
    for direction in (np.array([0.0, 0.0, 1.0]), tangent):
        space.plot(*np.stack([tip, tip + 70 * direction]).T, color=grey, linewidth=1)
    across = tangent - np.array([0, 0, tangent[2]])
    across /= np.linalg.norm(across)
    theta = np.linspace(0, np.radians(_BENDING_DEG), 30)
    arc = tip + 45 * (np.outer(np.cos(theta), [0, 0, 1]) + np.outer(np.sin(theta), across))
    space.plot(*arc.T, color=grey, linewidth=1.5)
    space.text(*(arc[15] + 12 * (arc[15] - tip) / 45), "θ", ha="center", va="center", size=12)
    foot = np.array([tip[0], tip[1], 0.0])
    space.plot(*np.stack([np.zeros(3), foot, tip]).T, color=grey, linewidth=0.8, linestyle=":")
    phi = np.linspace(0, np.radians(_ORIENTATION_DEG), 30)
    arc = 35 * np.stack([np.cos(phi), np.sin(phi), np.zeros(30)], 1)
    space.plot(*arc.T, color=grey, linewidth=1.5)
    space.text(*(1.4 * arc[15]), "φ", ha="center", va="center", size=12)
