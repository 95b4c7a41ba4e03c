"""Why a pair of pictures gave a shape, or did not, and what to do about it."""

from __future__ import annotations

from enum import StrEnum


class Status(StrEnum):
    """Outcome of one reconstruction: a short code with advice."""

    OK = "ok"
    TUBE_NOT_FOUND = "tube_not_found"
    BASE_HIDDEN = "base_hidden"
    TIP_AT_BORDER = "tip_at_border"
    TIP_NOT_FOUND = "tip_not_found"
    TOO_FEW_POINTS = "too_few_points"
    NOT_QUADRATIC = "not_quadratic"
    VIEWS_DISAGREE = "views_disagree"
    NEAR_DEGENERATE = "near_degenerate"
    RESIDUAL_TOO_LARGE = "residual_too_large"
    BAD_IMAGE = "bad_image"
    OTHER_DEVICE = "other_device"

    @property
    def advice(self) -> str:
        """One sentence: what happened and what to do next."""
        return _ADVICE[self]


_ADVICE = {
    Status.OK: "",
    Status.TUBE_NOT_FOUND: "the tube does not stand out where it should start; check the light, the registration, "
    "or give a background picture (--background)",
    Status.BASE_HIDDEN: "the base is outside the picture or covered; turn the camera so that it sees the clamp",
    Status.TIP_AT_BORDER: "the tube runs out of the picture before its tip; turn the camera so that it sees "
    "the whole tube",
    Status.TIP_NOT_FOUND: "the end of the tube does not look like the tip in tube.yaml; check tip shape and diameter, "
    "and that nothing covers it",
    Status.TOO_FEW_POINTS: "too little of the tube is visible; move the camera closer or clear what covers it",
    Status.NOT_QUADRATIC: "the shape is not an arc of a circle or an ellipse; "
    "this pipeline cannot describe it (several bends, or a view that followed something else)",
    Status.VIEWS_DISAGREE: "the views contradict each other; check that the pictures are of one instant "
    "and that no camera moved since the calibration",
    Status.NEAR_DEGENERATE: "the views do not fix the shape here; use a larger angle between the cameras",
    Status.RESIDUAL_TOO_LARGE: "the curve does not fit the pictures; check tube.yaml, the registration and the overlay",
    Status.BAD_IMAGE: "the picture cannot be used",
    Status.OTHER_DEVICE: "this does not follow from the tube measured before; clear what crosses or covers it, or "
    "begin anew if it was exchanged",
}


class Unmeasurable(Exception):
    """A stage could not do its work on these pictures; the sensor turns it into a status.

    Attributes
    ----------
    status
        The code.
    camera
        Name of the camera it happened in, or an empty string.
    detail
        What was seen, in a few words.
    """

    def __init__(self, status: Status, camera: str = "", detail: str = "") -> None:
        super().__init__(status, camera, detail)
        self.status = status
        self.camera = camera
        self.detail = detail

    def __str__(self) -> str:
        where = f"{self.camera}: " if self.camera else ""
        detail = f" ({self.detail})" if self.detail else ""
        return f"{where}{self.status.advice}{detail}"
