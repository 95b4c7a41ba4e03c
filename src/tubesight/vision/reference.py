"""The image processing of Dalvand, Nahavandi & Howe 2016, section 3.1, step by step as the paper describes it.

Undistort and crop, remove the background, clean, origin (`reference_picture`); tip (`reference_tip`); centreline
(`reference_walk`). It is here to compare with, so it is written to do its best: what the paper leaves open is chosen
well, what it says is kept, with the errors this has (docs/reference-pipeline.md).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tubesight.core import Array, Image, Status, Tube, Unmeasurable
from tubesight.geometry.camera import Camera
from tubesight.vision.reference_picture import crop_box, isolate, rays_of, threshold, undistort_box, without_background
from tubesight.vision.reference_tip import TipSearch, find_tip
from tubesight.vision.reference_walk import Walk, erase_tip, mask_radius_px, walk_arcs
from tubesight.vision.see import Start
from tubesight.vision.view import TipView, View

# Edges and circle points are whole pixels: a uniform deviation of one pixel has this standard deviation.
_PIXEL_SD = 12**-0.5


@dataclass(frozen=True, slots=True)
class Reference:
    """The paper's image processing as a vision strategy.

    Attributes
    ----------
    whole
        Undistort the whole photograph, as the paper does; else only the crop.
    """

    whole: bool

    def __call__(
        self,
        name: str,
        image: Image,
        background: Image | None,
        camera: Camera,
        tube: Tube,
        start: Start | None,
        base_px: Array | None = None,
    ) -> View:
        """See the tube in one picture; parameters as those of `tubesight.vision.see.see`.

        `background` is not used: the paper removes the background by its colour.

        Raises
        ------
        Unmeasurable
            If a step does not find what it looks for.
        """
        if tube.tip.shape == "open":
            raise Unmeasurable(Status.TIP_NOT_FOUND, detail="this pipeline needs a tip that is seen")
        base, way = (start.px, start.way) if start is not None else (base_px, None)
        box = crop_box(camera, base, way)
        picture = undistort_box(image, camera, box, self.whole)
        signal = without_background(picture)
        catheter = isolate(threshold(signal), from_base=start is not None)
        ratio = ball_ratio(tube)
        tip = find_tip(catheter, signal, tube.tip, ratio)
        radius = mask_radius_px(catheter, tip, ratio)
        walk = walk_arcs(erase_tip(catheter, tip), catheter.origin_px, tip, radius)
        return _view(name, camera, np.array(box[:2], float), catheter.origin_px, tip, walk)


def ball_ratio(tube: Tube) -> float:
    """Diameter of the tip over that of the tube; 1 where it is a rounded end or not known."""
    if tube.diameter_mm is None or tube.tip.diameter_mm is None:
        return 1.0
    return tube.tip.diameter_mm / tube.diameter_mm


def _view(name: str, camera: Camera, corner: Array, origin: Array, tip: TipSearch, walk: Walk) -> View:
    """Turn what was found in the crop into rays, and into pixels of the photograph."""
    rays = rays_of(camera, corner + walk.points_px)
    edge_rays = rays_of(camera, corner + walk.edges_px)
    rim = rays_of(camera, corner + tip.points_px)
    axis = rays_of(camera, corner + tip.centre_px)
    axis = axis / np.linalg.norm(axis)
    unit_rim = rim / np.linalg.norm(rim, axis=-1, keepdims=True)
    angle = float(np.mean(np.arccos(np.clip(unit_rim @ axis, -1, 1))))
    return View(
        camera=name,
        edges_px=camera.project(edge_rays),
        edge_rays=edge_rays / np.linalg.norm(edge_rays, axis=-1, keepdims=True),
        rays=rays,
        centreline_px=camera.project(rays),
        base=rays_of(camera, corner + origin),
        tip=TipView(axis, camera.project(axis), angle, camera.project(rim), 0.0, _PIXEL_SD),
        edge_sd_px=np.full(2, _PIXEL_SD),
        edge_doubt_px=np.full(2, 0.5),
        blur_px=float("nan"),
        segmenter="background colour: the paper's threshold of the undistorted crop",
    )
