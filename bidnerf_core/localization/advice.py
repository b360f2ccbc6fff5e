"""What each outcome means and what to try first, worded as on the documentation's troubleshooting page."""

from __future__ import annotations

from dataclasses import dataclass

from bidnerf_core.localization.result import Outcome


@dataclass(frozen=True)
class Advice:
    """What an outcome means, and what to try first; code is between backticks."""

    meaning: str
    first: str


ADVICE = {
    Outcome.AMBIGUOUS: Advice(
        "Another pose explains the image about as well.",
        "Give several views with known relative poses, or a rough start (`--start`). If there is one such place, check whether the map holds it twice.",
    ),
    Outcome.OFF_SURFACE: Advice(
        "Fewer than 85% of the measured points lie on the map's surface.",
        "Check the unit and the kind of the depth first, then whether the map covers what the image shows.",
    ),
    Outcome.COLOUR_MISMATCH: Advice(
        "The shape fits, but fewer than 42% of the points have the colour of the surface.",
        "Check whether red and blue are swapped, then the exposure.",
    ),
    Outcome.FREE_SPACE_VIOLATED: Advice(
        "More than 15% of the lines of sight pass through the surface.",
        "Update the map if something was removed, else give more views or a start.",
    ),
    Outcome.RENDERING_MISMATCH: Advice(
        "The geometry fits, but the field renders something else.",
        "Check with `bidnerf render` whether the field is sharp, then whether the light has changed.",
    ),
    Outcome.UNDETERMINED: Advice("The image does not fix all six degrees of freedom.", "Add depth or views."),
    Outcome.NOT_SETTLED: Advice(
        "Newly drawn rays still ask for a step of more than 0.01.",
        "Localize again from the pose, or raise `--fine-steps` and `--fine-rays`.",
    ),
    Outcome.HIGH_LOSS: Advice(
        "A descent of `bid` or `inerf` ended where the rendering differs too much from the image.",
        "Use `auto`, a closer start, more `--max-steps` or several views.",
    ),
    Outcome.DIVERGED: Advice(
        "The loss or the pose is infinite or not a number.",
        "Check that the start is camera to world with OpenCV axes and lies within the scene, then lower `--learning-rate`.",
    ),
    Outcome.MISCALIBRATED: Advice(
        "The image contradicts the given intrinsics.",
        "Give the right camera (`--camera`), or mark the focal length as approximate.",
    ),
    Outcome.MIRRORED: Advice(
        "The mirror image fits the map better.",
        "Turn mirroring off in the front camera, check the image reader for flipped rows, or flip the image.",
    ),
    Outcome.IMPRECISE: Advice(
        "The position is too uncertain.", "Add depth of the same image, or views with known relative poses."
    ),
    Outcome.UNCERTAIN: Advice(
        "The diagnostics together make a wrong pose too likely.",
        "Take a sharper image, closer to where the map's images were taken.",
    ),
    Outcome.TOO_FEW_MATCHES: Advice(
        "The map has many landmarks, but hardly any appear in the image.",
        "If the image shows another place, try that place's map; else take a sharper, brighter one from nearer to where the map's images were taken, and check its camera.",
    ),
}
"""Advice for each outcome but ``CONVERGED``; a test compares it with the page."""
