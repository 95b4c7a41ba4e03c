"""What the methods are compared on: rendered tubes, staged as each method needs, or photographs with their truth."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

import numpy as np

from tubesight.apps.reproduce.experiment1 import BENDING_DEG, ORIENTATIONS_DEG
from tubesight.apps.reproduce.mockup import ELLIPSE_DEG, ELLIPSE_RATIO, TUBE, phantom_of, photograph
from tubesight.core import FramePair, Image, InputError, Tube
from tubesight.files.rig import load_rig
from tubesight.files.truth import TrueShape, load_truth
from tubesight.files.tube import load_tube
from tubesight.geometry.rig import Rig
from tubesight.simulate import Phantom, Scene, rig_around, stage, truth
from tubesight.sources.folder import FolderSource, read_backgrounds

# Pictures of the mock-up: those of webcams, a quarter of their pixels where minutes count; and the widths over which
# errors and times are followed, all of 16 to 9.
SIZE_PX, QUICK_SIZE_PX = (1920, 1080), (960, 540)
WIDTHS_PX, QUICK_WIDTHS_PX = (480, 960, 1440, 1920, 2560), (640, 960, 1280)
# Every so many-th orientation of the experiment, and pairs of a folder, where minutes count.
_QUICK_EVERY, _QUICK_FRAMES = 4, 4
# Tubes by which resolutions are compared: weakly, strongly and not circularly bent, at orientations unlike each other.
_RESOLUTION_TUBES = ((30.0, 60.0, 1.0), (70.0, 210.0, 1.0), (ELLIPSE_DEG, 330.0, ELLIPSE_RATIO))
# Names of the rig in a folder: the true one where there is a truth.
_RIGS = ("rig_true.yaml", "rig.yaml")


@dataclass(frozen=True, slots=True, eq=False)
class Shot:
    """Pictures of one tube with what took them, and pictures of the scene without it."""

    rig: Rig
    pair: FramePair
    backgrounds: Mapping[str, Image] = field(default_factory=dict)


class Case(Protocol):
    """A tube of known shape that can be photographed."""

    @property
    def name(self) -> str:
        """Of the rows."""
        ...

    @property
    def tube(self) -> Tube:
        """What the user knows of it."""
        ...

    @property
    def true(self) -> TrueShape:
        """Its shape."""
        ...

    def shot(self, variant: str) -> Shot:
        """Photograph it as a method needs (`tubesight.methods.Method.scene`)."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class Rendered:
    """A rendered tube of the paper's experiment.

    Attributes
    ----------
    rig
        The two cameras of the plain scene.
    seed
        Of the pictures' noise.
    """

    name: str
    phantom: Phantom
    rig: Rig
    seed: int
    tube: Tube = TUBE

    @property
    def true(self) -> TrueShape:
        """Its shape."""
        known = truth(self.phantom)
        return TrueShape(
            known["kind"],
            np.array(known["tip"]),
            known["length"],
            known["theta"],
            known["phi"],
            np.array(known["centreline"]),
        )

    def shot(self, variant: str) -> Shot:
        """Render it with what a method needs to see."""
        staged = stage(variant, self.rig, self.phantom, Scene(seed=self.seed))
        return Shot(staged.rig, photograph(staged.rig, self.phantom, staged.scene, self.name))


@dataclass(frozen=True, slots=True, eq=False)
class Photographed:
    """A pair of a folder; every method gets the same pictures, whatever it needs."""

    name: str
    tube: Tube
    true: TrueShape
    source: FolderSource
    index: int
    backgrounds: Mapping[str, Image]

    def shot(self, variant: str) -> Shot:
        """Read the pictures."""
        return Shot(self.source.rig, self.source.read(self.index), self.backgrounds)


def experiment(quick: bool) -> list[Case]:
    """Experiment 1 of the paper, rendered: circular tubes of 10 to 70 degrees and an elliptic one, turned about z."""
    rig = rig_around(size_px=QUICK_SIZE_PX if quick else SIZE_PX)
    tubes = [(f"circular {bending}", float(bending), 1.0) for bending in BENDING_DEG]
    tubes.append((f"elliptic {ELLIPSE_DEG:.0f}", ELLIPSE_DEG, ELLIPSE_RATIO))
    turned = ORIENTATIONS_DEG[:: _QUICK_EVERY if quick else 1]
    return [
        Rendered(f"{name}, {phi} deg", phantom_of(bending, phi, ratio), rig, seed)
        for seed, (name, bending, phi, ratio) in enumerate((n, b, p, r) for n, b, r in tubes for p in turned)
    ]


def by_resolution(quick: bool) -> list[Case]:
    """Three of the tubes in pictures of several widths."""
    rigs = [rig_around(size_px=(width, width * 9 // 16)) for width in (QUICK_WIDTHS_PX if quick else WIDTHS_PX)]
    return [
        Rendered(f"bent {bending:.0f}, {phi:.0f} deg", phantom_of(bending, phi, ratio), rig, seed)
        for rig in rigs
        for seed, (bending, phi, ratio) in enumerate(_RESOLUTION_TUBES)
    ]


def of_folders(folders: Sequence[Path], quick: bool) -> list[Case]:
    """Pairs of data sets that have a truth, in the layout that `tubesight simulate` writes.

    Raises
    ------
    InputError
        If a folder lacks its truth, its rig or its tube, or no pair of it has a truth.
    """
    cases: list[Case] = []
    for folder in folders:
        found = _of_folder(folder)
        cases += found[:: -(-len(found) // _QUICK_FRAMES)] if quick else found
    return cases


def _of_folder(folder: Path) -> list[Case]:
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; name one that holds pictures with their truth.json")
    rig_path = next((folder / name for name in _RIGS if (folder / name).is_file()), folder / _RIGS[-1])
    for path in (rig_path, folder / "tube.yaml", folder / "truth.json"):
        if not path.is_file():
            raise InputError(f"{path}: missing; methods are compared on pictures with rig, tube.yaml and truth.json")
    rig, tube, known = load_rig(rig_path).rig, load_tube(folder / "tube.yaml"), load_truth(folder / "truth.json")
    lacking = [name for name in rig.names if name not in rig.camera_from_base]
    if lacking or len(rig.names) < 2 or not rig.registered:
        raise InputError(f"{rig_path}: two cameras with their poses in the base frame are needed; register the rig")
    source = FolderSource(folder, rig)
    empty = read_backgrounds(folder / "background", rig)
    cases = [
        Photographed(f"{folder.name}/{stem}", tube, known[stem], source, index, empty)
        for index, stem in enumerate(source.stems)
        if stem in known
    ]
    if not cases:
        raise InputError(f"{folder / 'truth.json'}: names none of the pictures; is it the truth of another folder?")
    return list(cases)
