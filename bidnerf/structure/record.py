"""The record of poses found for photos, and the files of a pose folder."""

from __future__ import annotations

import contextlib
import hashlib
import json
import re
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bidnerf.structure.colmap import DETECTOR
from bidnerf.structure.gps import GeoFrame
from bidnerf_core.camera import Camera, CameraSource, Intrinsics
from bidnerf_core.errors import InputError, amount
from bidnerf_core.geometry import SE3
from bidnerf_core.io import from_plain, read_json, write_file

RECORD, TRANSFORMS, WORK, MODEL, FRAMES = "poses.json", "transforms.json", "work", "sparse/0", "images"
PART = "part-"
"""Beginning of the names of the folders with the models that are not joined with the largest; their numbers follow, from 2."""


@dataclass(frozen=True)
class LeftOut:
    """A photo without a pose."""

    photo: str  # its name, as the dataset would name the frame
    file: str  # relative to the pose folder
    reason: str


@dataclass(frozen=True)
class FoundPoses:
    """The record of poses found by structure from motion; the poses are in the dataset next to it.

    The length unit of the world depends on the first pair of photos unless it is ``metric``; z points up, as
    estimated from the cameras. ``str()`` gives a human-readable summary.
    """

    source: str  # name of the folder of photos, or of the video
    photos: int  # including those that cannot be read
    placed: int  # photos with a pose
    models: tuple[
        int, ...
    ]  # number of photos of each model, largest first; the others are datasets in part-2, part-3 and so on
    left_out: tuple[LeftOut, ...]
    points: int  # triangulated points of the largest model
    reprojection_error: float  # mean, in pixels of photos downscaled to at most 1600 pixels
    seconds: float  # of the run that finished
    inputs: str  # digest of the names, sizes and times of the files, and of the camera
    pycolmap: str  # its version
    video: bool = False  # whether the photos are frames of a video, which were written next to this record
    sure_pairs: int = 0  # pairs of registered photos with too many matches to show different places
    contradicting: int = 0  # of these, pairs whose matches contradict the poses
    metric: bool = False  # whether the unit is metres, by measured depth or GPS
    turned: int = 0  # registered photos with an EXIF orientation; their cameras are those of the images as stored
    geo_frame: GeoFrame | None = None  # where the world lies, by GPS

    @property
    def doubt(self) -> str | None:
        """Why the poses may be wrong as a whole, and a remedy; None if nothing indicates that they are.

        Repeated details also cause contradicting pairs, though rarely more than 0.5 %: one model with 1.2 % is folded (record
        ``photos_corridor``), but another with 2.5 % is correct.
        """
        if self.contradicting <= 0.005 * self.sure_pairs:
            return None
        return (
            f"{self.contradicting} of {self.sure_pairs} pairs of photos that share many keypoints"
            f" ({self.contradicting / self.sure_pairs:.1%}) contradict the poses found: they show repeated details, or places that"
            " look alike were taken for one. Check the cameras ('bidnerf info MAP --plot PNG'); if they are wrong, give poses from"
            " a phone app, or photos of a smaller part"
        )

    def __str__(self) -> str:
        parts, more = [part_folder(Path(), n).name for n in range(1, len(self.models))], len(self.left_out) - 5
        others = f", or make maps of the other models too ('bidnerf train POSES/{parts[0]}')" if parts else ""
        lines = (
            f"poses of {self.placed} of {amount(self.photos, 'photo')}; {amount(self.points, 'point')}, mean error"
            f" {self.reprojection_error:.2f} px{'; in metres, by the measured depth' if self.metric and not self.geo_frame else ''}",
            f"in metres, by the GPS of {amount(self.geo_frame.photos, 'photo')} (median distance {self.geo_frame.deviation:.1f} m): coordinates are"
            f" those of {self.geo_frame.crs} minus {', '.join(f'{part:.0f}' for part in self.geo_frame.origin)}"
            if self.geo_frame
            else "",
            f"the photos fall into {len(self.models)} models of {', '.join(map(str, self.models))} photos, of which a photo may"
            " be in several and which share too few points to be joined; the largest is the dataset here, the others are"
            f" datasets of their own in {', '.join(parts)}"
            if parts
            else "",
            f"{amount(self.turned, 'photo')} turned by EXIF: the dataset has the cameras of the images as stored, while"
            " a photo is localized upright"
            if self.turned
            else "",
            *(f"left out {left.photo}: {left.reason}" for left in self.left_out[:5]),
            f"left out {more} more, see {RECORD}" if more > 0 else "",
            f"most photos have no pose here: take more beside those left out, each to overlap the next by two thirds{others}"
            if 2 * self.placed < self.photos
            else "",
        )
        return "\n".join(filter(None, lines))


def digest(
    files: Sequence[Path], camera: Camera | CameraSource | str | Path | None, known: Mapping[str, SE3] | None = None
) -> str:
    """Return a digest of the photos, of the settings with which their poses are estimated, and of poses that are ``known``."""
    identities = [[str(file.resolve()), file.stat().st_size, file.stat().st_mtime_ns] for file in files]
    settings: list[Any] = [repr(camera) if isinstance(camera, Intrinsics) else str(camera), repr(DETECTOR)]
    if known:
        settings.append({name: T.matrix().tolist() for name, T in sorted(known.items())})
    return hashlib.blake2b(json.dumps([identities, settings]).encode(), digest_size=16).hexdigest()


def read_pose_record(folder: Path) -> FoundPoses | None:
    """Load the record in a pose folder, or None if there is none. Raises ``InputError`` for a damaged one."""
    if not (folder / RECORD).is_file() or not (folder / TRANSFORMS).is_file():
        return None
    return from_plain(FoundPoses, read_json(folder / RECORD, "the record of found poses"), str(folder / RECORD))


def interrupted_work(folder: Path) -> dict[str, Any]:
    """Return the state of interrupted work, which is empty if there is none.

    It has the digest ``inputs``, and whether they are a ``video``.
    """
    with contextlib.suppress(InputError):
        state = read_json(folder / WORK / "begun.json", "the state of interrupted work")
        return state if isinstance(state, dict) else {}
    return {}


def part_folder(folder: Path, number: int) -> Path:
    """Return the folder of a model, by its rank from 0: the largest has the pose folder itself, each other one a folder in it."""
    return folder / f"{PART}{number + 1}" if number else folder


def open_work(folder: Path, inputs: str, video: bool) -> Path:
    """Return the work folder, which is emptied unless the work in it has the same inputs.

    Raises ``InputError`` if the frames of a video would be written among other images.
    """
    work = folder / WORK
    if interrupted_work(folder).get("inputs") != inputs:
        remove_output(folder)
        if video and (folder / FRAMES).exists():
            raise InputError(
                "exists already, and the video's frames would be written into it; name another folder",
                where=folder / FRAMES,
            )
        work.mkdir(parents=True, exist_ok=True)
        write_file(work / "begun.json", json.dumps({"inputs": inputs, "video": video}).encode())
    return work


def is_output(file: Path) -> bool:
    """Return whether a file or folder in a pose folder was written by this module."""
    if file.name == FRAMES:
        return file.is_dir() and all(re.fullmatch(r"\d{6,}\.jpg", each.name) for each in file.iterdir())
    sparse = MODEL.partition("/")[0]
    if re.fullmatch(rf"{PART}\d+", file.name):
        return file.is_dir() and {each.name for each in file.iterdir()} <= {TRANSFORMS, sparse}
    return file.name in (RECORD, TRANSFORMS, WORK, sparse)


def remove_output(folder: Path) -> None:
    """Remove everything that this module wrote.

    Other files are kept, such as photos in a folder with the same name as the frames folder.
    """
    (folder / TRANSFORMS).unlink(missing_ok=True)  # first: without it, the record counts as incomplete
    record: Any = {}
    with contextlib.suppress(InputError):
        record = read_json(folder / RECORD, "the record of found poses")
    of_video = any(isinstance(part, dict) and part.get("video") is True for part in (record, interrupted_work(folder)))
    if of_video and (folder / FRAMES).is_dir() and is_output(folder / FRAMES):
        shutil.rmtree(folder / FRAMES)
    (folder / RECORD).unlink(missing_ok=True)
    shutil.rmtree(folder / WORK, ignore_errors=True)
    for part in (folder, *filter(is_output, folder.glob(f"{PART}*"))):
        (part / TRANSFORMS).unlink(missing_ok=True)
        for name in ("cameras", "frames", "images", "points3D", "rigs"):
            (part / MODEL / f"{name}.bin").unlink(missing_ok=True)
        for emptied in (part / MODEL, (part / MODEL).parent, *([part] if part != folder else [])):
            with contextlib.suppress(OSError):  # not empty, or not there
                emptied.rmdir()
