"""The answers for a run of images (photos or frames) in one map or several, and their output as JSON, pose files and tables."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from bidnerf.results.errors import (
    PoseError,
    TrajectoryErrors,
    pose_error,
    rotation_angle,
    spans,
    standard_deviations,
    within,
)
from bidnerf.results.plots import draw_path
from bidnerf.results.pose_files import LandmarkMatches, PosedImage, write_poses
from bidnerf.results.pose_formats import pose_format, refused_file
from bidnerf_core.camera import Intrinsics
from bidnerf_core.captures import UpDirection, given_cameras
from bidnerf_core.errors import InputError, amount
from bidnerf_core.frames import Frame
from bidnerf_core.geometry import SE3, LengthUnit, fit_similarity, symbol
from bidnerf_core.installation import import_extra
from bidnerf_core.io import write_file
from bidnerf_core.localization import Localization, SceneMap
from bidnerf_core.mapping import SurfaceMap
from bidnerf_core.maps import MapCollection, Placement, origin_of, unit_of
from bidnerf_core.progress import log

BAD_INPUT = "bad input"
"""Outcome of an image that could not be read."""


@dataclass(frozen=True, eq=False)
class Answer:
    """The localization of an image, and what is known about the image, which is not stored."""

    name: str
    number: int  # index in the run or sequence, from 0
    intrinsics: Intrinsics  # of the upright image; corrected if the localization corrected them
    localization: Localization
    truth: SE3 | None = None  # T_world_camera
    time: float | None = None  # seconds
    file: Path | None = None
    placement: Placement | None = None  # in one of several maps
    # Keypoints (pixels of the upright image) that agree with landmarks of the map, and the indices of these landmarks.
    matches: tuple[Float[Tensor, "m 2"], Int[Tensor, "m"]] | None = None

    def __repr__(self) -> str:
        """Return a one-line description."""
        return f"<Answer {self.name}: {self.localization!r}>"

    @staticmethod
    def of(frame: Frame, number: int, localization: Localization, **about: Any) -> Answer:
        """Build the answer for a frame; ``about`` holds further attributes of the answer.

        Only the final pose is stored: intermediate ones take up a lot of memory in long sequences.
        """
        return Answer(
            frame.name,
            number,
            localization.frame_as_taken(frame).intrinsics,
            replace(localization, poses=localization.poses[-1:], picture=None),
            **about,
        )

    @property
    def accepted(self) -> bool:
        """Whether the localization converged to a finite pose."""
        return self.localization.converged and self.localization.T_world_camera.is_finite

    @property
    def error(self) -> PoseError | None:
        """The error of the pose, or None if it or the true pose is unknown."""
        T = self.localization.T_world_camera
        return pose_error(T, self.truth, self.localization.unit) if self.truth is not None and T.is_finite else None


@dataclass(frozen=True)
class Failure:
    """An image that could not be read or localized."""

    name: str
    method: str
    reason: str


class Answers(list[Answer | Failure]):
    """The list of the answers for the images of a run: photos in one map or several, or the frames of a sequence.

    With several maps, each pose is in the frame of the map in which the image was localized.
    """

    def __init__(
        self, scene: SceneMap | MapCollection | None = None, is_sequence: bool = False, interval: float = 1.0
    ) -> None:
        """Create an empty collection for a map or maps. With ``is_sequence``, JSON answers include the time of each frame.

        Trajectories of images without times are written as if they were ``interval`` seconds apart.
        """
        super().__init__()
        self.scene, self.is_sequence, self.interval = scene, is_sequence, interval
        self.unread = 0  # frames of a sequence whose files could not be read

    @property
    def unit(self) -> LengthUnit:
        """The unit of the poses; "units" for several maps, whose units may differ."""
        scene = self.scene
        return "units" if scene is None or isinstance(scene, MapCollection) else unit_of(scene)

    def __repr__(self) -> str:
        """Return a one-line description."""
        return f"<Answers for {amount(len(self), 'image')}, {len(self.accepted)} accepted>"

    @property
    def names(self) -> list[str]:
        """The names of the images, in order."""
        return [answer.name for answer in self]

    def plain(self, answer: Answer | Failure) -> dict[str, Any]:
        """Return an answer as the JSON object printed by ``bidnerf localize --json``.

        Answers for a sequence also have the ``time`` of the frame, and answers in several maps the map and the
        runner-up. Numbers and matrices that are not finite become None. For an image that could not be read,
        the outcome is "bad input".
        """
        placement, values = getattr(answer, "placement", None), dict[str, Any](frame=answer.name)
        backend = getattr(placement or getattr(self.scene, "info", None), "backend", "")
        if self.is_sequence:
            values |= {"time": getattr(answer, "time", None)}
        if isinstance(answer, Answer):
            values |= plain_localization(answer.localization, backend, answer.error)
        else:
            values |= {
                "T_world_camera": None,
                "converged": False,
                "outcome": BAD_INPUT,
                "reason": answer.reason,
                "steps": 0,
                "seconds": 0.0,
                "covariance": None,
                "loss": None,
                "method": answer.method,
                "focal_factor": 1.0,
                "intrinsics": None,
                "confidence": None,
                "unit": self.unit,
                "backend": backend,
                "error": None,
            }
        if placement is not None:
            values |= placement.plain()
        elif isinstance(self.scene, MapCollection):
            values |= {"map": None, "similarity": None, "runner_up": None}
        return values

    @property
    def accepted(self) -> list[Answer]:
        """The answers that were accepted."""
        return [answer for answer in self.answers if answer.accepted]

    @property
    def answers(self) -> list[Answer]:
        """The answers, without the failures."""
        return [answer for answer in self if isinstance(answer, Answer)]

    @property
    def world_mismatch(self) -> str | None:
        """A remark if one similarity transform explains all pose errors, as for true poses in another world frame; else None."""
        poses = self._compared_poses
        if poses is None or len(poses[0].translation) < 4:  # a similarity fits nearly any three pairs of positions
            return None
        estimated, true = (T.translation.double() for T in poses)
        try:
            worlds = fit_similarity(true, estimated)
        except InputError:
            return None
        left, error = (torch.linalg.vector_norm(estimated - of, dim=-1) for of in (worlds.apply(true), true))
        if not bool(left.max() < 0.1 * error.median()):  # it must explain the errors of all poses
            return None
        T = worlds.T_target_source
        turn, shift = float(rotation_angle(T.rotation)), float(torch.linalg.vector_norm(T.translation))
        return (
            f"all {len(estimated)} accepted poses differ from the dataset's by one transformation (a rotation by"
            f" {math.degrees(turn):.3g}°, a scale of {worlds.scale:.4g} and a shift of {shift:.3g} {symbol(self.unit)}): the"
            " dataset's world is not that of the map"
        )

    def write(self, path: str | Path) -> None:
        """Write the poses atomically, in the format selected by the file extension, and replace an earlier file; the folder is created.

        A ``.json`` file lists all answers with all details. Files in other formats contain only the accepted poses; the other images are
        named with their outcomes in comments, where the format has them, and in a file beside it, see ``refused_file``. Raises
        ``UsageError`` for an unknown extension, and ``InputError`` for images that the format cannot describe.
        """
        path = Path(path)
        ending = pose_format(path)
        path.parent.mkdir(parents=True, exist_ok=True)
        if ending == ".json":
            rows = ",\n".join(json.dumps(self.plain(answer), allow_nan=False) for answer in self)
            write_file(path, f"[\n{rows}\n]\n".encode())
            return
        accepted, others = self.accepted, [each for each in self if not getattr(each, "accepted", False)]
        refused = ["{frame}: {outcome} ({reason})".format_map(self.plain(each)) for each in others]
        write_poses(path, [self._posed(answer) for answer in accepted], refused)
        if refused:
            poses, images = amount(len(accepted), "pose"), amount(len(refused), "image")
            log.info("%s: %s; %s without an accepted pose: see %s", path, poses, images, refused_file(path).name)

    def _posed(self, answer: Answer) -> PosedImage:
        """Return the image of an answer with its pose, for pose files."""
        found, landmarks, matches = answer.localization, getattr(self.scene, "landmarks", None), None
        if answer.matches is not None and landmarks is not None:
            pixels, landmark = answer.matches
            positions = landmarks.positions[landmark.to(landmarks.positions.device)].cpu().double()
            matches = LandmarkMatches(pixels, landmark, positions + origin_of(self.scene))
        return PosedImage(
            answer.name,
            answer.number,
            answer.intrinsics,
            found.T_world_camera,
            answer.file,
            answer.time,
            found.covariance,
            found.unit,
            matches=matches,
            interval=self.interval,
        )

    def to_pandas(self) -> Any:
        """Return the answers as a table (a pandas ``DataFrame``): a row for each image, in order.

        Its columns are those of ``plain`` that hold one value, the camera's position (``x``, ``y``, ``z``) and its unit quaternion
        (``qx`` ...), the standard deviations ``sigma_translation`` and ``sigma_rotation_deg``, and, where the truth is known, the
        errors ``error_translation`` and ``error_rotation_deg``. Raises ``InputError`` if pandas is not installed.
        """
        pandas = import_extra("pandas", "pandas", "a table of answers")
        rows = []
        for each in self:
            row = {k: v for k, v in self.plain(each).items() if not isinstance(v, list | dict)}
            rows.append(row)
            if isinstance(each, Failure):
                continue
            T, localization = each.localization.T_world_camera.to("cpu", torch.float64), each.localization
            numbers = *T.translation.tolist(), *T.quaternion("xyzw").tolist()
            row |= zip(("x", "y", "z", "qx", "qy", "qz", "qw"), numbers, strict=True)
            if localization.covariance is not None:
                position, rotation = standard_deviations(localization.covariance)
                row |= {"sigma_translation": position, "sigma_rotation_deg": math.degrees(rotation)}
            if (off := each.error) is not None:
                row |= {
                    "error_translation": float(off.translation),
                    "error_rotation_deg": float(off.rotation_deg),
                }
        return pandas.DataFrame(rows)

    @property
    def lost(self) -> list[tuple[int, int]]:
        """The first and the last index of each run of frames without an accepted pose."""
        return spans([not answer.accepted for answer in self.answers])

    def errors(self) -> TrajectoryErrors | None:
        """Return the errors of the accepted poses whose truth is known, or None if there are none."""
        known = self._compared_poses
        return None if known is None else TrajectoryErrors.of(*known, self.unit)

    @property
    def _compared_poses(self) -> tuple[SE3, SE3] | None:
        """The accepted poses whose true poses are known, and the true poses; None if there are none."""
        known = [(answer.localization.T_world_camera, answer.truth) for answer in self.accepted if answer.truth]
        if not known:
            return None
        return SE3.stack([estimated for estimated, _ in known]), SE3.stack([true for _, true in known])

    def plot(self, file: str | Path, surface: SurfaceMap | None = None, up: UpDirection | None = None) -> None:
        """Plot the trajectory over the surface of its map, as PNG or SVG by file extension.

        ``up`` is the up direction of the scene (``Map.up``), by default estimated from the surface and the
        cameras. Raises ``InputError`` without matplotlib or without any finite pose.
        """
        drawn, origin = (
            [answer for answer in self.answers if answer.localization.T_world_camera.is_finite],
            origin_of(self.scene),
        )
        if not drawn:
            raise InputError("not drawn, since no frame was tracked", where=file)
        covariances = [answer.localization.covariance for answer in drawn]
        deviations = [math.nan if c is None else standard_deviations(c)[0] for c in covariances]
        draw_path(
            SE3.stack([answer.localization.T_world_camera for answer in drawn]).translated(-origin),
            torch.tensor([answer.accepted for answer in drawn]),
            torch.tensor(deviations, dtype=torch.float64),
            [None if answer.truth is None else answer.truth.translated(-origin) for answer in drawn],
            Path(file),
            surface,
            up,
            self.unit,
        )

    def summary(self, seconds: float) -> list[tuple[str, str]]:
        """Return the rows of a summary table for a run that took ``seconds``: frames, losses, errors."""
        total, accepted, lost = len(self), len(self.accepted), self.lost
        longest = max((last - first + 1 for first, last in lost), default=0)
        losses = f"{amount(len(lost), 'time')}, at most for {amount(longest, 'frame')}" if lost else "never"
        inside = [
            bool(within(answer.localization.T_world_camera, answer.truth, answer.localization.covariance))
            for answer in self.accepted
            if answer.truth is not None and answer.localization.covariance is not None
        ]
        # Frames are training images of the map if their names and true poses are the same, up to rounding in files.
        info = getattr(self.scene, "info", None)
        cameras = () if info is None else given_cameras(info.cameras)
        given = {camera.name: camera.pose.translated(origin_of(self.scene)).matrix() for camera in cameras}
        seen = sum(
            answer.truth is not None
            and answer.name in given
            and torch.allclose(given[answer.name], answer.truth.matrix(), rtol=0, atol=1e-4)
            for answer in self.answers
        )
        unit, errors = symbol(self.unit), self.errors()
        ate, rpe = (None, None) if errors is None else (errors.ate, errors.rpe)
        rows = {
            "frames": f"{total}, {total / max(seconds, 1e-9):.1f} per second",
            "tracked": f"{accepted} ({accepted / max(1, total):.1%})",
            "not read": amount(self.unread, "frame") if self.unread else "",
            "lost": losses,
            "raw error": "" if errors is None else str(errors.raw),
            "ATE": "" if ate is None else f"{ate:.4f} {unit} (root mean square, rigidly aligned)",
            "RPE per frame": "" if rpe is None else str(rpe),
            "inside 95 % bound": f"{sum(inside) / len(inside):.1%} (by the poses' covariances)" if inside else "",
            "trained on": f"{amount(seen, 'frame')}; errors on training frames of the map are no test" if seen else "",
        }
        return [(name, text) for name, text in rows.items() if text]


def plain_localization(localization: Localization, backend: str, error: PoseError | None) -> dict[str, Any]:
    """Return the JSON values of a localization, the backend of its map, and its error if known."""
    return localization.plain() | {"backend": backend, "error": None if error is None else error.plain()}
