"""``tubesight init``: the files a session needs, with comments, to be filled in."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from tubesight.apps.board import DEFAULT_SQUARES, board_text
from tubesight.core import Board, InputError
from tubesight.files.safe import write_atomic

# What `tubesight board` prints on A4 where nothing else is asked for.
_BOARD = Board("chessboard", DEFAULT_SQUARES, 24.0)

_TUBE = """\
# What you know of the tube. Leave a line out where you do not know: the diameter is then estimated from the pictures.
diameter_mm: 12.0
tip:
  shape: ball        # ball, round (as wide as the tube), flat (a straight cut), or open: its end is not seen
  diameter_mm: 16.0  # of a ball only; leave it out for round and flat
clamped: true        # the tube leaves the origin of the base frame along +z; false where nothing holds it there
tapered: false       # true where its diameter changes along it; diameter_mm is then that at the base
"""

_REGISTRATION = """\
# Where the board was in the base frame while `registration/<camera>/` was photographed, one entry a pair of pictures.
# The base frame: origin where the tube leaves its clamp, z along the tube, x where orientation angles start.
# The first three numbers of each row belong to the directions of the board's x, y, z, the last is where its origin is:
#
#   - [x of board x, x of board y, x of board z, x of the origin in mm]
#   - [y ...                                                          ]
#   - [z ...                                                          ]
#
# The arrows on the printed board show its x and y and where its origin is; its z points into the sheet. Without a board
# in a known place: `tubesight register --help` tells of points and of a straight rod.
units: mm
views:
- image: 000.jpg     # the name of the picture in every camera's folder
  base_from_board:   # this board stands upright at y = 40: its x along the base's x, its y down the tube
  - [1.0, 0.0, 0.0, -96.0]
  - [0.0, 0.0, -1.0, 40.0]
  - [0.0, 1.0, 0.0, 10.0]
  - [0.0, 0.0, 0.0, 1.0]
"""

_RUN = """\
# The options of `tubesight run --config run.yaml`; options on the command line count more. Paths start at this file.
folder: photos            # one subfolder of pictures per camera
rig_path: rig.yaml        # from `tubesight calibrate` and `tubesight register`
tube_path: tube.yaml
out: results
overlay: true             # draw what was found on the photographs
# method: silhouette      # one of `tubesight methods`
# background_path: empty  # pictures without the tube, one subfolder per camera
# base_px: {left: [960, 52], right: [948, 60]}  # where the tube starts, if the rig does not tell
"""


def templates() -> Mapping[str, str]:
    """Text of each file by its name."""
    return {
        "tube.yaml": _TUBE,
        "board.yaml": board_text(_BOARD),
        "registration.yaml": _REGISTRATION,
        "run.yaml": _RUN,
    }


@dataclass(frozen=True, slots=True)
class Started:
    """What was written, and what was there before and is as it was."""

    written: tuple[Path, ...]
    kept: tuple[Path, ...]


def start_folder(folder: Path, force: bool = False) -> Started:
    """Write the files that a folder lacks, all of them with `force`.

    Raises
    ------
    InputError
        If the folder is a file or cannot be written.
    """
    if folder.exists() and not folder.is_dir():
        raise InputError(f"{folder}: this is a file; name a folder")
    written, kept = [], []
    for name, text in templates().items():
        path = folder / name
        if path.exists() and not force:
            kept.append(path)
        else:
            write_atomic(path, text)
            written.append(path)
    return Started(tuple(written), tuple(kept))
