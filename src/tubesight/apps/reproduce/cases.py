"""What can be wrong in a session, one thing at a time, and what to do about it: cases of the study `sensitivity`."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from tubesight.apps.reproduce.disturbed import Look
from tubesight.apps.reproduce.session import Session


@dataclass(frozen=True, slots=True)
class Case:
    """One thing wrong.

    Attributes
    ----------
    cause, level
        What is wrong, and how much.
    look
        How the tube's photographs come about.
    diameter_error_mm
        What the stated diameter is too large.
    session
        How the rig is calibrated; with the true rig when None.
    quick
        Whether a quick run has it.
    """

    cause: str
    level: str
    look: Look = field(default_factory=Look)
    diameter_error_mm: float = 0.0
    session: Session | None = None
    quick: bool = False


ADVICE = {
    "nothing": "",
    "pairs of board pictures": "take 15 pairs or more, see `tubesight capture`",
    "where the board is": "carry the board through all of the tube's room",
    "board": "use a board that fills a third of the picture",
    "focus of board pictures": "focus on the tube's room and leave it",
    "registration": "two views of the board, or twenty points",
    "focus": "focus on the tube; depth of field by a small aperture",
    "noise": "more light rather than more gain",
    "exposure": "keep the tube below white: set exposure by hand",
    "resolution": "the camera's largest picture",
    "diameter": "measure it with a caliper",
    "clamp shift": "register in the clamp that holds the tube",
    "clamp tilt": "register by a straight rod in the clamp (`--straight`)",
    "cameras not at one instant": "trigger both cameras, or measure at rest",
    "motion blur": "a short exposure, more light",
    "rolling shutter": "global shutter, or measure at rest",
}
"""What to do, by cause."""


def cases(seed: int) -> list[Case]:
    """All cases, in the order of the table."""
    usual = Session(seed=seed)
    sessions = [
        ("pairs of board pictures", "6", replace(usual, views=6), True),
        ("pairs of board pictures", "10", replace(usual, views=10), False),
        ("pairs of board pictures", "20", usual, True),
        ("pairs of board pictures", "40", replace(usual, views=40), False),
        ("where the board is", "within 15 mm of the middle", replace(usual, spread_mm=15.0), True),
        ("board", "5 x 4 squares of 13 mm", replace(usual, squares=(5, 4)), False),
        ("board", "10 x 7 squares of 7 mm", replace(usual, square_mm=7.0), False),
        ("focus of board pictures", "blur of 3 px", replace(usual, blur_px=3.0), False),
        ("registration", "one view", replace(usual, registration_views=1), False),
        ("registration", "6 points clicked", replace(usual, points=6), False),
        ("registration", "20 points clicked", replace(usual, points=20), False),
    ]
    looks = [
        ("focus", "blur of 1.5 px", Look(blur_px=1.5), False),
        ("focus", "blur of 4 px", Look(blur_px=4.0), True),
        ("noise", "4 gray levels", Look(noise_levels=4.0), False),
        ("noise", "10 gray levels", Look(noise_levels=10.0), True),
        ("exposure", "a quarter of the light", Look(exposure=0.25), False),
        ("exposure", "twice the light", Look(exposure=2.0), True),
        ("exposure", "four times the light", Look(exposure=4.0), False),
        ("resolution", "3840 x 2160", Look(size_px=(3840, 2160)), False),
        ("resolution", "1280 x 720", Look(size_px=(1280, 720)), False),
        ("resolution", "640 x 360", Look(size_px=(640, 360)), True),
        ("clamp shift", "0.2 mm", Look(clamp_shift_mm=0.2), False),
        ("clamp shift", "1 mm", Look(clamp_shift_mm=1.0), True),
        ("clamp tilt", "0.2 deg", Look(clamp_tilt_deg=0.2), False),
        ("clamp tilt", "1 deg", Look(clamp_tilt_deg=1.0), True),
        ("cameras not at one instant", "1 mm of the tip's way", Look(tip_speed_mm_s=100.0, delay_s=0.01), True),
        ("cameras not at one instant", "3.3 mm of the tip's way", Look(tip_speed_mm_s=100.0, delay_s=0.033), False),
        ("motion blur", "1 mm of the tip's way", Look(tip_speed_mm_s=100.0, open_s=0.01), False),
        ("motion blur", "3.3 mm of the tip's way", Look(tip_speed_mm_s=100.0, open_s=0.033), False),
        ("rolling shutter", "2 mm of the tip's way", Look(tip_speed_mm_s=100.0, readout_s=0.02), False),
    ]
    listed = [Case("nothing", "", quick=True)]
    listed += [Case(cause, level, session=session, quick=quick) for cause, level, session, quick in sessions]
    listed += [Case(cause, level, look, quick=quick) for cause, level, look, quick in looks]
    for error in (-0.1, 0.1, 0.5):
        listed.append(Case("diameter", f"{error:+.1f} mm of 12", diameter_error_mm=error, quick=error == 0.5))
    return listed
