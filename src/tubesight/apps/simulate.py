"""A data set of simulated photographs with its truth, in the layout of real ones."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml

from tubesight.core import Board, FramePair, Image, Tip, Tube
from tubesight.files.rig import save_rig
from tubesight.files.safe import write_atomic
from tubesight.files.tables import write_json
from tubesight.geometry.pose import Pose
from tubesight.geometry.rig import Rig
from tubesight.simulate import (
    Arc,
    EllipseArc,
    Phantom,
    Pieces,
    Scene,
    board_views,
    render_background,
    render_board_pair,
    render_pair,
    rig_around,
    straight,
    truth,
)

# Quality of the photographs: that of webcams and phones, whose errors of 1 to 2 gray levels pictures then have.
_JPEG_QUALITY = 93
# A board at poses known in the base frame: two are enough, since every corner counts.
_REGISTRATION_VIEWS = 2

Progress = Callable[[int, int], None]


def _default_board() -> Board:
    return Board("chessboard", (10, 7), 13.0)


def _default_tube() -> Tube:
    return Tube(12.0, Tip("ball", 16.0), clamped=True)


@dataclass(frozen=True, slots=True)
class DatasetPlan:
    """What to photograph.

    Attributes
    ----------
    phantoms
        By name of the frame.
    rig
        The true cameras.
    tube, board
        As the user knows them.
    scene
        How the photographs look; with clutter the set gets background pictures.
    board_views
        Pairs of pictures of the board to calibrate with; 0 for a data set without calibration and registration.
    board_seed
        Changes the poses of the board.
    """

    phantoms: Mapping[str, Phantom]
    rig: Rig = field(default_factory=rig_around)
    tube: Tube = field(default_factory=_default_tube)
    board: Board = field(default_factory=_default_board)
    scene: Scene = field(default_factory=Scene)
    board_views: int = 14
    board_seed: int = 0

    def __post_init__(self) -> None:
        if not self.phantoms:
            raise ValueError("a data set needs at least one phantom")
        bad = [name for name in self.phantoms if not name or Path(name).name != name]
        if bad:
            raise ValueError(f"frame names become file names; {bad[0]!r} cannot be one")


def write_dataset(folder: Path, plan: DatasetPlan, progress: Progress | None = None) -> None:
    """Photograph a plan and write the data set.

    Writes ``left/`` and ``right/`` (the cameras' names), ``calibration/`` and ``registration/`` with the same
    subfolders, ``background/`` where the scene is cluttered, ``board.yaml``, ``registration.yaml``, ``tube.yaml``,
    ``rig_true.yaml`` and ``truth.json``.

    Parameters
    ----------
    progress
        Called with the number of pairs of photographs done and their total.

    Raises
    ------
    InputError
        If the folder cannot be written.
    ValueError
        If the tube or the board cannot be drawn with these cameras.
    """
    _write_files(folder, plan)
    pairs = list(_pairs(plan))
    for done, (subfolder, take) in enumerate(pairs, start=1):
        pair = take()
        for camera, image in pair.images.items():
            _write_jpeg(folder / subfolder / camera / f"{pair.name}.jpg", image)
        if progress is not None:
            progress(done, len(pairs))


def _pairs(plan: DatasetPlan) -> Iterator[tuple[str, Callable[[], FramePair]]]:
    """Subfolder of every pair, and the function that takes its photographs."""
    for subfolder, poses in _board_poses(plan).items():
        for i, pose in enumerate(poses):
            yield subfolder, partial(render_board_pair, plan.rig, plan.board, pose, plan.scene, f"{i:03d}")
    for frame, phantom in plan.phantoms.items():
        yield "", partial(render_pair, plan.rig, phantom, plan.tube, plan.scene, frame)
    if plan.scene.clutter:
        first = next(iter(plan.phantoms.values()))
        yield "background", partial(render_background, plan.rig, first, plan.scene)


def _board_poses(plan: DatasetPlan) -> dict[str, list[Pose]]:
    """Poses ``base_from_board`` by subfolder, the same at every call."""
    if not plan.board_views:
        return {}
    rng = np.random.default_rng(plan.board_seed)
    poses = board_views(plan.rig, plan.board, plan.board_views + _REGISTRATION_VIEWS, rng)
    return {"calibration": poses[: plan.board_views], "registration": poses[plan.board_views :]}


def _write_files(folder: Path, plan: DatasetPlan) -> None:
    save_rig(folder / "rig_true.yaml", plan.rig)
    _write_yaml(folder / "tube.yaml", _tube_file(plan.tube))
    frames = [{"frame": name, **truth(phantom)} for name, phantom in plan.phantoms.items()]
    write_json(folder / "truth.json", {"units": "mm, deg", "frames": frames})
    poses = _board_poses(plan)
    if poses:
        _write_yaml(folder / "board.yaml", _board_file(plan.board))
        views = [
            {"image": f"{i:03d}.jpg", "base_from_board": pose.matrix.tolist()}
            for i, pose in enumerate(poses["registration"])
        ]
        _write_yaml(folder / "registration.yaml", {"units": "mm", "views": views})


def _tube_file(tube: Tube) -> dict[str, Any]:
    tip: dict[str, Any] = {"shape": tube.tip.shape}
    if tube.tip.diameter_mm is not None:
        tip["diameter_mm"] = tube.tip.diameter_mm
    return {"diameter_mm": tube.diameter_mm, "tip": tip, "clamped": tube.clamped}


def _board_file(board: Board) -> dict[str, Any]:
    entries: dict[str, Any] = {"type": board.type, "squares": list(board.squares), "square_mm": board.square_mm}
    if board.type == "charuco":
        entries |= {"marker_mm": board.marker_mm, "dictionary": board.dictionary}
    return entries


def _write_yaml(path: Path, data: Mapping[str, Any]) -> None:
    write_atomic(path, yaml.safe_dump(dict(data), sort_keys=False, default_flow_style=None))


def _write_jpeg(path: Path, image: Image) -> None:
    _, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
    write_atomic(path, data.tobytes())


def mockup_phantoms(length_mm: float = 160.0) -> dict[str, Phantom]:
    """Shapes of a session with a mock-up: two arcs, an elliptic arc, a long bend, a straight tube, an S."""
    half = length_mm / 2
    return {
        "arc_30": Arc(np.radians(30), np.radians(30), length_mm),
        "arc_50": Arc(np.radians(50), np.radians(120), length_mm),
        "arc_75": Arc(np.radians(75), np.radians(215), length_mm),
        "ellipse_40": EllipseArc(np.radians(40), 2.0, np.radians(300), length_mm),
        "straight": straight(length_mm),
        "s_shape": Pieces((Arc(np.radians(45), np.radians(40), half), Arc(np.radians(40), np.radians(200), half))),
    }
