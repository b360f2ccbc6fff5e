"""Extending a map with new photos: they are localized, training continues, and landmarks and surface are updated."""

from __future__ import annotations

import contextlib
import copy
import itertools
import logging
import math
import time
from collections.abc import Container, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeAlias, cast

import numpy as np
import torch
from jaxtyping import Bool
from scipy.spatial import cKDTree
from torch import Tensor, nn

from bidnerf_core.backend import load_backend
from bidnerf_core.camera import CameraSource
from bidnerf_core.captures import at_stored_poses, stored_cameras
from bidnerf_core.datasets import (
    Capture,
    DatasetOptions,
    Photos,
    find_reader,
    open_dataset,
    photo_files,
)
from bidnerf_core.errors import Cancelled, InputError, amount
from bidnerf_core.fields import RadianceField, render_image, trained_field
from bidnerf_core.frames import Frame, SeenLandmarks, View
from bidnerf_core.geometry import SE3
from bidnerf_core.io import from_plain, locked
from bidnerf_core.localization import Localizer, landmark_cameras
from bidnerf_core.mapping import (
    DEFAULT_LANDMARKS,
    BakeConfig,
    LandmarkMap,
    SurfaceMap,
    TrackedViews,
    bake,
    concatenated,
    tracked_views,
)
from bidnerf_core.maps.baking import bake_landmarks, with_tracks_in
from bidnerf_core.maps.checkpoints import Checkpoints
from bidnerf_core.maps.description import MapInfo, load_info, longest_side
from bidnerf_core.maps.map import USUAL_BAKE, Map, load_map
from bidnerf_core.maps.views import Images, read_views
from bidnerf_core.progress import Cancel, ProgressCallback, check_cancelled, counter, job_context
from bidnerf_core.training import TrainingStopped

log = logging.getLogger("bidnerf")

NewPhotos: TypeAlias = Sequence[Frame] | Sequence[View] | Capture | str | Path
"""Photos to add: frames, a dataset or the path to one (whose own poses are ignored), or the path to a photo
or a folder of photos."""

LeftOut: TypeAlias = tuple[str, str]
"""The name of a photo that is not added, and the reason."""
LEAST_LOCATED = 0.25
"""Smallest fraction of new photos that must be localized for them to show the scene of the map."""
SAME_PLACE = 0.02
"""Distance, relative to the scene, within which a photo with the same name as one of the map's counts as that photo."""
STAND_IN_SIDE = 320
"""Longer side, in pixels, of the renderings that replace the photos the map was built from."""
STAND_IN_DEPTHS = 400
"""Number of pixels of such a rendering whose distances are used in training."""
SAME_DESCRIPTOR = 0.42
"""Largest distance between descriptors of one landmark, relative to that between descriptors of different landmarks."""


def extend(
    scene: Map | str | Path,
    photos: NewPhotos,
    data: Images | None = None,
    *,
    split: str = "train",
    steps: int | None = None,
    config: BakeConfig = USUAL_BAKE,
    progress: ProgressCallback | None = None,
    cancel: Cancel | None = None,
) -> Map:
    """Return a map extended with more photos of its scene; a map in a folder is replaced there once
    everything is done.

    The photos are localized in the map; those that fail, and those the map was built from, are left out.
    Training continues with the others and with ``data``, the images that the map was built from, or, without
    these, with renderings at their cameras, so that the field does not forget them. ``steps`` is the number
    of training steps, by default in proportion to the new photos. Landmarks of the new photos are added (with
    ``data``, all are rebuilt), and the surface is rebaked from all cameras.

    A map whose photos are all known is returned unchanged. Raises ``InputError`` if the photos show another
    scene, if the map has no landmarks for localizing them, and if its folder changes meanwhile; raises
    ``Cancelled`` once ``cancel`` returns True. The map in the folder is then unchanged, as it is if the
    process is killed.
    """
    if steps is not None and (isinstance(steps, bool) or steps < 1):
        raise InputError(f"steps is {steps!r}", expected="a positive whole number")
    folder = scene.folder if isinstance(scene, Map) else Path(scene)
    if folder is not None:
        load_info(folder)  # raises if there is no map
    with job_context(progress, cancel), contextlib.nullcontext() if folder is None else locked(folder):
        scene = scene if isinstance(scene, Map) else load_map(scene)
        if scene.info.interruption is not None:
            raise InputError(f"cannot be extended: {scene.info.interruption}", where=scene.name)
        if not scene.has_field:
            raise InputError(
                "has no radiance field to extend; 'bidnerf train DATA --out MAP' adds one", where=scene.name
            )
        new = locate(scene, *_frames(photos, scene, split))
        if not new:
            log.info(f"{scene.name}: was built from these photos already; nothing to add")
            return scene
        return _extended(scene, new, _old_views(scene, data, split), data is not None, steps, config)


def locate(scene: Map, frames: Sequence[Frame], unread: Sequence[LeftOut]) -> list[View]:
    """Localize frames in a map, and return those that the map was not built from, with names that it does not use yet.

    ``unread`` are photos that could not be read, which count as left out. Raises ``InputError`` if the map
    has no landmarks, and if hardly any of the frames is localized.
    """
    where = scene.name
    if scene.landmarks is None:
        raise InputError(
            "has no landmarks for localizing photos; 'bidnerf bake MAP --data DATA' builds them", where=where
        )
    localizer, cameras = Localizer(scene), {camera.name: camera.pose for camera in scene.info.cameras}
    near, count = SAME_PLACE * scene.bounds.side, counter("locating", "photos")
    views, left_out, known = list[View](), list(unread), 0
    for number, frame in enumerate(frames, start=1):
        check_cancelled("extending")
        try:
            found = localizer.solved(localizer.problem(frame))
        except InputError as error:
            left_out.append((frame.name, str(error)))
        else:
            like = _names_like(frame.name, cameras)
            place = found.T_world_camera.translation
            if not found.converged:
                left_out.append((frame.name, f"{found.outcome}: {found.reason}"))
            elif any(float((place - cameras[name].translation).norm()) < near for name in like):
                known += 1
            else:
                like = _names_like(frame.name, {*cameras, *(view.frame.name for view in views)})
                name = f"{frame.name}_{len(like) + 1}" if like else frame.name
                views.append(View(found.frame_as_taken(frame).replace(name=name), found.T_world_camera))
        count(number, len(frames))
    for name, why in left_out:
        log.info(f"{name}: left out: {why}")
    if len(views) + known < max(1.0, LEAST_LOCATED * len(frames)):
        raise InputError(
            f"localizes {len(views) + known} of {amount(len(frames), 'photo')}",
            where=where,
            expected="photos of its scene",
        )
    log.info(
        f"{where}: {len(views)} of {amount(len(frames) + len(unread), 'photo')} localized, {known}"
        f" already in the map, {len(left_out)} left out"
    )
    return views


def _frames(photos: NewPhotos, scene: Map, split: str) -> tuple[list[Frame], list[LeftOut]]:
    """Read photos, downscaled to the size of the map's largest image; also return those that cannot be read."""
    side, frames, unread = longest_side(scene.info), list[Frame](), list[LeftOut]()
    source: Sequence[Frame] | Sequence[View] | Capture | Photos
    if isinstance(photos, str | Path):
        path, background = Path(photos), scene.bounds.background
        if path.is_dir() and find_reader(path) is not None:
            source = open_dataset(path, background)
        else:
            camera = CameraSource(assumed=landmark_cameras(scene))
            source = Photos(photo_files([path]), DatasetOptions(camera, background=background))
    else:
        source = photos
    if isinstance(source, Capture | Photos):
        capture = source.capture if isinstance(source, Photos) else source.split(split)
        for place, name in enumerate(capture.names):
            try:
                frames.append(capture.at_most(side)[place].frame)
            except InputError as error:
                unread.append((name, str(error)))
    else:
        frames = [item.frame if isinstance(item, View) else item for item in source]
    for frame in frames:
        if not isinstance(frame, Frame):
            raise InputError(f"photos holds a {type(frame).__name__}", expected="frames, views, or a path")
    if not frames and unread:
        raise InputError(f"none of {amount(len(unread), 'photo')} can be read: {unread[0][1]}")
    if not frames:
        raise InputError("no photos to add", expected="at least one")
    frames = [frame.over(scene.bounds.background) for frame in frames]
    return [frame if side is None else frame.at_most(side) for frame in frames], unread


def _old_views(scene: Map, data: Images | None, split: str) -> list[View]:
    """Return the images that the map was built from, or renderings at their cameras."""
    if data is not None:
        background = scene.bounds.background if isinstance(data, str | Path) else None
        read = read_views(data, DatasetOptions(split=split, background=background))
        views = at_stored_poses(read.about(scene.origin).views, scene.info.cameras)
        own = {camera.name for camera in scene.info.cameras}
        if not any(view.frame.name in own for view in views):
            raise InputError(
                "data has none of the images that the map was built from", where=scene.name, expected="these"
            )
        return views
    count, views = counter("rendering", "images"), []
    for number, camera in enumerate(scene.info.cameras, start=1):
        small, pose = camera.intrinsics.at_most(STAND_IN_SIDE), camera.pose
        image = render_image(scene.field, small, pose, scene.bounds)
        frame = Frame(camera.name, image.rgb.cpu().clamp(0, 1), small)
        seen = _distances(frame, image.depth.cpu(), image.opacity.cpu(), number)
        views.append(View(frame, pose, landmarks=seen))
        count(number, len(scene.info.cameras))
    return views


def _distances(frame: Frame, depth: Tensor, opacity: Tensor, seed: int) -> SeenLandmarks:
    """Return some of the distances that a field renders, so that training preserves them without treating
    them as measurements.
    """
    solid = ((opacity > 0.95) & (depth > 0)).nonzero()
    generator = torch.Generator().manual_seed(seed)
    rows = solid[torch.randperm(len(solid), generator=generator)[:STAND_IN_DEPTHS]]
    pixels = rows.flip(-1).double() + 0.5
    along = frame.intrinsics.unproject(pixels).norm(dim=-1)
    distance = depth[rows[:, 0], rows[:, 1]].double() * along
    return SeenLandmarks(pixels.float(), distance.float(), (0.01 * distance).float())


def _extended(
    scene: Map,
    new: Sequence[View],
    old: Sequence[View],
    complete: bool,
    steps: int | None,
    config: BakeConfig,
) -> Map:
    """Return the map with new photos; ``complete`` states whether ``old`` are its own photos, not renderings."""
    began, where, everything = time.monotonic(), scene.name, [*old, *new]
    tracked = tracked_views(
        everything if complete else new,
        scene.info.landmark_features,
    )
    seeing = _with_distances(everything if complete else new, tracked)
    new = seeing[len(old) :] if complete else seeing
    weighted = seeing if complete else [*old] * _repeated(old, new) + seeing
    field, done = _trained_on(scene, weighted, steps, len(new) / max(1, len(everything)))
    info = replace(
        scene.info,
        cameras=(*scene.info.cameras, *stored_cameras(new)),
        step=scene.info.step + done,
        added=scene.info.added + len(new),
        seconds=scene.info.seconds + time.monotonic() - began,
    )
    grown = replace(scene, info=info, field=info.in_map_unit(field), folder=None, record=scene.capture)
    if (surface := _surface(grown, seeing, config)) is not None:
        grown = replace(grown, surface=surface)
    check_cancelled("extending")
    if complete:
        info, landmarks, tracked = bake_landmarks(info, grown.field, seeing, where, tracked)
        grown = replace(grown, info=info, landmarks=landmarks).with_survey(seeing, tracked)
        info = grown.info
    else:
        landmarks = _more_landmarks(info, scene.landmarks, tracked, [view.frame.name for view in new])
    grown = grown.with_parts(None, landmarks or scene.landmarks)
    before, after = (0 if m.landmarks is None else len(m.landmarks) for m in (scene, grown))
    log.info(f"{where}: {before} landmarks before, {after} now; {amount(len(info.cameras), 'image')}")
    if scene.folder is None:
        return grown
    stored = load_info(scene.folder)
    if stored.weights != scene.info.weights:
        raise InputError("was retrained meanwhile; extend it again", where=where)
    check_cancelled("extending")
    return replace(grown, info=replace(info, anchor=stored.anchor)).stored_in(scene.folder)


def _with_distances(views: Sequence[View], tracked: TrackedViews) -> list[View]:
    """Return the views; those without dense depth get the landmarks they show, from which training takes distances."""
    try:
        seen = tracked.seen(DEFAULT_LANDMARKS)
    except InputError:  # one photo, or photos without overlap
        return list(views)
    return [
        view if view.frame.has_dense_depth else replace(view, landmarks=part)
        for view, part in zip(views, seen, strict=True)
    ]


def _repeated(old: Sequence[View], new: Sequence[View]) -> int:
    """Return how often renderings are repeated so that, with fewer pixels than photos, they count as much;
    three times at most.
    """
    if not old:
        return 1
    pixels = [
        sum(v.frame.intrinsics.width * v.frame.intrinsics.height for v in part) / len(part)
        for part in (old, new)
    ]
    return min(3, max(1, round(pixels[1] / pixels[0])))


def _trained_on(
    scene: Map, views: Sequence[View], steps: int | None, share: float
) -> tuple[RadianceField, int]:
    """Continue training a copy of the field; return it, in the unit of its own training, and the number of steps."""
    info = scene.info
    backend = load_backend(info.backend, str(scene.folder or ""))
    settings: Any = from_plain(backend.config_type, info.config, "config")
    usual = getattr(settings, "steps", None)
    if isinstance(usual, int):
        settings = replace(settings, steps=steps or max(1, math.ceil(usual * max(share, 0.25))))
    elif steps is not None:
        raise InputError(f"steps is {steps}, but backend {info.backend!r} has no such setting; leave it out")
    if not isinstance(trained := trained_field(scene.field), nn.Module):
        raise InputError(
            f"the map's field is a {type(trained).__name__}", expected="an nn.Module of a backend"
        )
    field = copy.deepcopy(trained).requires_grad_(True).train()
    if info.field_frame is not None:
        views = [_in_field_unit(view, 1 / info.field_frame.scale) for view in views]
    report = Checkpoints(replace(info, step=0, complete=False))
    try:
        backend.train(cast(RadianceField, field), views, settings, report)
    except TrainingStopped as stopped:
        raise Cancelled(f"cancelled after step {stopped.step}; the map is unchanged") from stopped
    field.requires_grad_(False).eval()
    return cast(RadianceField, field), int(getattr(settings, "steps", report.info.step))


def _in_field_unit(view: View, factor: float) -> View:
    """Return a view with all lengths multiplied by a factor."""
    pose = SE3(view.T_ref_camera.rotation, view.T_ref_camera.translation * factor)
    frame, seen = view.frame, view.landmarks
    if frame.depth is not None:
        frame = frame.replace(depth=frame.depth * factor)
    if seen is not None:
        seen = replace(seen, distance=seen.distance * factor, deviation=seen.deviation * factor)
    return replace(view, frame=frame, T_ref_camera=pose, landmarks=seen)


def _surface(scene: Map, views: Sequence[View], config: BakeConfig) -> SurfaceMap | None:
    """Bake the surface from the measured depth of views and, unlike ``bake_surface``, also from depth rendered from the
    other cameras: the photos of these are not at hand, and what they measured must not be lost.
    """
    measured = [view for view in views if view.frame.has_dense_depth]
    names = {view.frame.name for view in measured}
    others = [(c.intrinsics, c.pose) for c in scene.info.cameras if c.name not in names]
    try:
        return bake(scene.field, scene.bounds, others, measured, config)
    except InputError as error:
        log.info(f"the surface is unchanged: {error}")
        return None


def _more_landmarks(
    info: MapInfo, landmarks: LandmarkMap | None, tracked: TrackedViews, names: Sequence[str]
) -> LandmarkMap | None:
    """Return the landmarks of a map plus those of new photos, called ``names``, that it lacks."""
    try:
        more = with_tracks_in(info, tracked.landmarks(DEFAULT_LANDMARKS), names)
    except InputError as error:  # one photo, or photos without overlap
        log.info(f"no new landmarks: {error}")
        return landmarks
    if landmarks is None or not len(more):
        return landmarks or more
    return concatenated([landmarks, more[~_present(landmarks, more)]])


def _present(landmarks: LandmarkMap, more: LandmarkMap) -> Bool[Tensor, "n"]:
    """Return which landmarks of ``more`` match one of ``landmarks``: near in space, given its accuracy, with
    a similar descriptor.
    """
    count = min(4, len(landmarks))
    away, near = cKDTree(landmarks.positions.numpy()).query(more.positions.numpy(), k=count)
    distance = torch.from_numpy(np.asarray(away).reshape(len(more), -1))
    index = torch.from_numpy(np.asarray(near).reshape(len(more), -1))
    deviation = more.deviations.amax(-1)[:, None] + landmarks.deviations.amax(-1)[index]
    descriptors = landmarks.descriptors[index].float() - more.descriptors[:, None].float()
    alike = descriptors.norm(dim=-1) <= SAME_DESCRIPTOR * landmarks.unrelated_distance
    return ((distance <= 3 * deviation) & alike).any(-1)


def _names_like(name: str, taken: Container[str]) -> list[str]:
    """Return the names taken by photos called ``name``: the name itself, and those that were derived from it."""
    found = itertools.takewhile(
        lambda each: each in taken, itertools.chain([name], (f"{name}_{n}" for n in itertools.count(2)))
    )
    return list(found)
