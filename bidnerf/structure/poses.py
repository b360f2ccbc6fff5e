"""Pose estimation for photos without poses: from a folder of photos, or a video, to a dataset."""

from __future__ import annotations

import contextlib
import itertools
import json
import shutil
import time
import warnings
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from bidnerf.structure.colmap import (
    import_pycolmap,
    list_photos,
    write_cameras,
    write_keypoints,
)
from bidnerf.structure.gps import project_positions
from bidnerf.structure.matching import candidate_pairs, chosen_pairs, match
from bidnerf.structure.model import (
    count_contradictions,
    reasons_left_out,
    reconstruct,
    relative_path,
    require_parallax,
    write_dataset,
)
from bidnerf.structure.record import (
    FRAMES,
    RECORD,
    FoundPoses,
    LeftOut,
    digest,
    interrupted_work,
    is_output,
    open_work,
    part_folder,
    read_pose_record,
    remove_output,
)
from bidnerf.structure.sources import (
    choose_frames,
    measure_frames,
    photos_of,
    refuse_panoramas,
    write_frames,
)
from bidnerf_core.camera import UPRIGHT, Camera, CameraSource
from bidnerf_core.datasets import Capture
from bidnerf_core.errors import Cancelled, InputError, InputWarning, amount
from bidnerf_core.geometry import SE3
from bidnerf_core.io import output_folder, to_plain, write_file
from bidnerf_core.progress import Cancel, ProgressCallback, job_context, log


def find_poses(
    photos: str | Path,
    out: str | Path,
    camera: Camera | CameraSource | str | Path | None = None,
    overwrite: bool = False,
    progress: ProgressCallback | None = None,
    cancel: Cancel | None = None,
    *,
    reuse: bool = False,
    known: Mapping[str, SE3] | None = None,
) -> FoundPoses:
    """Find the poses of photos by structure from motion with COLMAP (extra ``sfm``), and write them as a dataset.

    ``photos`` is a folder of photos, or a video, from which frames are chosen by motion and sharpness and
    written as images, or a recording in a known format that has no poses, whose cameras are kept fixed. ``camera``
    (intrinsics, a file of them, or a source of either) is kept fixed; without it, focal length and
    radial distortion are estimated, starting from EXIF. Models that show the same points are joined. If several
    remain, the largest is the dataset, and the others are datasets in the folders ``part-2``, ``part-3`` and so on within it. ``known``
    poses (T_world_camera, by name of the photo, of some photos, by any program, in any world) only tell which photos are compared.

    The dataset is a ``transforms.json`` that refers to the photos in place; ``poses.json`` is the returned record,
    with the photos that were left out and why; ``sparse/0`` is the model in COLMAP's format. The unit of length is
    metres if a recording without poses has depth, or if the EXIF of enough photos has GPS positions, which then also place the world
    (see the record's ``geo_frame``); otherwise it is arbitrary. z points up. Interrupted work in the same folder is resumed; poses already found for the same
    photos are returned immediately, unless ``overwrite`` is set and ``reuse`` is not.

    ``progress`` receives each step; once ``cancel`` returns True, ``Cancelled`` is raised. Raises
    ``InputError`` if fewer than three photos can be read or registered, if poses are already known, if the folder
    holds something else and ``overwrite`` is not set, and if pycolmap is missing.
    """
    source, folder = Path(photos), Path(out)
    pycolmap = import_pycolmap(str(source))
    images = photos_of(source, folder, camera)
    files = [shot.file for shot in images.shots if shot.file is not None]
    inputs = digest(files or [source], camera, known)
    names = {shot.name for shot in images.shots}
    if known and files and not names & known.keys():
        raise InputError(
            f"known has none of the {len(names)} photos, such as {min(names)!r}",
            where=source,
            expected="poses by name of a photo",
        )
    if reuse or not overwrite:
        with contextlib.suppress(*([InputError] if overwrite else [])):  # a damaged record is replaced
            record = read_pose_record(folder)
            if record is not None and record.inputs == inputs:
                log.info(f"{folder}: already has the poses of these photos")
                return record
    resumes = interrupted_work(folder).get("inputs") == inputs

    def describe_content(folder: Path) -> str | None:
        if (folder / RECORD).exists():
            return "holds the poses of other photos"
        return "holds interrupted work on other photos" if interrupted_work(folder) else None

    with (
        job_context(progress, cancel),
        output_folder(folder, overwrite, lambda file: resumes and is_output(file), describe_content),
    ):
        if overwrite and not reuse:
            remove_output(folder)
        work = open_work(folder, inputs, video=not files)
        try:
            record = _search(source, images, work, inputs, camera, known or {}, pycolmap)
        except Cancelled as stopped:
            raise Cancelled(f"{folder}: {stopped}; the same command resumes from there") from stopped
        except InputError:
            remove_output(folder)
            raise
        write_file(folder / RECORD, json.dumps(to_plain(record), indent=1, allow_nan=False).encode())
        shutil.rmtree(work, ignore_errors=True)
    for line in str(record).splitlines():
        log.info(f"{source}: {line}")
    if record.doubt is not None:
        warnings.warn(f"{source}: {record.doubt}", InputWarning, stacklevel=2)
    return record


def _search(
    source: Path,
    images: Capture,
    work: Path,
    inputs: str,
    camera: Camera | CameraSource | str | Path | None,
    known: Mapping[str, SE3],
    pycolmap: Any,
) -> FoundPoses:
    """Find the poses of the images of ``source``, or of frames chosen from a recording; write the dataset next to ``work``."""
    start, folder, database, video = time.monotonic(), work.parent, work / "database.db", images.shots[0].file is None
    threads = max(1, torch.get_num_threads())
    if video:
        images = write_frames(images, folder / FRAMES, choose_frames(measure_frames(images)))
    refuse_panoramas([shot.file for shot in images.shots if shot.file is not None])
    photos = list_photos(images, camera)
    try:
        stored = pycolmap.Database.open(database)
    except RuntimeError as damage:
        raise InputError(
            "cannot be read, perhaps damaged;", where=database, expected="the same command once more, which begins anew"
        ) from damage
    with stored as opened:
        photos.require_enough(source)
        if not opened.num_images():
            write_cameras(opened, photos, pycolmap)
        write_keypoints(opened, photos, pycolmap)
        photos.require_enough(source)
        keypoints = {photo.number: opened.num_keypoints_for_image(photo.number) for photo in photos.photos}
        numbers = [number for number, count in keypoints.items() if count]
        descriptors = [opened.read_descriptors(number).data for number in numbers]
        by_number = {photo.number: photo for photo in photos.photos}
        positions, _ = project_positions(by_number, pycolmap)
        by_gps = {number: SE3(torch.eye(3).double(), torch.from_numpy(place)) for number, place in positions.items()}
        given = {number: known[photo.shot.name] for number, photo in by_number.items() if photo.shot.name in known}
        near = [{i: poses[n] for i, n in enumerate(numbers) if n in poses} for poses in (by_gps, given)]
        chosen = chosen_pairs(descriptors, candidate_pairs(descriptors, *near))
        match(opened, photos, [(numbers[i], numbers[j]) for i, j in chosen], pycolmap)
    models = reconstruct(database, work / "models", photos, threads, pycolmap)
    with pycolmap.Database.open(database) as opened:
        matched = zip(*opened.read_two_view_geometries(), strict=True)
        overlapping = [pycolmap.pair_id_to_image_pair(pair) for pair, seen in matched if len(seen.inlier_matches)]
        if not models:
            why = "no two of them overlap enough"
            if overlapping:
                why = f"although {amount(len(overlapping), 'pair')} overlap; from one place, they do not determine distances"
            raise InputError(
                f"no three of {amount(len(photos.photos), 'photo')} could be placed: {why};",
                where=source,
                expected="photos that overlap by two thirds, taken while moving sideways",
            )
        require_parallax(models[0], opened, photos, source, pycolmap)
        model = models[0]
        sure, contradicting = count_contradictions(model, opened, pycolmap)
    error = model.compute_mean_reprojection_error()
    base: Path = folder / FRAMES if video else source
    frames = [
        write_dataset(part_folder(folder, rank), by_number, each, base, images.depth_unit, pycolmap)
        for rank, each in enumerate(models)
    ]
    metric, geo_frame = frames[0]
    reasons = reasons_left_out(photos, models, Counter(itertools.chain(*overlapping)), keypoints)
    left_out = [
        LeftOut(shot.name, relative_path(Path(str(shot.image)), folder), reasons[shot.name])
        for shot in images.shots
        if shot.name in reasons
    ]
    return FoundPoses(
        source=source.name,
        photos=len(images),
        placed=model.num_reg_images(),
        models=tuple(each.num_reg_images() for each in models),
        left_out=tuple(left_out),
        points=model.num_points3D(),
        reprojection_error=error,
        seconds=round(time.monotonic() - start, 1),
        inputs=inputs,
        pycolmap=pycolmap.__version__,
        video=video,
        sure_pairs=sure,
        contradicting=contradicting,
        turned=sum(by_number[number].exif.orientation != UPRIGHT for number in model.reg_image_ids()),
        metric=metric,
        geo_frame=geo_frame,
    )
