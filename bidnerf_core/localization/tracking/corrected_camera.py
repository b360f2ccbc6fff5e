"""Intrinsics that a search has corrected, for the frames that follow."""

from __future__ import annotations

import math
from dataclasses import astuple, dataclass, replace
from typing import Any

from bidnerf_core.camera.intrinsics import Intrinsics
from bidnerf_core.frames.frame import Frame
from bidnerf_core.localization.result import Localization


@dataclass(frozen=True)
class CorrectedCamera:
    """The intrinsics that a frame states, and the better ones that were found for it."""

    given: Intrinsics
    found: Intrinsics
    # Whether the frame's focal length was approximate; frames of the other kind are from another source.
    approximate: bool

    def applies_to(self, frame: Frame) -> bool:
        """Return whether the intrinsics of a frame come from the same source."""
        return frame.focal_is_approximate == self.approximate

    def focal_factor(self, frame: Frame) -> float:
        """Return the ratio of a frame's corrected to its given focal length: the geometric mean across and down."""
        if not self.applies_to(frame):
            return 1.0
        return math.sqrt(self.found.fx * self.found.fy / (self.given.fx * self.given.fy))

    def corrected(self, frame: Frame) -> Frame:
        """Return the frame with corrected intrinsics."""
        return replace(frame, intrinsics=self.changed(frame.intrinsics)) if self.applies_to(frame) else frame

    def stated_in(self, answer: Localization, frame: Frame) -> Localization:
        """Return the answer for a frame, completed by the intrinsics that replace the frame's own, if any do."""
        taken = self.corrected(frame).intrinsics
        corrected = None if taken == frame.intrinsics else taken
        return replace(answer, focal_factor=self.focal_factor(frame), intrinsics=corrected)

    def changed(self, camera: Intrinsics) -> Intrinsics:
        """Return corrected intrinsics; those of another focus or size are changed in the same proportion."""
        given, found = self.given, self.found
        if camera == given:
            return found
        x, y = camera.width / given.width, camera.height / given.height
        return replace(
            camera, fx=camera.fx * found.fx / given.fx, fy=camera.fy * found.fy / given.fy,
            cx=camera.cx + x * (found.cx - given.cx), cy=camera.cy + y * (found.cy - given.cy),
            distortion=found.distortion if camera.distortion == given.distortion else camera.distortion,
        )  # fmt: skip

    def then(self, later: CorrectedCamera) -> CorrectedCamera:
        """Return this correction followed by the correction ``later``."""
        return replace(self, found=later.changed(self.found))

    def plain(self) -> list[Any]:
        """Return the camera as JSON values."""
        return [list(astuple(self.given)), list(astuple(self.found)), self.approximate]

    @staticmethod
    def from_plain(values: list[Any]) -> CorrectedCamera:
        """Return the camera from JSON values as ``plain`` returns them."""
        given, found = (_camera(*camera) for camera in values[:2])
        return CorrectedCamera(given, found, values[2])


def _camera(
    fx: float, fy: float, cx: float, cy: float, width: int, height: int, distortion: list[float]
) -> Intrinsics:
    return Intrinsics(fx, fy, cx, cy, width, height, tuple(distortion))


def after_search(
    frame: Frame, found: Intrinsics, before: CorrectedCamera | None
) -> tuple[Frame, CorrectedCamera]:
    """Return a frame with the intrinsics that a search found for it, and the correction for later frames.

    ``before`` is the correction that was already applied to the frame, if any.
    """
    later = CorrectedCamera(frame.intrinsics, found, frame.focal_is_approximate)
    if before is not None and before.applies_to(frame):
        return later.corrected(frame), before.then(later)
    return later.corrected(frame), later
