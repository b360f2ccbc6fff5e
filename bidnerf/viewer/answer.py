"""JSON values with which the page shows a localization: pictures, steps, matches, ellipsoid, figures and explanations."""

from __future__ import annotations

import contextlib
import math
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf.results import pose_error
from bidnerf.viewer.evidence import (
    APART,
    HERE,
    TURNED_DEG,
    acceptance_figures,
    contests,
    earlier,
    last_answer,
    probable_poses,
)
from bidnerf.viewer.pictures import Json, drawing, packed, photograph, quick_image
from bidnerf.viewer.scene import frustum, rows_of
from bidnerf_core.camera import Intrinsics
from bidnerf_core.fields import RenderedImage, has_field, render_picture
from bidnerf_core.frames import Frame
from bidnerf_core.geometry import SE3, symbol
from bidnerf_core.io import reduced, resampled
from bidnerf_core.localization import (
    ADVICE,
    METHODS,
    MIRROR,
    LandmarkAnswer,
    Localization,
    SceneMap,
    SearchRecord,
    origin_of,
)
from bidnerf_core.mapping import project
from bidnerf_core.registry import PluginError

MOST_STEPS = 200
"""Maximum number of steps of a descent that are shown; longer descents are subsampled at a regular stride."""


def no_answer(name: str, outcome: str, reason: str) -> Json:
    """Return the JSON values for an image that could not be localized, in the format of ``shown_answer``."""
    texts = dict.fromkeys(("meaning", "advice", "method", "method_summary", "camera"), "")
    unknown = (
        "loss",
        "confidence",
        "pose",
        "truth",
        "error",
        "shape",
        "ellipsoid",
        "observed",
        "rendered",
        "depth",
        "matches",
        "runner_up",
    )
    lists = dict[str, tuple[Any, ...]].fromkeys(("steps", "path", "figures", "contests"), ())
    found = {
        "name": name,
        "outcome": outcome,
        "accepted": False,
        "reason": reason,
        "seconds": 0.0,
        "unit": "units",
    }
    return texts | dict.fromkeys(unknown) | lists | found


def shown_answer(
    scene: SceneMap,
    name: str,
    found: Localization,
    frame: Frame | None = None,
    record: SearchRecord | None = None,
    truth: SE3 | None = None,
    quick: bool = False,
) -> Json:
    """Return the JSON values of a localization, with renderings if its ``frame`` is known.

    ``record`` is the record of the search, and ``truth`` the true T_world_camera. A ``quick`` answer renders the
    surface instead of the field. Poses are shown in the map's own coordinates, see ``Map.origin``.

    In the result, ``pose`` and ``truth`` are the 16 numbers of T_world_camera in row-major order, or None if not
    finite or not known. ``error`` holds the position error (in the map's unit) and the orientation error (degrees),
    and ``path`` the positions from the start to the pose found. ``camera`` describes the intrinsics that were used,
    ``meaning`` explains why a pose was rejected, and ``advice`` suggests what to try.
    """
    found = found.translated(-origin_of(scene))
    truth = None if truth is None else truth.translated(-origin_of(scene))
    T = found.T_world_camera.to("cpu", torch.float64)
    finite = bool(T.matrix().isfinite().all())
    observed, rendered, depth, camera = None, None, None, ""
    if frame is not None:
        camera = frame.camera_source or "intrinsics as given"
        if found.intrinsics is not None:
            camera = f"intrinsics taken or estimated by the localization, focal length times {found.focal_factor:.3f}"
        frame = found.frame_as_taken(frame)
        small = frame.intrinsics.at_most(320)  # pixels on the longer side, since rendering takes time
        observed = photograph(reduced(frame.rgb, small.width, small.height))
        if finite:
            rendered, depth = _compared(scene, small, T, frame, quick)
    error = None if truth is None or not finite else pose_error(T, truth, found.unit)
    advice = ADVICE.get(found.outcome)
    other = None if record is None or not finite else _runner_up(scene, found, record, frame, quick)
    answer, summary = last_answer(record), ""
    with contextlib.suppress(PluginError):  # the method may not be installed here
        summary = METHODS.load(found.method).summary
    places = found.poses.translation.detach().cpu().double()
    return {
        "name": name,
        "outcome": str(found.outcome),
        "accepted": found.converged and finite,
        "reason": found.reason,
        "meaning": "" if advice is None else advice.meaning,
        "advice": "" if advice is None else advice.first,
        "method": found.method,
        "method_summary": summary,
        "seconds": found.seconds,
        "loss": _finite(found.loss),
        "unit": symbol(found.unit),
        "confidence": _finite(found.confidence),
        "pose": rows_of(T) if finite else None,
        "truth": None if truth is None else rows_of(truth),
        "error": None if error is None else (float(error.translation), float(error.rotation_deg)),
        "shape": None if frame is None else frustum(frame.intrinsics),
        "camera": camera,
        "ellipsoid": ellipsoid(T, found.covariance) if finite else None,
        "observed": observed,
        "rendered": rendered,
        "depth": depth,
        "steps": _steps(found, record),
        "path": tuple((x, y, z) for x, y, z in places[places.isfinite().all(-1)].tolist()),
        "matches": None if frame is None or answer is None or not finite else _matches(scene, found, answer),
        "figures": acceptance_figures(found, record),
        "contests": contests(found, record),
        "runner_up": other,
    }


def ellipsoid(T_world_camera: SE3, covariance: Float[Tensor, "6 6"] | None) -> Json | None:
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


def depth_difference(image: RenderedImage, frame: Frame) -> Json | None:
    """Return the rendered minus the measured depth as a colour image, or None if no pixel has both.

    ``range`` is the difference at the ends of the colour scale, and ``median`` is the median absolute difference,
    both in the unit of the map.
    """
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
    # Pixels are red where the rendered depth is smaller than the measured one, nearly white where it is equal, and blue
    # where it is larger.
    near, middle, far = torch.tensor([(0.70, 0.09, 0.17), (0.97, 0.97, 0.96), (0.13, 0.40, 0.67)])
    towards = torch.where((share > 0)[..., None], far, near)
    rgb = middle + share.abs()[..., None] * (towards - middle)
    pixels = torch.cat([rgb, known[..., None].float()], dim=-1)
    picture = drawing((pixels * 255 + 0.5).to(torch.uint8).numpy())
    return {"picture": picture, "range": most, "median": float(off.abs().median())}


def _compared(scene: SceneMap, camera: Intrinsics, T: SE3, frame: Frame, quick: bool) -> tuple[Json, Json | None]:
    if quick or not has_field(scene.field):
        return photograph(quick_image(scene, camera, T)), None
    image = render_picture(scene.field, camera, T, scene.bounds)
    return photograph(image.rgb), depth_difference(image, frame)


def _steps(found: Localization, record: SearchRecord | None) -> tuple[Json, ...]:
    """Return the steps of the search (or else of the descent), then the pose together with its rivals, then the pose found."""
    last = found.T_world_camera.to("cpu", torch.float64)
    shown = [] if record is None else [_step(s.caption, s.T, s.scores.tolist(), s.kept) for s in record.steps]
    if not shown:  # no search: the steps of the descent, evenly spread
        count = min(len(found.losses), len(found.poses.translation) - 1)
        for number in range(0, count, max(1, math.ceil(count / MOST_STEPS))):
            T, loss = found.poses[number : number + 1], float(found.losses[number])
            if bool(T.matrix().isfinite().all()):
                shown.append(_step(f"step {number} of {count}", T, [loss], 1, loss))
    if not bool(last.matrix().isfinite().all()):
        return tuple(shown)
    answer = last_answer(record)
    if answer is not None and len(answer.modes) > 1:  # the pose and its rivals
        _, poses, probabilities = zip(*probable_poses(answer), strict=True)
        scores = (-torch.tensor(probabilities, dtype=torch.float64).log()).tolist()
        caption = "the pose and others that explain the image"
        shown.append(_step(caption, SE3.stack(list(poses)), scores, len(poses)))
    return (*shown, _step(HERE, last[None], [0.0], 1, shown[-1]["loss"] if shown else None))


def _step(caption: str, T: SE3, scores: list[float], kept: int, loss: float | None = None) -> Json:
    """Return one step: the poses that were considered together, the best first, their scores, and the ``loss`` of a descent."""
    poses = packed(T.matrix()[:, :3].detach().cpu().double().flatten(1).numpy())
    known = tuple(map(_finite, scores))
    return {"caption": caption, "poses": poses, "scores": known, "kept": kept, "loss": _finite(loss)}


def _finite(value: float | None) -> float | None:
    return value if value is not None and math.isfinite(value) else None


def _matches(scene: SceneMap, found: Localization, answer: LandmarkAnswer) -> Json | None:
    """Return the last image's matches at the last pose from landmarks: matches by projection, then further ones by descriptor.

    ``keypoints`` and the ``projections`` of their landmarks (NaN behind the camera) are fractions of the image size,
    float32 (m, 2), and ``accepted`` is uint8 (m), for at most 600 matches. ``agreeing`` and ``refused`` count all
    matches, and ``by_appearance`` the refused ones that were found by descriptor alone. ``pose`` describes the pose
    of the projections, and is empty if it is the pose found.
    """
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
    every = max(1, math.ceil(len(keypoint) / 600))  # at most 600 are drawn
    return {
        "keypoints": packed(shares[0][::every].numpy()),
        "projections": packed(shares[1][::every].numpy()),
        "accepted": packed(agree[::every].to(torch.uint8).numpy()),
        "agreeing": int(agree.sum()),
        "refused": int((~agree).sum()),
        "by_appearance": by_descriptors,
        "pose": earlier(found, answer),
    }


def _runner_up(
    scene: SceneMap, found: Localization, record: SearchRecord, frame: Frame | None, quick: bool
) -> Json | None:
    """Return a rival pose: an earlier one from landmarks, else the next most probable one, else the best other one searched."""
    answer = last_answer(record)
    if answer is not None:
        if given_up := earlier(found, answer):
            return _rendered(scene, answer.T_world_rig.to("cpu"), given_up, frame, quick)
        for mode, T, probability in probable_poses(answer):
            if mode != answer.posterior.mode and answer.modes[mode].name != MIRROR:
                shown = _rendered(scene, T, "the next most probable pose by landmarks", frame, quick)
                return shown | {"probability": probability}
    T = found.T_world_camera.to("cpu", torch.float64)
    x, y, z = scene.bounds.centre
    reach = APART * float((T.translation - torch.tensor([x, y, z], dtype=torch.float64)).norm())
    for step in reversed([step for step in record.steps if len(step.scores) > 1]):
        off = pose_error(step.T, T)
        different = (off.translation > reach) | (off.rotation_deg > TURNED_DEG)
        if bool(different.any()):
            place = int(different.nonzero()[0])
            return _rendered(scene, step.T[place], "the best different pose of the search", frame, quick)
    return None


def _rendered(scene: SceneMap, T: SE3, reason: str, frame: Frame | None, quick: bool) -> Json:
    """Return the JSON values of an alternative pose, without a probability, and with a rendering if ``frame`` is given."""
    picture = None
    if frame is not None:
        picture, _ = _compared(scene, frame.intrinsics.at_most(240), T, frame, quick)
    return {"reason": reason, "pose": rows_of(T), "rendered": picture, "probability": None}
