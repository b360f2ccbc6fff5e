"""A localization as the page shows it: pictures, steps, matches, ellipsoid, figures and explanations."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.camera import Intrinsics
from bidnerf_core.fields import RenderedImage, has_field, render_picture
from bidnerf_core.frames import Frame
from bidnerf_core.geometry import SE3, symbol
from bidnerf_core.io import reduced, resampled
from bidnerf_core.localization import (
    ADVICE,
    METHODS,
    MIRROR,
    Answer,
    Localization,
    SceneMap,
    SearchRecord,
    origin_of,
)
from bidnerf_core.mapping import project
from bidnerf_core.registry import PluginError
from bidnerf_core.results import pose_error
from bidnerf_core.viewer.explanations import (
    APART,
    HERE,
    TURNED_DEG,
    Contest,
    contests,
    earlier,
    last_answer,
    probable_poses,
)
from bidnerf_core.viewer.figures import Figure, acceptance_figures
from bidnerf_core.viewer.packing import Packed, Picture, drawing, packed, photograph
from bidnerf_core.viewer.rendering import quick_image
from bidnerf_core.viewer.scene import CameraShape, rows_of

PICTURE_SIDE, RUNNER_UP_SIDE = 320, 240
"""Longer sides (pixels) of a photo and its rendering, and of the runner-up and its rendering; rendering takes time."""
MOST_MATCHES, MOST_STEPS = 600, 200
"""Maximum numbers of matches and of steps of a descent that are shown; more are subsampled at a regular stride."""
SIGMAS = 2.0
"""Semi-axes of the ellipsoid of the position, in standard deviations."""
TOO_NEAR, RIGHT, TOO_FAR = (0.70, 0.09, 0.17), (0.97, 0.97, 0.96), (0.13, 0.40, 0.67)
"""Colours for rendered depth that is smaller than, equal to and larger than the measured depth."""


@dataclass(frozen=True)
class Ellipsoid:
    """The ellipsoid of two standard deviations of the position, and the standard deviations of the orientation."""

    axes: tuple[float, ...]  # semi-axes in the world, 9 numbers: an axis a row, the longest first
    lengths: tuple[float, float, float]  # of the semi-axes
    rotation_deg: tuple[float, float, float]  # standard deviations about the camera's x, y and z axes


@dataclass(frozen=True)
class ShownStep:
    """Poses that were considered at the same time."""

    caption: str
    poses: Packed  # T_world_camera without the last row, float32 (h, 12), best first
    scores: tuple[float | None, ...]
    kept: int
    loss: float | None = None  # of a step of a descent


@dataclass(frozen=True)
class ShownMatches:
    """Keypoints and the projections of their matched landmarks, at the last pose that was estimated from landmarks."""

    keypoints: Packed  # float32 (m, 2), as fractions of the image's width and height
    projections: Packed  # the same; NaN behind the camera
    accepted: Packed  # uint8 (m)
    agreeing: int
    refused: int
    by_appearance: (
        int  # of these, matched by descriptors alone; the others were matched near their projections
    )
    pose: str  # which one it is, if not the pose found


@dataclass(frozen=True)
class DepthDifference:
    """The difference between rendered and measured depth, as a colour image."""

    picture: Picture
    range: float  # difference at the ends of the scale
    median: float  # of its absolute value


@dataclass(frozen=True)
class RunnerUp:
    """The best other pose."""

    reason: str
    pose: tuple[float, ...]  # T_world_camera, 16 numbers by rows
    rendered: Picture | None
    probability: float | None = None  # against the pose found alone; None if they were not compared


@dataclass(frozen=True)
class ShownAnswer:
    """A localization, or an image that could not be localized, as the page shows it."""

    name: str
    outcome: str
    accepted: bool
    reason: str
    meaning: str = ""  # of the outcome, if the pose was rejected
    advice: str = ""
    method: str = ""
    method_summary: str = ""
    seconds: float = 0.0
    loss: float | None = None
    unit: str = "units"
    confidence: float | None = None
    pose: tuple[float, ...] | None = None  # T_world_camera, 16 numbers by rows; None if it is not finite
    truth: tuple[float, ...] | None = None
    error: tuple[float, float] | None = None  # of the position, and of the orientation in degrees
    shape: CameraShape | None = None
    camera: str = ""  # whose intrinsics were taken
    ellipsoid: Ellipsoid | None = None
    observed: Picture | None = None
    rendered: Picture | None = None
    depth: DepthDifference | None = None
    steps: tuple[ShownStep, ...] = ()
    path: tuple[tuple[float, float, float], ...] = ()  # positions from the start to the pose found
    matches: ShownMatches | None = None
    figures: tuple[Figure, ...] = ()
    contests: tuple[Contest, ...] = ()
    runner_up: RunnerUp | None = None


def shown_answer(
    scene: SceneMap, name: str, found: Localization, frame: Frame | None = None, record: SearchRecord | None = None,
    truth: SE3 | None = None, quick: bool = False,
) -> ShownAnswer:  # fmt: skip
    """Return a localization as JSON values, with renderings if its ``frame`` is known.

    ``record`` is that of its search, ``truth`` the true T_world_camera. A ``quick`` answer has renderings of the surface.
    Poses are shown in the map's own coordinates, see ``Map.origin``.
    """
    found = found.translated(-origin_of(scene))
    truth = None if truth is None else truth.translated(-origin_of(scene))
    T = found.T_world_camera.to("cpu", torch.float64)
    finite = bool(T.matrix().isfinite().all())
    given, frame = frame, None if frame is None else found.frame_as_taken(frame)
    observed = rendered = depth = None
    if frame is not None:
        camera = frame.intrinsics.at_most(PICTURE_SIDE)
        observed = photograph(reduced(frame.rgb, camera.width, camera.height))
        if finite:
            rendered, depth = _compared(scene, camera, T, frame, quick)
    error = None if truth is None or not finite else pose_error(T, truth, found.unit)
    advice = ADVICE.get(found.outcome)
    other = None if record is None or not finite else _runner_up(scene, found, record, frame, quick)
    answer, summary = last_answer(record), ""
    with contextlib.suppress(PluginError):  # it is not installed here
        summary = METHODS.load(found.method).summary
    places = found.poses.translation.detach().cpu().double()
    return ShownAnswer(
        name=name,
        outcome=str(found.outcome),
        accepted=found.converged and finite,
        reason=found.reason,
        meaning="" if advice is None else advice.meaning,
        advice="" if advice is None else advice.first,
        method=found.method,
        method_summary=summary,
        seconds=found.seconds,
        loss=_finite(found.loss),
        unit=symbol(found.unit),
        confidence=_finite(found.confidence),
        pose=rows_of(T) if finite else None,
        truth=None if truth is None else rows_of(truth),
        error=None if error is None else (float(error.translation), float(error.rotation_deg)),
        shape=None if frame is None else CameraShape.of(frame.intrinsics),
        camera=_camera(given, found),
        ellipsoid=ellipsoid(T, found.covariance) if finite else None,
        observed=observed,
        rendered=rendered,
        depth=depth,
        steps=_steps(found, record),
        path=tuple((x, y, z) for x, y, z in places[places.isfinite().all(-1)].tolist()),
        matches=None if frame is None or answer is None or not finite else _matches(scene, found, answer),
        figures=acceptance_figures(found, record),
        contests=contests(found, record),
        runner_up=other,
    )


def ellipsoid(T_world_camera: SE3, covariance: Float[Tensor, "6 6"] | None) -> Ellipsoid | None:
    """Return the ellipsoid of a pose's position; None if its covariance is unknown or not finite."""
    if covariance is None or not bool(covariance.isfinite().all()):
        return None
    turn = T_world_camera.rotation.double().cpu()
    covariance = covariance.detach().cpu().double()
    variances, axes = torch.linalg.eigh(turn @ covariance[:3, :3] @ turn.mT)
    lengths = (SIGMAS * variances.clamp(min=0).sqrt()).flip(0)
    a, b, c = lengths.tolist()
    x, y, z = torch.rad2deg(covariance.diagonal()[3:].clamp(min=0).sqrt()).tolist()
    return Ellipsoid(tuple((axes.flip(1) * lengths).mT.flatten().tolist()), (a, b, c), (x, y, z))


def depth_difference(image: RenderedImage, frame: Frame) -> DepthDifference | None:
    """Return rendered minus measured depth at the pixels that have both; None if there are none."""
    if frame.depth is None or not frame.has_depth:
        return None
    height, width = image.depth.shape
    measured = resampled(frame.depth.cpu(), width, height)
    known = (measured > 0) & (image.depth > 0)
    if not bool(known.any()):
        return None
    off = (image.depth - measured)[known]
    most = max(float(off.abs().quantile(0.95)), 1e-9)
    share = torch.zeros_like(measured)
    share[known] = (off / most).clamp(-1, 1)
    near, middle, far = (torch.tensor(colour) for colour in (TOO_NEAR, RIGHT, TOO_FAR))
    towards = torch.where((share > 0)[..., None], far, near)
    rgb = middle + share.abs()[..., None] * (towards - middle)
    pixels = torch.cat([rgb, known[..., None].float()], dim=-1)
    return DepthDifference(
        drawing((pixels * 255 + 0.5).to(torch.uint8).numpy()), most, float(off.abs().median())
    )


def _compared(
    scene: SceneMap, camera: Intrinsics, T: SE3, frame: Frame, quick: bool
) -> tuple[Picture, DepthDifference | None]:
    if quick or not has_field(scene.field):
        return photograph(quick_image(scene, camera, T)), None
    image = render_picture(scene.field, camera, T, scene.bounds)
    return photograph(image.rgb), depth_difference(image, frame)


def _camera(frame: Frame | None, found: Localization) -> str:
    if frame is None:
        return ""
    if found.intrinsics is not None:
        return (
            f"intrinsics taken or estimated by the localization, focal length times {found.focal_factor:.3f}"
        )
    return frame.camera_source or "intrinsics as given"


def _steps(found: Localization, record: SearchRecord | None) -> tuple[ShownStep, ...]:
    """Return the steps of the search, or else of the descent, then the pose with each of its rivals, and the pose found."""
    shown, last = list[ShownStep](), found.T_world_camera.to("cpu", torch.float64)
    if record is not None:
        shown += [ShownStep(s.caption, _poses(s.T), _numbers(s.scores), s.kept) for s in record.steps]
    if not shown:
        shown += _descent(found)
    if not bool(last.matrix().isfinite().all()):
        return tuple(shown)
    answer = last_answer(record)
    if answer is not None and len(answer.modes) > 1:
        _, poses, probabilities = zip(*probable_poses(answer), strict=True)
        scores = -torch.tensor(probabilities, dtype=torch.float64).log()
        shown.append(
            ShownStep(
                "the pose and others that explain the image",
                _poses(SE3.stack(list(poses))),
                _numbers(scores),
                len(poses),
            )
        )
    return (*shown, ShownStep(HERE, _poses(last[None]), (0.0,), 1, shown[-1].loss if shown else None))


def _descent(found: Localization) -> Iterator[ShownStep]:
    """Yield the poses of a descent with their losses, but the last, which is the pose found."""
    count = min(len(found.losses), len(found.poses.translation) - 1)
    for number in range(0, count, max(1, math.ceil(count / MOST_STEPS))):
        T, loss = found.poses[number : number + 1], _finite(float(found.losses[number]))
        if bool(T.matrix().isfinite().all()):
            yield ShownStep(f"step {number} of {count}", _poses(T), (loss,), 1, loss)


def _poses(T: SE3) -> Packed:
    return packed(T.matrix()[:, :3].detach().cpu().double().flatten(1).numpy())


def _numbers(values: Float[Tensor, "h"]) -> tuple[float | None, ...]:
    return tuple(_finite(value) for value in values.tolist())


def _finite(value: float | None) -> float | None:
    return value if value is not None and math.isfinite(value) else None


def _matches(scene: SceneMap, found: Localization, answer: Answer) -> ShownMatches | None:
    """Return the matches in the last image at the last pose by landmarks: those by projection, then others by descriptors."""
    if scene.landmarks is None:
        return None
    mode, best = answer.mode, answer.posterior.best
    query, matches, state = mode.query, mode.matches, answer.posterior.states[best : best + 1]
    agree = answer.landmarks.residuals(state)[0][0, : len(matches)] <= 9
    refused = mode.by_descriptors[~torch.isin(mode.by_descriptors.keypoint, matches.keypoint)]
    keypoint = torch.cat([matches.keypoint, refused.keypoint])
    landmark = torch.cat([matches.landmark, refused.landmark])
    agree = torch.cat([agree, torch.zeros(len(refused), dtype=torch.bool)])
    is_last = query.view[keypoint] == len(query.images) - 1
    by_descriptors = int(is_last[len(matches) :].sum())
    keypoint, landmark, agree = keypoint[is_last], landmark[is_last], agree[is_last]
    seen = project(state, scene.landmarks.positions[landmark].double()[None], query.sights[keypoint])
    there = query.camera.project(torch.cat([seen.image[0], torch.ones(len(keypoint), 1)], dim=-1))
    there = torch.where(seen.front[0, :, None], there, torch.nan)
    size = torch.tensor([query.camera.width, query.camera.height], dtype=torch.float64)
    shares = [query.keypoints.pixels[keypoint] / size, there / size]
    if mode.name == MIRROR:  # drawn on the image as it is
        shares = [torch.stack([1 - share[:, 0], share[:, 1]], dim=-1) for share in shares]
    every = max(1, math.ceil(len(keypoint) / MOST_MATCHES))
    return ShownMatches(
        packed(shares[0][::every].numpy()),
        packed(shares[1][::every].numpy()),
        packed(agree[::every].to(torch.uint8).numpy()),
        int(agree.sum()),
        int((~agree).sum()),
        by_descriptors,
        earlier(found, answer),
    )


def _runner_up(
    scene: SceneMap, found: Localization, record: SearchRecord, frame: Frame | None, quick: bool
) -> RunnerUp | None:
    """Return the most probable other place, or else an earlier pose by landmarks, or the best different pose of the search."""
    answer = last_answer(record)
    if answer is not None:
        if given_up := earlier(found, answer):
            return _rendered(scene, answer.T_world_rig.to("cpu"), given_up, frame, quick)
        for mode, T, probability in probable_poses(answer):
            if mode != answer.posterior.mode and answer.modes[mode].name != MIRROR:
                shown = _rendered(scene, T, "the next most probable pose by landmarks", frame, quick)
                return replace(shown, probability=probability)
    T = found.T_world_camera.to("cpu", torch.float64)
    x, y, z = scene.bounds.centre
    reach = APART * float((T.translation - torch.tensor([x, y, z], dtype=torch.float64)).norm())
    for step in reversed([step for step in record.steps if step.compared]):
        off = pose_error(step.T, T)
        different = (off.translation > reach) | (off.rotation_deg > TURNED_DEG)
        if bool(different.any()):
            place = int(different.nonzero()[0])
            return _rendered(scene, step.T[place], "the best different pose of the search", frame, quick)
    return None


def _rendered(scene: SceneMap, T: SE3, reason: str, frame: Frame | None, quick: bool) -> RunnerUp:
    picture = None
    if frame is not None:
        camera = frame.intrinsics.at_most(RUNNER_UP_SIDE)
        picture, _ = _compared(scene, camera, T, frame, quick)
    return RunnerUp(reason, rows_of(T), picture)
