"""Photos without poses: where they lie in a folder, and what finds their poses (entry points of ``bidnerf.posers``)."""

from __future__ import annotations

import contextlib
import os
import re
import warnings
from collections import defaultdict
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from bidnerf_core.camera import Camera, CameraSource
from bidnerf_core.datasets.capture import Capture, warn_about
from bidnerf_core.datasets.file_names import IMAGE_ENDINGS, is_auxiliary
from bidnerf_core.datasets.options import AS_STORED, DatasetOptions
from bidnerf_core.datasets.reader import find_reader
from bidnerf_core.datasets.video import is_video
from bidnerf_core.errors import InputError, InputWarning, amount, enumeration
from bidnerf_core.frames import natural_order, photos_in
from bidnerf_core.io import find_header, looks_like_image, open_binary
from bidnerf_core.registry import Plugins, interface_defects

POSE_NAMES = re.compile(
    r"(?<![a-z])(poses?|cams?|c2w|w2c|gt)(?![a-z])|pose_?graph|traj|ground_?truth|odom|extrinsic|sfm_data|bundle.*\.out"
    r"|^cameras(_\w+)?(\.(json|npz|npy|csv|xml|sfm|bin))?$|^images\.(txt|bin)$|transforms.*\.json|\.(nvm|sfm|g2o|tum)$",
    re.IGNORECASE,
)
"""The names of files and folders that usually hold poses, in whatever format."""
DERIVED = re.compile(
    r"(.+?)[_.-](depth|disp(arity)?|normals?|masks?|seg\w*|label\w*|conf\w*)([_.-]?(vis\w*|colou?r\w*))?", re.I
)
"""The stem of a picture computed from a photo, whose stem is the first group."""
MOST_FOLDERS = 2_000
"""Maximum number of folders that are searched for photos, which takes some seconds."""


@runtime_checkable
class PosedPhotos(Protocol):
    """The record that a poser returns."""

    @property
    def placed(self) -> int:
        """The number of photos with a pose."""
        ...


@runtime_checkable
class Poser(Protocol):
    """A function that finds the poses of photos without any, and writes them as a dataset."""

    def __call__(
        self,
        photos: str | Path,
        out: str | Path,
        camera: Camera | CameraSource | str | Path | None = None,
        overwrite: bool = False,
        *,
        reuse: bool = False,
    ) -> PosedPhotos:
        """Write a dataset of ``photos`` (a folder, or a video) and their poses into the folder ``out``.

        ``camera`` (intrinsics, a file of them, or a source of either) is kept fixed. ``overwrite`` is whether the folder may hold something
        else, ``reuse`` whether poses found earlier for the same photos are taken. Raises ``InputError`` if no poses can
        be found.
        """
        ...


POSERS: Plugins[Poser] = Plugins("posers", lambda poser: interface_defects(poser, (), {"__call__": ("photos", "out")}))
"""The posers by name."""


def lacks_poses(path: str | Path, options: DatasetOptions = AS_STORED) -> bool:
    """Return whether a path is a photo, a video, a folder of photos that no reader recognizes, or a recording without any pose."""
    below = Path(path)
    if find_reader(below) is not None:
        return unposed_recording(below, options) is not None
    if below.is_dir():
        return bool(photos_in(below)[0]) or any(_subfolders(below, None))
    return is_video(below) or looks_like_image(below)


def unposed_recording(path: Path, options: DatasetOptions = AS_STORED) -> Capture | None:
    """Return the frames of a recording in a known format if none of them has a pose; None for anything else."""
    if not getattr(find_reader(path), "may_lack_poses", False):
        return None
    with warnings.catch_warnings(), contextlib.suppress(InputError):  # both come again when the dataset is read
        warnings.simplefilter("ignore", InputWarning)
        capture = options.open_sequence(path)
        return None if any(shot.T_world_camera for shot in capture.shots) else capture
    return None


def photos_below(folder: Path, out: Path | None = None) -> list[Path]:
    """Return the photos of a folder in natural order of their names or, if it has none, those of its subfolders.

    Datasets and the folder ``out`` are left out and so are, with remarks, depth, masks and copies of other photos. Another
    remark names the files that usually hold poses, since nothing reads them.
    """
    unread = list(_pose_files(folder, out))
    if unread:
        warn_about(
            folder,
            f"{enumeration(unread, 3)}: usually poses, but in a format"
            " that is not read; new ones are searched for, in a unit and a world of their own. Convert the poses to"
            " transforms.json to use them",
        )
    photos = _without_copies(folder, photos_in(folder)[0] or list(_subfolders(folder, out)))
    return sorted(photos, key=lambda file: natural_order(file.relative_to(folder).as_posix()))


def _pose_files(folder: Path, out: Path | None) -> Iterator[str]:
    """Yield the files and folders that usually hold poses, and a sidecar file of RealityCapture, up to two folders below."""
    for below, inside, names in os.walk(folder):
        here = Path(below)
        if out is not None and here == out:
            inside.clear()
            continue
        others = [*inside, *(name for name in names if Path(name).suffix.lower() not in IMAGE_ENDINGS[1:])]
        poses = sorted(name for name in others if POSE_NAMES.search(name))
        for name in [name for name in names if name.lower().endswith(".xmp")][:1]:
            with contextlib.suppress(InputError), open_binary(here / name, "XMP") as file:
                poses += [name] if b"xcr:Position" in file.read(2**16) else []
        yield from (str((here / name).relative_to(folder)) for name in poses)
        inside[:] = [n for n in inside if n not in poses and not n.startswith(".") and here.parent != folder]


def _without_copies(folder: Path, photos: Sequence[Path]) -> list[Path]:
    """Return the photos without depth, pictures computed from a photo, the same photo in another format, and smaller copies.

    Remarks name what is left out. A folder holds smaller copies, as ``images_2`` beside ``images``, if a folder beside it
    has larger photos of the same names and aspect ratio.
    """
    left, whole = list(photos), {photo.with_suffix("") for photo in photos}

    def leave_out(copies: Sequence[Path], what: str) -> None:
        if copies and len(copies) < len(left):
            left[:] = [photo for photo in left if photo not in set(copies)]
            names = dict.fromkeys(str((c.parent if c.parent != folder else c).relative_to(folder)) for c in copies)
            warn_about(folder, f"{enumeration(list(names), 4)}: {what}, left out ({amount(len(copies), 'image')})")

    others = [photo for photo in left if photo.suffix.lower() not in (".jpg", ".jpeg")]
    deep = [photo for photo in others if (header := find_header(photo)) is not None and header.deep_grey]
    leave_out(deep, "grey images of 16 bits or more, such as depth")
    matches = [(photo, DERIVED.fullmatch(photo.stem)) for photo in left]
    leave_out(
        [photo for photo, match in matches if match and photo.with_name(match[1]) in whole], "computed from photos"
    )
    usual = (".jpg", ".jpeg", *IMAGE_ENDINGS)
    ranks = {photo: [*usual, photo.suffix.lower()].index(photo.suffix.lower()) for photo in left}
    chosen = {photo.with_suffix(""): photo for photo in sorted(left, key=lambda photo: -ranks[photo])}
    leave_out([p for p in left if chosen[p.with_suffix("")] != p], "the same photos in another format")
    groups, alike = defaultdict[Path, list[Path]](list), defaultdict[Any, list[tuple[int, int, Path]]](list)
    for photo in left:
        groups[photo.parent].append(photo)
    for below, group in groups.items():
        if (header := find_header(group[0])) is not None:
            alike[below.parent, frozenset(photo.stem for photo in group)].append((*header.size, below))
    smaller = {
        below
        for largest, sized in ((max(sized), sized) for sized in alike.values())
        for width, height, below in sized
        if width < largest[0] and abs(height - width * largest[1] / largest[0]) <= 1  # sizes are rounded
    }
    leave_out([photo for photo in left if photo.parent in smaller], "smaller copies of the photos beside them")
    return left


def _subfolders(folder: Path, out: Path | None) -> Iterator[Path]:
    """Yield the photos in subfolders of ``folder`` at any depth, except those of datasets and of auxiliary folders.

    Raises ``InputError`` for a folder such as that of all files of a user, which would be searched for minutes.
    """
    for number, (below, inside, _) in enumerate(os.walk(folder)):
        if number > MOST_FOLDERS:
            raise InputError(
                f"has more than {MOST_FOLDERS:,} subfolders", where=folder, expected="the folder of photos of one scene"
            )
        inside[:] = sorted(
            name
            for name in inside
            if not name.startswith(".")
            and not is_auxiliary(name)
            and not (out is not None and out.exists() and Path(below, name).samefile(out))
        )
        if Path(below) != folder:
            if find_reader(Path(below)) is not None:
                inside.clear()
                continue
            yield from photos_in(below)[0]
