"""Figure 3: the set-up, seen from above, and what its cameras see."""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np

from tubesight.apps.reproduce import drawing
from tubesight.apps.reproduce.mockup import ELLIPSE_DEG, ELLIPSE_RATIO, phantom_of, photograph, through_jpeg, true_rig
from tubesight.apps.reproduce.session import Session, board_of, poses_of
from tubesight.apps.reproduce.study import Context, StudyResult
from tubesight.core import FramePair
from tubesight.geometry.rig import Rig
from tubesight.simulate import Scene, render_board_pair

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Drawing

# Poses shown: bending, orientation, ratio of the axes.
_POSES = ((30.0, 150.0, 1.0), (70.0, 60.0, 1.0), (ELLIPSE_DEG, 300.0, ELLIPSE_RATIO))


def run(context: Context) -> StudyResult:
    """Draw the set-up and sample photographs."""
    rig, scene = true_rig(), Scene(seed=context.seed_of("scene"))
    pairs = {
        f"{'circular' if ratio == 1 else 'elliptic'}, bent by {bending:.0f} deg at {phi:.0f} deg": photograph(
            rig, phantom_of(bending, phi, ratio), scene, f"{bending} {phi}"
        )
        for bending, phi, ratio in _POSES
    }
    session = Session(seed=context.seed)
    board, pose = board_of(session), poses_of(session, rig)[0]
    pairs["board to calibrate with"] = through_jpeg(render_board_pair(rig, board, pose, scene, "board"))
    figures = (
        context.write_figure("figure3_setup", _setup(rig), "The set-up from above and from the side, to scale."),
        context.write_figure("figure3_pictures", _pictures(rig, pairs), "Rendered photographs of both cameras."),
    )
    baseline = np.linalg.norm(np.subtract(*(rig.centre_mm(name) for name in rig.names)))
    camera = rig.cameras[rig.names[0]]
    text = (
        "Figure 3 of the paper shows two webcams about 90 degrees apart before a tube that hangs from a holder. The "
        f"simulated set-up has cameras {baseline:.0f} mm apart, {camera.size_px[0]} x {camera.size_px[1]} pixels and a "
        f"focal length of {camera.focal_px:.0f} pixels, lens distortion, shading, shadows, noise and JPEG."
    )
    return StudyResult("Figure 3: set-up", (text,), figures)


def _setup(rig: Rig) -> Drawing:
    made, axes = drawing.panels(1, 2, (9.0, 4.2))
    for panel, (across, along), title in zip(axes[0], ((0, 1), (0, 2)), ("from above", "from the side"), strict=True):
        _plan(panel, rig, across, along)
        panel.set(title=title, xlabel=f"{'xyz'[across]} [mm]", ylabel=f"{'xyz'[along]} [mm]")
        panel.set_aspect("equal", adjustable="datalim")
    # The tube hangs: z points down.
    axes[0][1].invert_yaxis()
    drawing.legend_below(made, axes[0][0], columns=4)
    return made


def _plan(panel: Axes, rig: Rig, across: int, along: int) -> None:
    """Draw cameras with their fields of view, and tubes, onto two coordinates."""
    colours = (drawing.COLOURS["cone_ray"], drawing.COLOURS["reference"])
    for name, colour in zip(rig.names, colours, strict=True):
        camera, centre = rig.cameras[name], rig.centre_mm(name)
        width, height = camera.size_px
        edge = np.array([(0, height / 2), (width, height / 2), (width / 2, 0), (width / 2, height)])
        ends = centre + 420 * rig.directions(name, camera.unproject(edge))
        seen = np.stack([ends[0], centre, ends[1]]) if along == 1 else np.stack([ends[2], centre, ends[3]])
        panel.fill(seen[:, across], seen[:, along], color=colour, alpha=0.12, linewidth=0)
        panel.plot(centre[across], centre[along], marker="s", markersize=8, linestyle="", color=colour, label=name)
    for bending, phi, ratio in _POSES:
        phantom = phantom_of(bending, phi, ratio)
        line = phantom.at(np.linspace(0, phantom.length_mm, 50))
        label = "tubes" if bending == _POSES[0][0] else None
        panel.plot(line[:, across], line[:, along], color=drawing.COLOURS["silhouette"], linewidth=3, label=label)
    panel.plot(0, 0, marker="+", color="black", markersize=9, linestyle="", label="base")


def _pictures(rig: Rig, pairs: dict[str, FramePair]) -> Drawing:
    made, axes = drawing.panels(len(pairs), len(rig.names), (8.0, 2.45 * len(pairs)))
    for (title, pair), row in zip(pairs.items(), axes, strict=True):
        for name, panel in zip(rig.names, row, strict=True):
            # Half the pixels are enough for print, and the report stays small.
            small = cv2.resize(pair.images[name], None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
            panel.imshow(cv2.cvtColor(small, cv2.COLOR_BGR2RGB))
            panel.set_axis_off()
            panel.set_title(f"{name}: {title}")
    return made
