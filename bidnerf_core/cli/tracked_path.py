"""The results of ``bidnerf track``: a row for each frame, the file of poses, and the summary at the end."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from rich.table import Table
from torch import Tensor

from bidnerf_core.captures.cameras import as_given
from bidnerf_core.cli.options import UsageError
from bidnerf_core.cli.output import say
from bidnerf_core.errors import InputError, amount
from bidnerf_core.evaluation.trials import plain_localization
from bidnerf_core.frames.frame import Frame
from bidnerf_core.geometry.se3 import SE3
from bidnerf_core.io.files import write_file
from bidnerf_core.localization import Localization
from bidnerf_core.mapping import SurfaceMap
from bidnerf_core.maps.description import MapInfo
from bidnerf_core.results.errors import normalized_error_squared, pose_error
from bidnerf_core.results.pose_files import POSE_WRITERS, PosedImage, write_poses
from bidnerf_core.results.trajectory import ErrorSummary, TrajectoryErrors, spans
from bidnerf_core.results.trajectory_plot import PlottedPath, plot_path

SAME_POSE = 1e-4
"""Difference of two poses' matrices (metres) that rounding in files may cause."""
BOUND = 12.59
"""The 95 % quantile of the chi-squared distribution with 6 degrees of freedom."""


@dataclass(frozen=True, eq=False)
class TrackedFrame:
    """A frame and the answer for it, without the image."""

    posed: PosedImage
    found: Localization
    truth: SE3 | None  # T_world_camera


class TrackedPath:
    """The frames tracked so far. Their images are not kept."""

    def __init__(self, map: MapInfo) -> None:
        self.frames: list[TrackedFrame] = []
        self.unread = 0  # frames whose files could not be read
        self._backend = map.backend
        self._trained_on = {camera.name: camera.pose for camera in as_given(map.cameras)}

    def add(
        self,
        frame: Frame,
        time: float | None,
        found: Localization,
        truth: SE3 | None = None,
        number: int | None = None,
    ) -> None:
        """Keep an answer. ``number`` is the frame's index in its sequence, by default one more than the last."""
        if number is None:
            number = self.frames[-1].posed.number + 1 if self.frames else 0
        intrinsics = found.frame_as_taken(frame).intrinsics
        posed = PosedImage(frame.name, number, intrinsics, found.T_world_camera, None, time, found.covariance)
        # Keeping the intermediate poses of each frame would take much memory in long sequences.
        self.frames.append(TrackedFrame(posed, replace(found, poses=found.poses[-1:]), truth))

    def plain(self, tracked: TrackedFrame) -> dict[str, Any]:
        """Return a frame's answer as JSON values: the keys of ``localize --json``, and ``time``."""
        error = None if tracked.truth is None else pose_error(tracked.posed.T_world_camera, tracked.truth)
        named = {"frame": tracked.posed.name, "time": tracked.posed.time}
        return named | plain_localization(tracked.found, self._backend, error)

    @property
    def accepted(self) -> list[TrackedFrame]:
        return [frame for frame in self.frames if frame.found.converged]

    @property
    def lost(self) -> list[tuple[int, int]]:
        """The first and the last index of each run of frames without an accepted pose."""
        return spans([not frame.found.converged for frame in self.frames])

    def write(self, out: Path) -> None:
        """Write the poses atomically, in the format of the name's ending.

        A ``.json`` file holds all frames with all details; files of other formats hold only accepted poses.
        """
        if _format(out) == ".json":
            rows = ",\n".join(json.dumps(self.plain(frame), allow_nan=False) for frame in self.frames)
            write_file(out, f"[\n{rows}\n]\n".encode())
            return
        write_poses(out, [frame.posed for frame in self.accepted])
        if left_out := len(self.frames) - len(self.accepted):
            say(
                f"{out}: {amount(len(self.accepted), 'pose')}; {left_out} without an accepted pose are left out"
            )

    def plot(self, file: Path, surface: SurfaceMap | None) -> None:
        """Draw the path. Raises ``InputError`` without matplotlib or without any frame."""
        if not self.frames:
            raise InputError(f"{file}: not drawn, since no frame was tracked")
        covariances = [frame.found.covariance for frame in self.frames]
        path = PlottedPath(
            SE3.stack([frame.posed.T_world_camera for frame in self.frames]),
            torch.tensor([frame.found.converged for frame in self.frames]),
            torch.tensor([_deviation(covariance) for covariance in covariances], dtype=torch.float64),
            [frame.truth for frame in self.frames],
        )
        plot_path(path, surface, file)

    @property
    def without_times(self) -> bool:
        """Whether no frame has a time stamp."""
        return all(frame.posed.time is None for frame in self.frames)

    def errors(self) -> TrajectoryErrors | None:
        """Return the errors of the accepted poses whose truth is known, or None if there are none."""
        known = [(f.posed.T_world_camera, f.truth) for f in self.accepted if f.truth is not None]
        if not known:
            return None
        return TrajectoryErrors.of(SE3.stack([found for found, _ in known]), SE3.stack([t for _, t in known]))

    def table(self, seconds: float) -> Table:
        """Return the summary of a run that took ``seconds``."""
        table = Table(show_header=False, box=None, pad_edge=False)
        total, lost = len(self.frames), self.lost
        table.add_row("frames", f"{total}, {total / max(seconds, 1e-9):.1f} per second")
        table.add_row("tracked", f"{len(self.accepted)} ({len(self.accepted) / max(1, total):.1%})")
        if self.unread:
            table.add_row("not read", amount(self.unread, "frame"))
        longest = max((last - first + 1 for first, last in lost), default=0)
        table.add_row(
            "lost",
            f"{amount(len(lost), 'time')}, at most for {amount(longest, 'frame')}" if lost else "never",
        )
        for name, text in self._error_rows():
            table.add_row(name, text)
        if seen := sum(map(self._is_of_training, self.frames)):
            table.add_row(
                "trained on",
                f"{amount(seen, 'frame')}; errors of frames that trained the map are no test",
            )
        return table

    def _is_of_training(self, frame: TrackedFrame) -> bool:
        """Return whether the map was trained on an image of this name with the same pose."""
        given = self._trained_on.get(frame.posed.name)
        if given is None or frame.truth is None:
            return False
        return torch.allclose(given.matrix(), frame.truth.matrix(), rtol=0, atol=SAME_POSE)

    def _error_rows(self) -> list[tuple[str, str]]:
        errors = self.errors()
        if errors is None:
            return []
        rows = [("raw error", _written(errors.raw))]
        if errors.ate is not None:
            rows.append(("ATE", f"{errors.ate:.4f} m (root mean square, rigidly aligned)"))
        if errors.rpe is not None:
            rows.append(("RPE per frame", _written(errors.rpe)))
        inside = [_inside(frame) for frame in self.accepted]
        known = [value for value in inside if value is not None]
        if known:
            rows.append(("inside 95 % bound", f"{sum(known) / len(known):.1%} (by the poses' covariances)"))
        return rows


def check_out(out: Path) -> None:
    """Raise, before any work is done, where a file of poses cannot be written."""
    if _format(out) is None:
        raise UsageError(f"--out is {out}, expected a name that ends with {', '.join(POSE_WRITERS)}")
    if out.is_dir() or not out.parent.is_dir():
        what = "is a folder" if out.is_dir() else f"no folder {out.parent}"
        raise InputError(f"{out}: {what}, expected a file in a folder that exists")


def _format(out: Path) -> str | None:
    return next((ending for ending in POSE_WRITERS if out.name.lower().endswith(ending)), None)


def _deviation(covariance: Tensor | None) -> float:
    return float("nan") if covariance is None else float(covariance.diagonal()[:3].sum().clamp(min=0).sqrt())


def _inside(frame: TrackedFrame) -> bool | None:
    if frame.truth is None or frame.found.covariance is None:
        return None
    squared = normalized_error_squared(frame.posed.T_world_camera, frame.truth, frame.found.covariance)
    return bool(squared <= BOUND)


def _written(summary: ErrorSummary) -> str:
    return (
        f"median {summary.translation_median:.4f} m, {summary.rotation_deg_median:.3f} deg;"
        f" 95 % within {summary.translation_p95:.4f} m, {summary.rotation_deg_p95:.3f} deg"
    )
