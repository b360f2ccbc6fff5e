"""JSON values with which the page shows a localization: pictures, steps, matches, ellipsoid, figures and explanations."""

from __future__ import annotations

import contextlib
import math

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf.results import landmark_matches, pose_error
from bidnerf.viewer.evidence import HERE, acceptance_figures, contests, last_answer, name_earlier, probable_poses
from bidnerf.viewer.pictures import JsonObject, jpeg_json, pack, png_json, quick_image
from bidnerf.viewer.scene import frustum, matrix_rows
from bidnerf_core.fields import RenderedImage, has_field, render_picture
from bidnerf_core.frames import Frame
from bidnerf_core.geometry import SE3, symbol
from bidnerf_core.io import reduce_image, resample_nearest
from bidnerf_core.localization import (
    ADVICE,
    DISPLACEMENT,
    METHODS,
    LandmarkAnswer,
    Localization,
    SceneMap,
    SearchRecord,
    same_pose,
)
from bidnerf_core.mapping import project
from bidnerf_core.maps import origin_of
from bidnerf_core.registry import PluginError

OBSERVED = 320
"""Longer side (pixels) of the image and of its rendering in a page, since rendering takes time."""
MOST_STEPS = 200
"""Maximum number of steps of a descent that are shown; longer descents are subsampled at a regular stride."""


NO_ANSWER: JsonObject = {
    "name": "",
    "outcome": "",
    "accepted": False,
    "reason": "",
    "meaning": "",
    "advice": "",
    "method": "",
    "method_summary": "",
    "seconds": 0.0,
    "loss": None,
    "unit": "units",
    "confidence": None,
    "pose": None,
    "truth": None,
    "error": None,
    "shape": None,
    "camera": "",
    "ellipsoid": None,
    "observed": None,
    "rendered": None,
    "depth": None,
    "steps": (),
    "path": (),
    "matches": None,
    "figures": (),
    "contests": (),
    "runner_up": None,
}
"""All JSON values of an answer, see ``answer_json``, with their values for an image of which nothing is known."""


def no_answer(name: str, outcome: str, reason: str) -> JsonObject:
    """Return the JSON values for an image that could not be localized, in the format of ``answer_json``."""
    return NO_ANSWER | {"name": name, "outcome": outcome, "reason": reason}


def answer_json(
    scene: SceneMap,
    name: str,
    localization: Localization,
    frame: Frame | None = None,
    record: SearchRecord | None = None,
    truth: SE3 | None = None,
) -> JsonObject:
    """Return the JSON values of a localization, without the renderings that ``add_renderings`` adds.

    ``frame`` is the image that was localized, if it is known, ``record`` is the record of the search, and ``truth`` the
    true T_world_camera. Poses are shown in the map's own coordinates, see ``Map.origin``.

    In the result, ``pose`` and ``truth`` are the 16 numbers of T_world_camera in row-major order, or None if not
    finite or not known. ``error`` holds the position error (in the map's unit) and the orientation error (degrees),
    and ``path`` the positions from the start to the pose found. ``camera`` describes the intrinsics that were used,
    ``meaning`` explains why a pose was rejected, and ``advice`` suggests what to try.
    """
    origin, unit = -origin_of(scene), localization.unit
    localization = localization.translated(origin)
    T = localization.T_world_camera.to("cpu", torch.float64)
    positions = localization.poses.translation.detach().cpu().double()
    answer = NO_ANSWER | {
        "name": name,
        "outcome": str(localization.outcome),
        "accepted": localization.converged and T.is_finite,
        "reason": localization.reason,
        "method": localization.method,
        "seconds": localization.seconds,
        "loss": _finite(localization.loss),
        "unit": symbol(unit),
        "confidence": _finite(localization.confidence),
        "steps": _steps(localization, record),
        "path": tuple((x, y, z) for x, y, z in positions[positions.isfinite().all(-1)].tolist()),
        "figures": acceptance_figures(localization, record),
        "contests": contests(localization, record),
    }
    with contextlib.suppress(PluginError):  # the method may not be installed here
        answer["method_summary"] = METHODS.load(localization.method).summary
    if advice := ADVICE.get(localization.outcome):
        answer |= {"meaning": advice.meaning, "advice": advice.first}
    if truth is not None:
        truth = truth.translated(origin)
        answer["truth"] = matrix_rows(truth)
        if T.is_finite:
            error = pose_error(T, truth, unit)
            answer["error"] = float(error.translation), float(error.rotation_deg)
    if frame is not None:
        camera = frame.camera_source or "intrinsics as given"
        if localization.intrinsics is not None:
            camera = (
                f"intrinsics taken or estimated by the localization, focal length times {localization.focal_factor:.3f}"
            )
        frame = localization.frame_as_taken(frame)
        small = frame.intrinsics.at_most(OBSERVED)
        answer |= {
            "camera": camera,
            "shape": frustum(frame.intrinsics),
            "observed": jpeg_json(reduce_image(frame.rgb, small.width, small.height)),
        }
    if T.is_finite:
        answer |= {"pose": matrix_rows(T), "ellipsoid": ellipsoid(T, localization.covariance)}
        if record is not None:
            answer["runner_up"] = _runner_up(scene, localization, record)
            if frame is not None and record.answers:
                answer["matches"] = _matches(scene, localization, record.answers[-1])
    return answer


def add_renderings(
    answer: JsonObject, scene: SceneMap, localization: Localization, frame: Frame, quick: bool = False
) -> JsonObject:
    """Return the JSON values of a localization together with renderings from its pose and from that of the runner-up.

    ``frame`` is the image that was localized. ``quick`` renderings show the surface instead of the field.
    """
    frame = localization.frame_as_taken(frame)

    def render(pose: tuple[float, ...], most: int) -> tuple[JsonObject, JsonObject | None]:
        camera, rows = frame.intrinsics.at_most(most), torch.tensor(pose, dtype=torch.float64).reshape(4, 4)
        T = SE3(rows[:3, :3], rows[:3, 3])
        if quick or not has_field(scene.field):
            return jpeg_json(quick_image(scene, camera, T)), None
        image = render_picture(scene.field, camera, T, scene.bounds)
        return jpeg_json(image.rgb), depth_difference(image, frame)

    other = answer["runner_up"]
    if other is not None:
        answer = answer | {"runner_up": other | {"rendered": render(other["pose"], 240)[0]}}
    if answer["pose"] is None:
        return answer
    rendered, depth = render(answer["pose"], OBSERVED)
    return answer | {"rendered": rendered, "depth": depth}


def ellipsoid(T_world_camera: SE3, covariance: Float[Tensor, "6 6"] | None) -> JsonObject | None:
    """Return the two-sigma ellipsoid of a pose's position, or None if the covariance is unknown or not finite.

    ``covariance`` is that of a right update of the pose (translation, then rotation in radians). In the result,
    ``axes`` holds the semi-axes in the world as 9 numbers, one axis after the other, the longest first. ``lengths``
    holds the lengths of the semi-axes, and ``rotation_deg`` the standard deviations (degrees) of the orientation
    about the camera's x, y and z axes.
    """
    if covariance is None or not bool(covariance.isfinite().all()):
        return None
    turn, covariance = T_world_camera.rotation.double().cpu(), covariance.detach().cpu().double()
    variances, axes = torch.linalg.eigh(turn @ covariance[:3, :3] @ turn.mT)
    lengths = (2 * variances.clamp(min=0).sqrt()).flip(0)
    return {
        "axes": (axes.flip(1) * lengths).mT.flatten().tolist(),
        "lengths": lengths.tolist(),
        "rotation_deg": torch.rad2deg(covariance.diagonal()[3:].clamp(min=0).sqrt()).tolist(),
    }


def depth_difference(image: RenderedImage, frame: Frame) -> JsonObject | None:
    """Return the rendered minus the measured depth as a colour image, or None if no pixel has both.

    ``range`` is the difference at the ends of the colour scale, and ``median`` is the median absolute difference,
    both in the unit of the map.
    """
    if frame.depth is None or not frame.has_depth:
        return None
    measured = resample_nearest(frame.depth.cpu(), image.depth.shape[1], image.depth.shape[0])
    known = (measured > 0) & (image.depth > 0)
    if not bool(known.any()):
        return None
    difference = (image.depth - measured)[known]
    most = max(float(difference.abs().quantile(0.95)), 1e-9)
    share = torch.zeros_like(measured)
    share[known] = (difference / most).clamp(-1, 1)
    # Pixels are red where the rendered depth is smaller than the measured one, nearly white where it is equal, and blue
    # where it is larger.
    near, middle, far = torch.tensor([(0.70, 0.09, 0.17), (0.97, 0.97, 0.96), (0.13, 0.40, 0.67)])
    towards = torch.where((share > 0)[..., None], far, near)
    rgb = middle + share.abs()[..., None] * (towards - middle)
    pixels = torch.cat([rgb, known[..., None].float()], dim=-1)
    return {
        "picture": png_json((pixels * 255 + 0.5).to(torch.uint8).numpy()),
        "range": most,
        "median": float(difference.abs().median()),
    }


def _steps(localization: Localization, record: SearchRecord | None) -> tuple[JsonObject, ...]:
    """Return the steps of the search (or else of the descent), then the pose together with its rivals, then the pose found."""
    last = localization.T_world_camera.to("cpu", torch.float64)
    shown = [] if record is None else [_step(s.caption, s.T, s.scores.tolist(), s.passing) for s in record.steps]
    if not shown:  # no search: the steps of the descent, evenly spread
        count = min(len(localization.losses), len(localization.poses.translation) - 1)
        for number in range(0, count, max(1, math.ceil(count / MOST_STEPS))):
            T, loss = localization.poses[number : number + 1], float(localization.losses[number])
            if T.is_finite:
                shown.append(_step(f"step {number} of {count}", T, [loss], 1, loss))
    if not last.is_finite:
        return tuple(shown)
    answer = last_answer(record)
    if answer is not None and len(answer.modes) > 1:  # the pose and its rivals
        _, poses, probabilities = zip(*probable_poses(answer), strict=True)
        scores = (-torch.tensor(probabilities, dtype=torch.float64).log()).tolist()
        shown.append(_step("the pose and others that explain the image", SE3.stack(list(poses)), scores, len(poses)))
    return (*shown, _step(HERE, last[None], [0.0], 1, shown[-1]["loss"] if shown else None))


def _step(caption: str, T: SE3, scores: list[float], retained: int, loss: float | None = None) -> JsonObject:
    """Return one step: the poses that were considered together, the best first, their scores, how many were retained, and the ``loss`` of a descent."""
    return {
        "caption": caption,
        "poses": pack(T.matrix()[:, :3].detach().cpu().double().flatten(1).numpy()),
        "scores": tuple(map(_finite, scores)),
        "retained": retained,
        "loss": _finite(loss),
    }


def _finite(value: float | None) -> float | None:
    return value if value is not None and math.isfinite(value) else None


def _matches(scene: SceneMap, localization: Localization, answer: LandmarkAnswer) -> JsonObject | None:
    """Return the last image's matches at the last pose from landmarks: matches by projection, then further ones by descriptor.

    ``keypoints`` and the ``projections`` of their landmarks (NaN behind the camera) are fractions of the image size,
    float32 (m, 2), and ``accepted`` is uint8 (m), for at most 600 matches. ``agreeing`` and ``refused`` count all
    matches, and ``by_appearance`` the refused ones that were found by descriptor alone. ``pose`` describes the pose
    of the projections, and is empty if it is the pose found.
    """
    if scene.landmarks is None:
        return None
    mode, best = answer.mode, answer.posterior.best
    query, state = mode.query, answer.posterior.states[best : best + 1]
    keypoint, landmark, agree, by_descriptors = landmark_matches(answer)
    seen = project(state, scene.landmarks.positions[landmark].double()[None], query.sights[keypoint])
    there = query.camera.project(torch.cat([seen.image[0], torch.ones(len(keypoint), 1)], dim=-1))
    there = torch.where(seen.front[0, :, None], there, torch.nan)
    size = torch.tensor([query.camera.width, query.camera.height], dtype=torch.float64)
    shares = [query.keypoints.pixels[keypoint] / size, there / size]
    if mode.mirrored:  # drawn on the image as it is
        shares = [torch.stack([1 - share[:, 0], share[:, 1]], dim=-1) for share in shares]
    every = max(1, math.ceil(len(keypoint) / 600))  # at most 600 are drawn
    return {
        "keypoints": pack(shares[0][::every].numpy()),
        "projections": pack(shares[1][::every].numpy()),
        "accepted": pack(agree[::every].to(torch.uint8).numpy()),
        "agreeing": int(agree.sum()),
        "refused": int((~agree).sum()),
        "by_appearance": by_descriptors,
        "pose": name_earlier(localization, answer),
    }


def _runner_up(scene: SceneMap, localization: Localization, record: SearchRecord) -> JsonObject | None:
    """Return a rival pose: an earlier one from landmarks, else the next most probable one, else the best other one searched."""
    if answer := last_answer(record):
        if given_up := name_earlier(localization, answer):
            return _other_pose(given_up, answer.T_world_rig.to("cpu"))
        for mode, T, probability in probable_poses(answer):
            if mode != answer.posterior.mode and not answer.modes[mode].mirrored:
                return _other_pose("the next most probable pose by landmarks", T, probability)
    T = localization.T_world_camera.to("cpu", torch.float64)
    middle = T.inverse().apply(torch.tensor(scene.bounds.centre, dtype=torch.float64))
    for step in reversed([step for step in record.steps if len(step.scores) > 1]):
        different = ~same_pose(T, step.T, middle, 2 * DISPLACEMENT)
        if bool(different.any()):
            return _other_pose("the best different pose of the search", step.T[int(different.nonzero()[0])])
    return None


def _other_pose(reason: str, T: SE3, probability: float | None = None) -> JsonObject:
    return {"reason": reason, "pose": matrix_rows(T), "rendered": None, "probability": probability}
