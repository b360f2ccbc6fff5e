"""Finding poses for photos without any: from a folder of photos, or a video, to a dataset."""

from __future__ import annotations

import contextlib
import itertools
import json
import logging
import time
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch

from bidnerf_core.camera import UPRIGHT, Intrinsics
from bidnerf_core.datasets import is_video
from bidnerf_core.errors import Cancelled, InputError, InputWarning, amount
from bidnerf_core.io import output_folder, write_file
from bidnerf_core.progress import Cancel, ProgressCallback, job_context
from bidnerf_core.structure.agreement import agreement
from bidnerf_core.structure.keypoints import Described, described, write_cameras, write_keypoints
from bidnerf_core.structure.library import pycolmap_for
from bidnerf_core.structure.mapping import LEAST_PHOTOS, full_size, left_out, reconstructed, turn_upright
from bidnerf_core.structure.matching import Overlaps, match
from bidnerf_core.structure.pairs import Pairs, chosen_pairs, few
from bidnerf_core.structure.record import (
    DATABASE,
    FRAMES,
    RECORD,
    FoundPoses,
    LeftOut,
    begin,
    begun,
    clear,
    digest,
    give_up,
    is_ours,
    read_found,
    relative,
    stored_rows,
    without_damage,
    write_dataset,
    write_found,
)
from bidnerf_core.structure.sources import SourceImage, photos_of, refuse_panoramas
from bidnerf_core.structure.video_frames import chosen, measured, write_frames

log = logging.getLogger("bidnerf")


def find_poses(
    photos: str | Path,
    out: str | Path,
    camera: Intrinsics | str | Path | None = None,
    overwrite: bool = False,
    progress: ProgressCallback | None = None,
    cancel: Cancel | None = None,
    *,
    reuse: bool = False,
) -> FoundPoses:
    """Find the poses of photos by structure from motion (COLMAP, extra ``sfm``), and write them as a dataset into ``out``.

    ``photos`` is a folder of photos, or a video, from which frames are chosen by motion and sharpness and
    written as images. ``camera`` (intrinsics or a file of them) is kept fixed; without it, focal length and
    radial distortion are estimated, starting from EXIF. If the photos fall into several models, the largest
    is kept.

    The dataset is a ``transforms.json`` that refers to the photos in place; ``poses.json`` lists those that
    were left out and why, and ``sparse/0`` is the model for COLMAP. The unit of length is arbitrary, and z
    points up. Interrupted work in the same folder is resumed; poses already found for the same photos are
    returned immediately, unless ``overwrite`` is set and ``reuse`` is not.

    ``progress`` receives each step; once ``cancel`` returns True, ``Cancelled`` is raised. Raises
    ``InputError`` if fewer than three photos can be read or registered, if poses are already known, if the folder
    holds something else and ``overwrite`` is not set, and if pycolmap is missing.
    """
    source, folder = Path(photos), Path(out)
    pycolmap = pycolmap_for(str(source))
    images = [] if is_video(source) else photos_of(source, folder)
    if not images and not source.is_file():
        raise InputError("no such file", where=source, expected="a video or a folder of photos")
    inputs = digest([image.file for image in images] or [source], camera)
    known = found_before(folder, inputs, overwrite) if reuse or not overwrite else None
    if known is not None:
        log.info(f"{folder}: already has the poses of these photos")
        return known
    refuse_panoramas(images)
    with job_context(progress, cancel), _folder(folder, inputs, overwrite):
        if overwrite and not reuse:
            clear(folder)
        work = begin(folder, inputs, video=is_video(source))
        try:
            return _Search(source, folder, work, inputs, camera, pycolmap).run(images)
        except Cancelled as stopped:
            raise Cancelled(f"{folder}: {stopped}; the same command resumes from there") from stopped
        except InputError:
            give_up(folder)
            raise


def found_before(folder: Path, inputs: str, overwrite: bool) -> FoundPoses | None:
    """Return the poses in a folder if they were found for the photos with the digest ``inputs``.

    Raises ``InputError`` for a damaged record, unless the folder may be overwritten.
    """
    try:
        known = read_found(folder)
    except InputError as error:
        if not overwrite:
            raise
        log.info(f"{error}; finding the poses again")
        return None
    return known if known is not None and known.inputs == inputs else None


@contextlib.contextmanager
def _folder(out: Path, inputs: str, overwrite: bool) -> Iterator[None]:
    """Hold the lock of the pose folder, which is empty, or holds interrupted work on the same photos."""
    goes_on = begun(out).get("inputs") == inputs or begun(out).get("failed") is True

    def describe(folder: Path) -> str | None:
        if (folder / RECORD).exists():
            return "holds the poses of other photos"
        return "holds interrupted work on other photos" if begun(folder).get("inputs") else None

    with output_folder(out, overwrite, lambda file: goes_on and is_ours(file), describe):
        yield


class _Search:
    """A single search for the poses of some photos."""

    def __init__(
        self,
        source: Path,
        folder: Path,
        work: Path,
        inputs: str,
        camera: Intrinsics | str | Path | None,
        pycolmap: Any,
    ) -> None:
        self._source, self._folder, self._work, self._inputs = source, folder, work, inputs
        self._camera, self._pycolmap, self._began = camera, pycolmap, time.monotonic()
        self._database = without_damage(work / DATABASE)
        self._threads = max(1, torch.get_num_threads())

    def run(self, images: list[SourceImage]) -> FoundPoses:
        ordered = not images
        if ordered:
            images = self._frames()
        found = self._described(images)
        keypoints = self._keypoints(found)
        numbers = [photo.number for photo in found.photos]
        pairs = self._pairs(numbers, ordered)
        pairs = [(i, j) for i, j in pairs if keypoints[numbers[i]] and keypoints[numbers[j]]]
        match(self._database, numbers, pairs, self._threads, self._pycolmap)
        models = reconstructed(
            self._database,
            self._work / "models",
            found,
            self._camera is not None,
            self._threads,
            self._pycolmap,
        )
        with self._pycolmap.Database.open(self._database) as database:
            overlaps = Overlaps(database, self._pycolmap)
        if not models:
            raise InputError(
                f"{_unplaced(found, overlaps)};",
                where=self._source,
                expected="photos that overlap by two thirds, taken while moving sideways",
            )
        return self._written(images, found, models, left_out(found, models, overlaps, keypoints))

    def _frames(self) -> list[SourceImage]:
        """Return the chosen frames of a video, written as images unless that was done before."""
        listed = self._work / "frames.json"
        known = stored_rows(listed, tuple[str, str, float])
        if known is not None and all(Path(file).is_file() for _, file, _ in known):
            return [SourceImage(name, Path(file), at) for name, file, at in known]
        measures = measured(self._source)
        wanted = chosen(measures)
        log.info(
            f"{self._source}: {len(wanted)} of {amount(len(measures), 'frame')} chosen by motion and sharpness"
        )
        images = write_frames(self._source, self._folder / FRAMES, wanted)
        rows = [[image.name, str(image.file), image.time] for image in images]
        write_file(listed, json.dumps(rows).encode())
        return images

    def _described(self, images: list[SourceImage]) -> Described:
        found = described(images, self._camera)
        self._require_enough(found, len(images))
        sizes = {photo.size for photo in found.photos}
        size = "x".join(map(str, next(iter(sizes)))) if len(sizes) == 1 else f"{len(sizes)} sizes"
        focal = "from EXIF" if all(found.known_focal.values()) else "to be estimated"
        if self._camera is not None:
            focal = "as given"
        log.info(
            f"{self._source}: no known poses; finding them for {amount(len(found.photos), 'photo')} of"
            f" {size}, {amount(len(found.cameras), 'camera')}, focal length {focal}"
        )
        return found

    def _require_enough(self, found: Described, total: int) -> None:
        if len(found.photos) >= LEAST_PHOTOS:
            return
        first = next(iter(found.unusable.items()), None)
        why = "" if first is None else f" that can be read, of {total} ({first[0]}: {first[1]})"
        raise InputError(
            f"{amount(len(found.photos), 'photo')}{why}",
            where=self._source,
            expected=f"at least {LEAST_PHOTOS} of one scene, taken from different places",
        )

    def _keypoints(self, found: Described) -> dict[int, int]:
        """Fill the database, and return the number of keypoints of each photo by its number."""
        with self._pycolmap.Database.open(self._database) as database:
            if not database.num_images():
                write_cameras(database, found, self._camera is not None, self._pycolmap)
            found.unusable.update(write_keypoints(database, found, self._pycolmap))
            found.photos[:] = [photo for photo in found.photos if photo.image.name not in found.unusable]
            self._require_enough(found, len(found.photos) + len(found.unusable))
            return {photo.number: database.num_keypoints_for_image(photo.number) for photo in found.photos}

    def _pairs(self, numbers: list[int], ordered: bool) -> Pairs:
        if few(len(numbers), ordered):
            return list(itertools.combinations(range(len(numbers)), 2))
        stored = self._work / "pairs.json"
        pairs = stored_rows(stored, tuple[int, int])
        if pairs is None:
            with self._pycolmap.Database.open(self._database) as database:
                pairs = chosen_pairs([database.read_descriptors(number).data for number in numbers])
            log.info(f"{self._source}: {len(pairs)} pairs of neighbours and similar photos")
            write_file(stored, json.dumps(pairs).encode())
        return pairs

    def _written(
        self, images: list[SourceImage], found: Described, models: list[Any], reasons: dict[str, str]
    ) -> FoundPoses:
        photos, model = {photo.number: photo for photo in found.photos}, models[0]
        error = model.compute_mean_reprojection_error()
        with self._pycolmap.Database.open(self._database) as database:
            sure, contradicting = agreement(model, database, self._pycolmap)
        turn_upright(model, photos, self._pycolmap)
        full_size(model, photos)
        base = self._folder / FRAMES if is_video(self._source) else self._source
        names = {number: relative(photo.image.file, base) for number, photo in photos.items()}
        write_dataset(self._folder, photos, model, names)
        left = [
            LeftOut(image.name, relative(image.file, self._folder), reasons[image.name])
            for image in images
            if image.name in reasons
        ]
        result = FoundPoses(
            self._source.name, len(images), model.num_reg_images(), tuple(each.num_reg_images() for each in models), tuple(left), model.num_points3D(),
            error, round(time.monotonic() - self._began, 1), self._inputs, self._pycolmap.__version__,
            is_video(self._source), sure, contradicting,
            sum(photos[number].exif.orientation != UPRIGHT for number in model.reg_image_ids()),
        )  # fmt: skip
        write_found(self._folder, result)
        for line in str(result).splitlines():
            log.info(f"{self._source}: {line}")
        if result.doubt is not None:
            warnings.warn(f"{self._source}: {result.doubt}", InputWarning, stacklevel=2)
        return result


def _unplaced(found: Described, overlaps: Overlaps) -> str:
    """Return why no three photos could be registered."""
    of = f"no three of {amount(len(found.photos), 'photo')} could be placed"
    if not overlaps.pairs:
        return f"{of}: no two of them overlap enough"
    if overlaps.from_one_place > overlaps.pairs / 2:  # as if the camera had only rotated
        return f"{of}: they seem to be taken from one place, which does not determine distances"
    return f"{of}, although {amount(overlaps.pairs, 'pair')} overlap"
