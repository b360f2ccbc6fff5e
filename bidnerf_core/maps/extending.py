"""Extending a map with new photos: localizing them, training further, and updating the landmarks and the surface."""

from __future__ import annotations

import contextlib
import itertools
import math
from collections.abc import Container, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import torch
from jaxtyping import Bool
from scipy.spatial import cKDTree
from torch import Tensor, nn

from bidnerf_core.backend import load_backend
from bidnerf_core.camera import CameraSource
from bidnerf_core.captures import stored_cameras
from bidnerf_core.datasets import (
    Capture,
    DatasetOptions,
    Photos,
    find_reader,
    open_dataset,
    photo_files,
)
from bidnerf_core.errors import InputError, amount
from bidnerf_core.fields import NoField, device_of, render_image, trained_field
from bidnerf_core.frames import Frame, SeenLandmarks, View
from bidnerf_core.io import from_plain, lock, to_plain
from bidnerf_core.localization import Outcome
from bidnerf_core.mapping import (
    DEFAULT_LANDMARKS,
    BakeConfig,
    LandmarkMap,
    bake,
    concatenate,
    track_views,
)
from bidnerf_core.maps.description import load_info, longest_side
from bidnerf_core.maps.localizer import Localizer
from bidnerf_core.maps.map import USUAL_BAKE, Map, load_map
from bidnerf_core.maps.scene import landmark_cameras
from bidnerf_core.maps.store import with_tracks_in
from bidnerf_core.maps.training import TrainOptions, train_field
from bidnerf_core.maps.views import ViewSource, scaled_view, views_again
from bidnerf_core.progress import Cancel, ProgressCallback, check_cancelled, job_context, log, report_each

NewPhotos: TypeAlias = Sequence[Frame] | Sequence[View] | Capture | str | Path
"""Photos to add: frames, views, a dataset or the path to one, or the path to a photo or a folder of photos.
Poses that come with them are ignored."""

LeftOutPhoto: TypeAlias = tuple[str, str]
"""The name of a photo that was left out, and the reason."""


def extend(
    scene: Map | str | Path,
    photos: NewPhotos,
    data: ViewSource | None = None,
    *,
    split: str = "train",
    steps: int | None = None,
    config: BakeConfig = USUAL_BAKE,
    device: torch.device | str = "cpu",
    progress: ProgressCallback | None = None,
    cancel: Cancel | None = None,
) -> Map:
    """Extend a map with more photos of its scene, and return it; a map in a folder is replaced only at the end.

    The photos are localized in the map; photos that cannot be localized, and photos from which the map was
    built, are left out. Training continues with the new photos and with ``data``, the images from which the map
    was built. Without ``data``, renderings at the cameras of those images are used instead, so that the field
    does not forget them. ``steps`` is the number of training steps, by default in proportion to the number of
    new photos; it runs on ``device`` if the map is in a folder. Landmarks of the new photos are added (with ``data``, all landmarks are rebuilt), and the
    surface is rebaked from all cameras.

    A map that already contains all the photos is returned unchanged. Raises ``InputError`` if the photos show
    another scene, if the map has no field or no landmarks or is not fully trained, and if it is retrained
    meanwhile; raises ``Cancelled`` once ``cancel`` returns True. In these cases, and if the process is killed,
    the map in the folder is unchanged.
    """
    if steps is not None and (isinstance(steps, bool) or steps < 1):
        raise InputError(f"steps is {steps!r}", expected="a positive whole number")
    folder = scene.folder if isinstance(scene, Map) else Path(scene)
    if folder is not None:
        load_info(folder)  # raises if there is no map
    with job_context(progress, cancel), contextlib.nullcontext() if folder is None else lock(folder):
        scene = scene if isinstance(scene, Map) else load_map(scene, device)
        if scene.info.interruption is not None:
            raise InputError(f"cannot be extended: {scene.info.interruption}", where=scene.name)
        if not scene.has_field:
            raise InputError(
                "has no radiance field to extend; 'bidnerf train DATA --out MAP' adds one", where=scene.name
            )
        new = localize_new(scene, *_frames(photos, scene, split))
        if not new:
            log.info(f"{scene.name}: was built from these photos already; nothing to add")
            return scene
        return _extend(scene, new, _old_views(scene, data, split), data is not None, steps, config)


def localize_new(scene: Map, frames: Sequence[Frame], unread: Sequence[LeftOutPhoto]) -> list[View]:
    """Localize frames in a map, and return those that are new to it as views, with names that the map does not use yet.

    ``unread`` lists the photos that could not be read; they count as left out. Raises ``InputError`` if the map
    has no landmarks, and if fewer than a quarter of the frames are localized.
    """
    where = scene.name
    if scene.landmarks is None:
        raise InputError(
            "has no landmarks for localizing photos; 'bidnerf bake MAP --data DATA' builds them", where=where
        )
    localizer, cameras = Localizer(scene), {camera.name: camera.pose for camera in scene.info.cameras}
    # A photo with the name of one of the map's photos counts as that photo if it was taken within this
    # distance of it.
    near = 0.02 * scene.bounds.side
    views, left_out, known, outcomes = list[View](), list(unread), 0, list[Outcome]()
    for frame in report_each(frames, "locating", "photos"):
        try:
            found = localizer.solve(localizer.problem(frame))
        except InputError as error:
            left_out.append((frame.name, str(error)))
        else:
            like = _names_like(frame.name, cameras)
            position = found.T_world_camera.translation
            outcomes.append(found.outcome)
            if not found.converged:
                left_out.append((frame.name, f"{found.outcome}: {found.reason}"))
            elif any(float((position - cameras[name].translation).norm()) < near for name in like):
                known += 1
            else:
                like = _names_like(frame.name, {*cameras, *(view.frame.name for view in views)})
                name = f"{frame.name}_{len(like) + 1}" if like else frame.name
                views.append(View(found.frame_as_taken(frame).replace(name=name), found.T_world_camera))
    for name, why in left_out:
        log.info(f"{name}: left out: {why}")
    # If fewer photos than this are localized, they do not show the scene of the map.
    if len(views) + known < max(1.0, 0.25 * len(frames)):
        problem = f"localizes {len(views) + known} of {amount(len(frames), 'photo')}"
        expected = "photos of its scene"
        if vague := outcomes.count(Outcome.IMPRECISE):
            problem += f", and {vague} more, but too imprecisely to add"
            expected = "photos that show more of what the map's show, from as near, or with depth"
        raise InputError(problem, where=where, expected=expected)
    log.info(
        f"{where}: {len(views)} of {amount(len(frames) + len(unread), 'photo')} localized, {known}"
        f" already in the map, {len(left_out)} left out"
    )
    return views


def _frames(photos: NewPhotos, scene: Map, split: str) -> tuple[list[Frame], list[LeftOutPhoto]]:
    """Read photos, downscaled to the size of the map's largest image; also return the photos that cannot be read."""
    side, background = longest_side(scene.info), scene.bounds.background
    frames, unread = list[Any](), list[LeftOutPhoto]()
    source: Sequence[Frame] | Sequence[View] | Capture
    if not isinstance(photos, str | Path):
        source = photos.split(split) if isinstance(photos, Capture) and photos.splits else photos
    elif (path := Path(photos)).is_dir() and find_reader(path) is not None:
        source = open_dataset(path, background).split(split)
    else:
        options = DatasetOptions(CameraSource(assumed=landmark_cameras(scene)), background=background)
        source = Photos(photo_files([path]), options).capture
    if isinstance(source, Capture):
        for index, name in enumerate(source.names):
            try:
                frames.append(source.at_most(side)[index].frame)
            except InputError as error:
                unread.append((name, str(error)))
    else:
        frames = [item.frame if isinstance(item, View) else item for item in source]
    if odd := [type(frame).__name__ for frame in frames if not isinstance(frame, Frame)]:
        raise InputError(f"photos holds a {odd[0]}", expected="frames, views, or a path")
    if not frames and unread:
        several = f"none of {amount(len(unread), 'photo')} can be read, the first: " if len(unread) > 1 else ""
        raise InputError(f"{several}{unread[0][1]}")
    if not frames:
        raise InputError("no photos to add", expected="at least one")
    seen = [frame.over(background) for frame in frames]
    return [frame if side is None else frame.at_most(side) for frame in seen], unread


def _old_views(scene: Map, data: ViewSource | None, split: str) -> list[View]:
    """Return the images in ``data`` at the map's poses or, without ``data``, renderings from the map's cameras."""
    if data is not None:
        _, views = views_again(scene.info, data, DatasetOptions(split=split))
        if not {camera.name for camera in scene.info.cameras} & {view.frame.name for view in views}:
            raise InputError(
                "data has none of the images that the map was built from", where=scene.name, expected="these"
            )
        return views
    views = []
    for number, camera in enumerate(report_each(scene.info.cameras, "rendering", "images"), start=1):
        small, pose = camera.intrinsics.at_most(320), camera.pose
        image = render_image(scene.field, small, pose, scene.bounds)
        # Training preserves some of the distances that the field renders, without treating them as measurements.
        depth, generator = image.depth.cpu(), torch.Generator().manual_seed(number)
        solid = ((image.opacity.cpu() > 0.95) & (depth > 0)).nonzero()
        rows = solid[torch.randperm(len(solid), generator=generator)[:400]]
        pixels = rows.flip(-1).double() + 0.5
        distance = depth[rows[:, 0], rows[:, 1]].double() * small.unproject(pixels).norm(dim=-1)
        seen = SeenLandmarks(pixels.float(), distance.float(), (0.01 * distance).float())
        views.append(View(Frame(camera.name, image.rgb.cpu().clamp(0, 1), small), pose, landmarks=seen))
    return views


def _extend(
    scene: Map,
    new: Sequence[View],
    old: Sequence[View],
    complete: bool,
    steps: int | None,
    config: BakeConfig,
) -> Map:
    """Return the map extended with ``new``; ``complete`` is whether ``old`` holds the map's photos rather than renderings."""
    where, everything = scene.name, [*old, *new]
    given = everything if complete else new
    tracked = track_views(given, scene.info.landmark_features)
    seeing = list(given)
    with contextlib.suppress(InputError):  # one photo, or photos without overlap
        # Photos without dense depth get the landmarks they show, from which training takes distances.
        parts = zip(given, tracked.landmarks_by_image(DEFAULT_LANDMARKS), strict=True)
        seeing = [v if v.frame.has_dense_depth else replace(v, landmarks=part) for v, part in parts]
    new, weighted = (seeing[len(old) :], seeing) if complete else (seeing, [*old, *seeing])
    if old and not complete:  # renderings have fewer pixels than photos, but should count as much
        pixels = [
            sum(v.frame.intrinsics.width * v.frame.intrinsics.height for v in part) / len(part) for part in (old, new)
        ]
        weighted = [*old] * min(3, max(1, round(pixels[1] / pixels[0]))) + seeing
    grown = _train_further(scene, weighted, steps, len(new) / max(1, len(everything)))
    info = replace(
        grown.info,
        cameras=(*scene.info.cameras, *stored_cameras(new)),
        added=scene.info.added + len(new),
    )
    grown = replace(grown, info=info)
    # Unlike in ``Map.with_surface``, the surface is baked from measured depth and also from depth rendered from the
    # other cameras: their photos are not at hand, and what they measured must not be lost.
    measured = [view for view in seeing if view.frame.has_dense_depth]
    names = {view.frame.name for view in measured}
    others = [(c.intrinsics, c.pose) for c in info.cameras if c.name not in names]
    try:
        grown = replace(grown, surface=bake(grown.field, grown.bounds, others, measured, config))
    except InputError as error:
        log.info(f"the surface is unchanged: {error}")
    if complete:
        grown, tracked_again = grown.with_landmarks(seeing, tracked=tracked)
        grown = grown.with_survey(seeing, tracked_again)
    else:
        check_cancelled("extending")
        try:
            more = with_tracks_in(info, tracked.landmarks(DEFAULT_LANDMARKS), [view.frame.name for view in new])
        except InputError as error:  # one photo, or photos without overlap
            log.info(f"no new landmarks: {error}")
        else:
            own = scene.landmarks
            if own is not None and len(more):
                more = concatenate([own, more[~_present(own, more)]]).indexed()
            grown = grown.with_parts(None, more if own is None or len(more) else own)
    before, after = (0 if m.landmarks is None else len(m.landmarks) for m in (scene, grown))
    log.info(f"{where}: {before} landmarks before, {after} now; {amount(len(info.cameras), 'image')}")
    grown = replace(grown, info=replace(grown.info, data=scene.info.data))
    if scene.folder is None:
        return grown
    stored = load_info(scene.folder)
    if stored.weights != scene.info.weights:
        raise InputError("was retrained meanwhile; extend it again", where=where)
    check_cancelled("extending")
    return replace(grown, info=replace(grown.info, anchor=stored.anchor)).write_to(scene.folder)


def _train_further(scene: Map, views: Sequence[View], steps: int | None, share: float) -> Map:
    """Train a copy of the map's field further on ``views``, and return the map in memory with the new field.

    By default, the number of steps is the usual one times ``share``, the fraction of new views, or times 0.25
    if that is more.
    """
    info, field = scene.info, trained_field(scene.field)
    settings: Any = from_plain(load_backend(info.backend, str(scene.folder or "")).config_type, info.config, "config")
    usual = getattr(settings, "steps", None)
    if isinstance(usual, int):
        settings = replace(settings, steps=steps or max(1, math.ceil(usual * max(share, 0.25))))
    elif steps is not None:
        raise InputError(f"steps is {steps}, but backend {info.backend!r} has no such setting; leave it out")
    if not isinstance(field, nn.Module):
        raise InputError(f"the map's field is a {type(field).__name__}", expected="an nn.Module of a backend")
    if info.field_frame is not None:
        views = [scaled_view(view, 1 / info.field_frame.scale) for view in views]
    grown = train_field(
        views,
        Map(replace(info, data=scene.name, step=0, complete=False, config=to_plain(settings, "config")), NoField()),
        TrainOptions(device=device_of(scene.field)),
        weights=field.state_dict(),
    )
    info = replace(info, step=info.step + grown.info.step, seconds=grown.info.seconds)
    info = replace(info, data=scene.name)  # for messages, until the map is complete
    return replace(scene, info=info, field=grown.field, folder=None, record=scene.capture)


def _present(landmarks: LandmarkMap, more: LandmarkMap) -> Bool[Tensor, "n"]:
    """Return a mask of the landmarks of ``more`` that match one of ``landmarks``.

    Two landmarks match if their distance is at most three times the sum of their standard deviations, and
    their descriptors are similar.
    """
    away, near = cKDTree(landmarks.positions.numpy()).query(more.positions.numpy(), k=min(4, len(landmarks)))
    distance = torch.from_numpy(np.asarray(away).reshape(len(more), -1))
    index = torch.from_numpy(np.asarray(near).reshape(len(more), -1))
    deviation = more.deviations.amax(-1)[:, None] + landmarks.deviations.amax(-1)[index]
    descriptors = landmarks.descriptors[index].float() - more.descriptors[:, None].float()
    # Descriptors of the same landmark differ by less than this fraction of the usual distance between descriptors of
    # different landmarks.
    alike = descriptors.norm(dim=-1) <= 0.42 * landmarks.unrelated_distance
    return ((distance <= 3 * deviation) & alike).any(-1)


def _names_like(name: str, taken: Container[str]) -> list[str]:
    """Return the names in ``taken`` that photos called ``name`` have: the name itself, then NAME_2, NAME_3 and so on."""
    derived = itertools.chain([name], (f"{name}_{n}" for n in itertools.count(2)))
    return list(itertools.takewhile(lambda each: each in taken, derived))
