"""Captures: lists of images with their known metadata, read one at a time. Every reader returns a capture.

A ``Capture`` is a list of ``Shot``s. Choosing a split, adding masks and ordering by time are operations on that list, and none
of them opens an image. Photos without poses, the frames of a video and images in memory are captures too.
"""

from __future__ import annotations

import math
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol, TypeAlias, overload, runtime_checkable

import torch
from jaxtyping import Bool, Shaped
from torch import Tensor

from bidnerf_core.camera import (
    PANORAMA_FACES,
    Camera,
    CameraSource,
    Lens,
    PanoramaFace,
    Raster,
    same_aspect,
)
from bidnerf_core.datasets.frame_cameras import photo_camera
from bidnerf_core.depth import DepthCamera, DepthImage
from bidnerf_core.errors import InputError, InputWarning, amount, spelling_hint
from bidnerf_core.frames import (
    BLACK,
    Frame,
    MaskFile,
    MaskFolder,
    View,
    WhollyHidden,
    fit_depth,
    hides_everything,
    natural_order,
    pinhole_of,
    read_mask,
)
from bidnerf_core.geometry import SE3, LengthUnit
from bidnerf_core.io import ImageSource, is_file, read_compact_image, read_header, reduce_image

Colour: TypeAlias = tuple[float, float, float]

HOLD_OUT_EVERY = 8
SPLITS = ("train", "val", "test")
"""The usual splits, in their order."""


class BreaksOff(InputError):
    """Raised when a sequentially decoded recording ends early, so that none of the remaining frames can be read."""


@runtime_checkable
class Picture(Protocol):
    """An image that is not stored in a separate file, such as a frame of a video."""

    def pixels(self) -> Shaped[Tensor, "h w 3"]:
        """Decode the image. Raises ``InputError`` if it cannot be decoded."""
        ...


@dataclass(frozen=True)
class DepthFile:
    """The depth image of a shot: ``read`` returns depth in metres, to be registered from ``sensor`` (if given) to the image."""

    path: Path | str  # for messages; a ``Path`` is a file, and if it is missing, there is no depth
    read: Callable[[], DepthImage]
    sensor: DepthCamera | None = None


@dataclass(frozen=True, eq=False, kw_only=True)
class Shot:
    """An image and its metadata from the capture format; nothing is decoded until ``frame`` is called.

    Formats whose images are not stored in the usual way define a subclass that overrides ``frame``.
    """

    image: ImageSource | Picture | None = None
    camera: Camera | CameraSource = CameraSource()
    T_world_camera: SE3 | None = None  # float64, OpenCV axes
    time: float | None = None  # seconds, from an origin that depends on the recording
    depth: DepthFile | None = None  # planar z
    masks: tuple[MaskFile, ...] = ()
    border: int = 0  # width in pixels of the border of the stored image that shows nothing
    splits: tuple[str, ...] = ()  # empty if the shot is in no split, for instance without a pose
    name: str = ""  # unique in its capture, which assigns it
    stem: str = ""  # by default the image file's name without its suffix
    folders: tuple[str, ...] | None = None  # in front of the stem; by default, those of the image file
    usual_side: int | None = None
    """Longer side to which the format's images are downscaled unless the user gives another size."""
    tells_camera: bool = False
    """Whether its frames state where their camera is from, as photos do whose camera is looked for."""

    def __post_init__(self) -> None:
        file = self.file
        if not self.stem and file is not None:
            object.__setattr__(self, "stem", file.stem)
        if self.folders is None:
            object.__setattr__(self, "folders", () if file is None else file.parts[:-1])

    @property
    def file(self) -> Path | None:
        """The image file, if the image is stored in a separate file."""
        return self.image if isinstance(self.image, Path) else None

    @property
    def parts(self) -> tuple[str, ...]:
        """The folders of the image path, followed by its stem."""
        return *(self.folders or ()), self.stem

    def frame(self, background: Colour = BLACK, side: int | None = None) -> Frame:
        """Read the image, composited over ``background`` (rgb) if it has an alpha channel, and its depth.

        An image with more than ``side`` pixels along the longer side is downscaled to ``side``. The camera of a file is checked
        before any pixel is decoded. Registered depth may be of any size: each pixel gets the depth of the nearest measurement.
        Raises ``InputError`` for an unreadable file, and for a camera or registered depth of another aspect ratio.
        """
        assert self.image is not None  # otherwise, a subclass reads the image
        pixels = None
        if isinstance(self.image, ImageSource):
            raster = Raster(*read_header(self.image).size)
        else:
            pixels = self.image.pixels()
            raster = Raster(pixels.shape[1], pixels.shape[0])
        found = photo_camera(self.camera, self.image, self.stem).find(str(self.image), raster).at_most(side)
        camera, size = found.camera, (found.camera.width, found.camera.height)
        if isinstance(self.image, ImageSource):
            rgb, alpha = read_compact_image(self.image, background, None if size == raster.size else size)
        elif pixels is not None:
            rgb, alpha = pixels if size == raster.size else reduce_image(pixels, *size), None
        metres, hidden, step = None, None, None
        if self.depth is not None:
            measured, where = self.depth.read(), Path(self.depth.path)
            step = measured.unit
            metres = (
                fit_depth(measured, raster, size, f"{where}: depth")
                if self.depth.sensor is None
                else self.depth.sensor.register(measured.metres, pinhole_of(camera, where), where)
            )
        if self.border:
            width = max(1, round(self.border * size[0] / raster.width))
            hidden = torch.ones(rgb.shape[:2], dtype=torch.bool)
            hidden[width:-width, width:-width] = False
            hidden = None if bool(hidden.all()) else hidden
        about: dict[str, Any] = {"camera_source": found.description, "focal_is_approximate": found.approximate}
        about = {"depth_unit": step} | (about if self.tells_camera else {})
        return Frame.taken(self.name, camera, rgb, metres, alpha, hidden, **about)

    def read(self, background: Colour = BLACK, side: int | None = None) -> Frame:
        """Read the frame and apply its masks. Raises ``WhollyHidden`` if they hide every pixel."""
        found = self.frame(background, side)
        for mask in self.masks:
            found = found.with_hidden(_hidden(mask, found))
        return found

    def faces(self) -> list[Shot]:
        """Return the pinhole views of a panorama with a known pose; for any other shot, return the shot itself."""
        if not isinstance(self.camera, PanoramaFace) or self.T_world_camera is None:
            return [self]
        faces = list[Shot]()
        for face in PANORAMA_FACES:
            camera = replace(self.camera, face=face)
            turn = SE3(torch.from_numpy(camera.rotation).double(), torch.zeros(3, dtype=torch.float64))
            faces.append(
                replace(self, camera=camera, T_world_camera=self.T_world_camera @ turn, stem=f"{self.stem}_{face}")
            )
        return faces


def _hidden(mask: MaskFile, frame: Frame) -> Bool[Tensor, "h w"] | None:
    """Return the pixels of a frame that a mask hides. A mask of the stored image is undistorted or cropped like the image."""
    lens: Lens | None = frame.lens
    if isinstance(lens, PanoramaFace):
        lens = lens if same_aspect(read_header(mask.path).size, lens.stored_size) else None
    camera = frame.intrinsics if lens is None else lens
    size, orientation = (camera.width, camera.height), frame.orientation
    stored = orientation.upright_size(*size)  # exchanging the sides twice restores them
    hidden = read_mask(mask.path, Raster(*stored, orientation), size, mask.hides)
    if lens is None:
        return hidden
    return torch.from_numpy(lens.resample(hidden.byte().numpy(), nearest=True)) > 0


@dataclass(frozen=True, eq=False)
class TimedFrame:
    """A frame of a sequence with its timestamp and, if known, its ground-truth pose."""

    time: float | None  # seconds, from an origin that depends on the recording
    frame: Frame  # without colours (``has_colour``) if only depth was recorded at this time
    truth: SE3 | None = None  # T_world_camera, OpenCV axes, if the recording has it
    split: str | None = None  # the split of the dataset that holds the frame


@dataclass(frozen=True, eq=False)
class Capture:
    """Images with their known metadata. Poses are ``T_world_camera`` with OpenCV axes; depth is planar z in metres.

    A frame's name is the stem of its image file. If several files of a split share a stem, the names are prefixed
    with just enough folders to make them unique ("left_0001", "right_0001"); the bare stem is then rejected as
    ambiguous. Indexing and iteration read frames; slicing does not.
    """

    # Not a subclass of collections.abc.Sequence: run-time type checkers inspect an item of a Sequence, which would read a file.

    path: Path
    shots: Sequence[Shot]
    background: Colour = BLACK  # behind images with an alpha channel
    unit: LengthUnit | None = None  # of the poses; None if the format does not specify it
    up: Colour | None = None  # the upward direction in the world if the capture measured gravity, as phones do
    depth_unit: float | None = None  # metres per step of depth images, if the format accepts another unit
    largest: int | None = None  # longer side to which the user asked to downscale images, if any
    pose_file: Path | str | None = None  # what records the poses, for messages
    poses_expected: str = "at least one"  # what must exist for an image to have a pose
    unposed: str = ""  # why some images have no pose
    rate: float = math.inf  # most frames per second in the dataset, if recordings have more than a map needs

    def __post_init__(self) -> None:
        if not all(shot.name for shot in self.shots):
            object.__setattr__(self, "shots", _name_shots(self.shots))

    def __repr__(self) -> str:
        """A one-line description, for which no image is opened."""
        posed = sum(shot.T_world_camera is not None for shot in self.shots)
        splits = ", ".join(f"{name} {sum(name in shot.splits for shot in self.shots)}" for name in self.splits)
        return (
            f"<Capture {self.path}: {amount(len(self), 'image')}, {posed} with poses{f' ({splits})' if splits else ''}>"
        )

    @cached_property
    def splits(self) -> tuple[str, ...]:
        """The names of the splits; "train" comes first if it exists. Empty if no image has a pose."""
        found = dict.fromkeys(split for shot in self.shots for split in shot.splits)
        return tuple(sorted(found, key=lambda split: SPLITS.index(split) if split in SPLITS else len(SPLITS)))

    @property
    def names(self) -> list[str]:
        return [shot.name for shot in self.shots]

    def __len__(self) -> int:
        return len(self.shots)

    def __iter__(self) -> Iterator[TimedFrame]:
        return (self[index] for index in range(len(self)))

    @overload
    def __getitem__(self, index: int) -> TimedFrame: ...

    @overload
    def __getitem__(self, index: slice) -> Capture: ...

    def __getitem__(self, index: int | slice) -> TimedFrame | Capture:
        if isinstance(index, slice):
            return replace(self, shots=self.shots[index])
        shot = self.shots[index]
        return TimedFrame(shot.time, self._read(shot), shot.T_world_camera, next(iter(shot.splits), None))

    @cached_property
    def _by_split(self) -> dict[str, Capture]:
        return {}  # filled by ``split``, since naming the frames of a large split takes long

    def split(self, name: str) -> Capture:
        """Return the frames of a split; "all" has every frame that is in a split. Raises ``InputError`` for an unknown split."""
        if name not in self._by_split:
            every = name == "all" and name not in self.splits
            if not every and name not in self.splits:
                raise InputError(
                    f"no split {name!r}",
                    where=self.path,
                    expected=f"one of {', '.join(self.splits) or 'none, since only images with poses are in a split'}",
                )
            own = [shot for shot in self.shots if (shot.splits if every else name in shot.splits)]
            self._by_split[name] = replace(self, shots=_name_shots(own, one_split=not every))
        return self._by_split[name]

    def in_time_order(self) -> Capture:
        """Return all frames in chronological order, or, if any frame lacks a time, in natural name order and without times."""
        shots = sorted(self.shots, key=lambda shot: natural_order("/".join(shot.parts)))
        if any(shot.time is None for shot in shots):
            return replace(self, shots=[replace(shot, time=None) for shot in shots])
        return replace(self, shots=sorted(shots, key=lambda shot: shot.time or 0.0))

    def with_masks(self, folder: MaskFolder, by_stem: bool = False) -> Capture:
        """Return the frames with the masks in a folder applied; with ``by_stem``, masks are matched regardless of folders.

        Raises ``InputError`` if no frame has a mask with a matching name.
        """
        own = [[shot.name, *([shot.stem] if by_stem else [])] for shot in self.shots]
        for split in self.splits:  # masks may also be named like the frames of a split
            inside = [index for index, shot in enumerate(self.shots) if split in shot.splits]
            for index, name in zip(inside, self.frame_names(split), strict=True):
                own[index].append(name)
        folder.require_any(list(dict.fromkeys(name for names in own for name in names)))
        files = [next((file for name in names if (file := folder.file_of(name))), None) for names in own]
        return replace(
            self,
            shots=[
                shot if file is None else replace(shot, masks=(*shot.masks, MaskFile(file, folder.hides)))
                for shot, file in zip(self.shots, files, strict=True)
            ],
        )

    def at_most(self, largest: int | None) -> Capture:
        """Return the frames downscaled to ``largest`` pixels along the longer side, even if the format has another limit."""
        return replace(self, largest=largest)

    def frame_names(self, split: str) -> list[str]:
        """Return the frame names of a split, in order. Raises ``InputError`` for an unknown split."""
        return self.split(split).names

    def select(self, split: str, names: Sequence[str] | None = None) -> list[Shot]:
        """Return the frames ``names`` of a split, in that order, or the whole split. Raises ``InputError`` for an unknown split or name."""
        part, where = self.split(split), f"{self.path}: split {split!r}"
        chosen = list(part.shots)
        if names is None:
            return chosen
        if isinstance(names, str):  # its letters would be taken for names
            raise InputError(f"names is {names!r}", where=where, expected=f"a list, such as [{names!r}]")
        by_name = {shot.name: shot for shot in chosen}
        unknown = next((name for name in names if name not in by_name), None)
        if unknown is None:
            return [by_name[name] for name in names]
        other = next((each for each in self.splits if unknown in self.frame_names(each)), None)
        elsewhere = other and f"no frame {unknown!r}, which is in split {other!r}; choose that split"
        meant = [shot.name for shot in chosen if shot.stem == unknown]
        hint, expected = spelling_hint(unknown, by_name), f"one of {', '.join(meant[:4])}" if meant else None
        found = f"frame {unknown!r} is ambiguous" if meant else elsewhere
        if found is None:
            found = f"no frame {unknown!r} among its {len(chosen)} frames{hint}"
            expected = f"a name such as {chosen[0].name!r}" if chosen and not hint else None
        raise InputError(found, where=where, expected=expected)

    def views(
        self,
        split: str,
        names: Sequence[str] | None = None,
        limit: int | None = None,
    ) -> list[View]:
        """Read the frames ``names``, in that order, or the whole split; no other image is opened.

        When reading a whole split, frames that a mask hides entirely are left out. Images with more than ``limit``
        pixels along the longer side are downscaled to ``limit``, even if the user allows larger ones. Raises
        ``InputError`` for an unknown split or frame, and for a file that is missing or invalid.
        """
        shots, views = self.select(split, names), list[View]()
        for shot in shots:
            try:
                views.append(self.view(shot, limit))
            except WhollyHidden:
                if names is not None:
                    raise
        return views

    def hidden_frames(self, split: str) -> list[str]:
        """Return the frames of a split that are entirely hidden by a mask; only masks are read."""
        return [
            shot.name
            for shot in self.select(split)
            if any(hides_everything(mask.path, mask.hides) for mask in shot.masks)
        ]

    def require_poses(self) -> Capture:
        """Return the capture; a remark counts the frames without a pose. Raises ``InputError`` if no frame has a pose."""
        posed = sum(shot.T_world_camera is not None for shot in self.shots)
        where, images = self.pose_file or self.path, amount(len(self), "image")
        if not posed:
            raise InputError(f"has no pose for any of {images}", where=where, expected=self.poses_expected)
        if posed < len(self):
            warn_about(
                where,
                f"{len(self) - posed} of {images} have no pose and are left out"
                + (f": {self.unposed}" if self.unposed else ""),
            )
        return self

    def view(self, shot: Shot, limit: int | None = None) -> View:
        """Read a posed frame, downscaled to at most ``limit`` pixels along the longer side as in ``views``."""
        assert shot.T_world_camera is not None  # only frames with a pose are in splits
        return View(self._read(shot, limit), shot.T_world_camera)

    def _read(self, shot: Shot, limit: int | None = None) -> Frame:
        sides = self.largest or shot.usual_side, limit
        return shot.read(self.background, min((side for side in sides if side is not None), default=None))


def unique_names(paths: Sequence[tuple[str, ...]], separator: str = "_") -> list[str]:
    """Return a name for each path (folders, then stem): its stem, prefixed with just enough folders to make it unique.

    ``separator`` joins folders and stem. Names that still collide, such as those of a/b.png and a_b.png, get the suffixes
    "-2" and so on.
    """
    names = [path[-1] for path in paths]
    for depth in range(2, max(map(len, paths), default=0) + 1):
        count = Counter(names)
        names = [separator.join(p[-depth:]) if count[n] > 1 else n for n, p in zip(names, paths, strict=True)]
    used, seen = set(names), dict[str, None]()
    for name in names:
        own, number = name, 2
        while own in seen or (own != name and own in used):
            own, number = f"{name}-{number}", number + 1
        seen[own] = None
    return list(seen)


def _name_shots(shots: Sequence[Shot], one_split: bool = False) -> list[Shot]:
    """Return the shots with unique names; a name includes the split only where needed to make it unique."""
    mixed = not one_split and len({shot.splits[:1] for shot in shots}) > 1
    paths = [(*(shot.splits[:1] or ("",) if mixed else ()), *shot.parts) for shot in shots]
    return [replace(shot, name=name) for shot, name in zip(shots, unique_names(paths), strict=True)]


def hold_out(
    shots: Sequence[Shot], where: Callable[[Shot], bool] = lambda shot: True, rate: float = math.inf
) -> list[Shot]:
    """Assign the shots to splits: every eighth posed shot (the first, the ninth ...) is "test", the others are "train".

    A single posed shot is in both splits. Shots for which ``where`` is false are in no split. If all shots have times (in
    chronological order), those in excess of ``rate`` per second are in no split either; to allow for rounding, a
    time may be up to 5 ms early.
    """
    chosen, due = list[int](), -math.inf
    step = 0.0 if any(shot.time is None for shot in shots) else 1 / rate
    for number, shot in enumerate(shots):
        time = shot.time or 0.0
        if shot.T_world_camera is not None and where(shot) and (not step or time >= due):
            chosen.append(number)
            due = time + step - 0.005
    splits: dict[int, tuple[str, ...]] = dict.fromkeys(chosen, ("train",))
    splits |= dict.fromkeys(chosen[::HOLD_OUT_EVERY], ("test",))
    if len(chosen) == 1:
        splits[chosen[0]] = "train", "test"
    return [replace(shot, splits=splits.get(number, ())) for number, shot in enumerate(shots)]


def capture_of(views: Sequence[View], path: Path, splits: tuple[str, ...] = SPLITS) -> Capture:
    """Return views in memory as a capture in which each of the ``splits`` contains all of the views."""
    return Capture(
        path,
        [
            FrameShot(make=v.frame.replace, stem=v.frame.name, T_world_camera=v.T_ref_camera, splits=splits)
            for v in views
        ],
    )


@dataclass(frozen=True, eq=False, kw_only=True)
class FrameShot(Shot):
    """A shot whose frame is in memory or computed, such as a rendering; it has a background of its own."""

    make: Callable[..., Frame]  # returns the frame with the given ``name``

    def frame(self, background: Colour = BLACK, side: int | None = None) -> Frame:
        """Return the frame; the ``background`` is ignored."""
        found = self.make(name=self.name)
        return found if side is None else found.at_most(side)


def warn_about(where: Path | str, text: str) -> None:
    """Issue a one-line ``InputWarning`` about what was assumed or left out in ``where``."""
    warnings.warn(f"{where}: {text}", InputWarning, stacklevel=3)


def drop_missing_files(capture: Capture) -> list[Shot]:
    """Return the shots whose image files exist, without masks and depth images that do not exist.

    Remarks count the missing files. Raises ``InputError`` if all images or all masks are missing.
    """

    def missing(noun: str, files: Sequence[object]) -> set[object]:
        gone = [file for file in files if isinstance(file, Path) and not is_file(file)]
        if gone and len(gone) == len(files) and noun != "depth image":
            raise InputError(f"no such {noun}, although {capture.path} lists it", where=gone[0])
        if gone:
            first = gone[0].relative_to(capture.path) if gone[0].is_relative_to(capture.path) else gone[0]
            warn_about(
                capture.path,
                f"{len(gone)} of {amount(len(files), noun)} {'is' if len(gone) == 1 else 'are'} missing and left out,"
                f" first: {first}",
            )
        return set(gone)

    gone = missing("image", [shot.image for shot in capture.shots])
    shots = [shot for shot in capture.shots if shot.file not in gone]
    gone = missing("mask", [mask.path for shot in shots for mask in shot.masks])
    gone |= missing("depth image", [shot.depth.path for shot in shots if shot.depth is not None])
    return [
        replace(
            shot,
            masks=tuple(mask for mask in shot.masks if mask.path not in gone),
            depth=None if shot.depth is None or shot.depth.path in gone else shot.depth,
        )
        for shot in shots
    ]
