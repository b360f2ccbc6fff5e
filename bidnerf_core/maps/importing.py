"""Importing maps from fields trained elsewhere, from meshes and the like, and from COLMAP models."""

from __future__ import annotations

import contextlib
import inspect
import math
import os
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.camera import Intrinsics
from bidnerf_core.captures import MatrixRows, StoredCamera, horizontal_axes, stored_cameras
from bidnerf_core.datasets import open_dataset
from bidnerf_core.devices import working_device
from bidnerf_core.errors import InputError, InputWarning, amount
from bidnerf_core.fields import NoField, RadianceField, Rays, SceneBounds, device_of, render
from bidnerf_core.frames import BLACK, Frame, View, draw, uniform
from bidnerf_core.geometry import SE3, LengthUnit, Similarity, look_at, sphere
from bidnerf_core.io import to_plain
from bidnerf_core.mapping import (
    BakeConfig,
    ImageKeypoints,
    Keypoints,
    TrackedKeypoints,
    TrackedViews,
    detect,
    find_features,
    matches_of_points,
    track_views,
)
from bidnerf_core.maps.description import MapInfo
from bidnerf_core.maps.importers import ImportedField, Structure, bounds_about, importer_of, robust_box
from bidnerf_core.maps.map import Map
from bidnerf_core.maps.store import build_frozen_field, map_folder
from bidnerf_core.maps.training import MapOptions, bake_if_possible, bake_settings, settings_from
from bidnerf_core.maps.views import USEFUL_SIDE, Origin, ReadViews, ViewSource, choose_origin, read_views
from bidnerf_core.progress import Cancel, ProgressCallback, job_context, log
from bidnerf_core.settings import Above

RENDERED_CAMERA = Intrinsics.from_hfov(70.0, 192, 192)
VIEWS = 48
"""Number of cameras placed around an object, and largest number of cameras placed inside a room."""
VIEW_DIRECTIONS = 48
"""Number of rays from each candidate position, spread evenly over the sphere."""


@dataclass(frozen=True)
class ImportOptions(MapOptions):
    """How the coordinates of a file are taken to the world, and by which importer."""

    importer: str | None = None
    """name of an installed importer, by default the one that recognizes the file"""

    scale: Annotated[float, Above(0)] = 1.0
    """factor of all lengths: metres per unit of the file"""

    T_world_file: SE3 | None = None
    """transforms the scaled coordinates of the file to the world"""


AS_IN_THE_FILE = ImportOptions()


def import_map(
    path: str | Path,
    out: str | Path | None = None,
    config: Any = None,
    *,
    photos: ViewSource | None = None,
    bake: bool | BakeConfig = True,
    options: ImportOptions = AS_IN_THE_FILE,
    progress: ProgressCallback | None = None,
    cancel: Cancel | None = None,
) -> Map:
    """Build a map from a field in a file: splats, a checkpoint, or any other format that an installed importer reads.

    A COLMAP model yields a map without a field, whose landmarks come from the model's points and tracks;
    ``train`` adds a field.

    ``config`` holds settings of the importer: an object of its ``config_type``, or a dict of those that differ
    from the defaults. Lengths are multiplied by ``options.scale``, and ``options.T_world_file`` then transforms
    the file's coordinates to the world. If that places the scene far from the world's origin, as with survey
    coordinates, the map gets a local origin, see ``Map.origin``. ``photos`` are images with poses in the world
    (a dataset, the path to one, or views), of which ``options.images`` selects a part; landmarks are built from
    them. Without photos, landmarks are built from rendered images, which match photos less well. The map is
    stored in folder ``out``, or only in memory if that is None.

    Raises ``InputError`` if the file, the photos, the settings or the folder cannot be used, and if the photos
    do not show the scene of the field; the folder must be empty unless ``options.overwrite`` is set.
    """
    path, scale = Path(path), options.scale
    name, chosen = importer_of(path, options.importer)
    settings, baking = settings_from(config, chosen.config_type, f"importer {name!r}"), bake_settings(bake)
    T = SE3.identity() if options.T_world_file is None else options.T_world_file
    origin = choose_origin(T.translation[None])
    if any(origin):
        T = T.translated(-torch.tensor(origin, dtype=torch.float64))
    folder, device, where = None if out is None else Path(out), working_device(options.device), str(path)
    options.images.require_files()
    images_at, of_images = options.images.image_folder, dict[str, Any]()
    if "image_folder" in inspect.signature(chosen.read).parameters:
        of_images["image_folder"] = images_at
    elif images_at is not None and photos is None:
        raise InputError(
            "`images` names a folder, but no dataset that lists its images;", where=where, expected="`photos`"
        )
    with (
        job_context(progress, cancel),
        contextlib.nullcontext() if folder is None else map_folder(folder, options.overwrite),
    ):
        found = chosen.read(path, settings, Similarity(scale, T), **of_images)
        for line in found.found:
            log.info(f"{where}: {line}")
        if found.structure is not None:
            if photos is not None:
                raise InputError("is a model with photos of its own; leave out the photos", where=where)
            scene = _of_structure(found, found.structure, options, baking is not None)
            return scene if folder is None else scene.write_to(folder)
        images = photos
        if images is None and found.photos is not None:
            try:
                images = open_dataset(found.photos)
                log.info(f"{where}: training photos found in {found.photos}")
            except InputError as error:
                log.info(f"{where}: its training images cannot be read: {error}")
        read = None if images is None else read_views(images, options.images).about(origin)
        views: list[View] = [] if read is None else read.views
        unit: LengthUnit = "metres" if scale != 1 else "units" if read is None else read.unit
        _report_extent(found, where, unit)
        bounds = found.bounds
        if read is not None and read.source and any(view.frame.alpha is not None for view in views):
            bounds = replace(bounds, background=read.background)  # over which its images were composited
        info = MapInfo(
            found.backend,
            to_plain(found.config, "config"),
            bounds,
            max(1, found.steps),  # 0 would mean a map without a field
            True,
            path.name,
            landmark_features=options.features,
            unit=unit,
            origin=origin,
            gravity_up=None if read is None else read.gravity_up,
        )
        scene = Map(info, build_frozen_field(info, found.tensors, None)).to(device)
        cameras = found.cameras if read is None else read.with_files(stored_cameras(views))
        if read is None and cameras:
            log.info(f"{where}: {amount(len(cameras), 'camera')} of its training images found next to it")
        elif read is None:
            cameras = viewpoints(scene.field, bounds, found.up, found.is_solid)
            log.info(
                f"{where}: no photos; viewed from {amount(len(cameras), 'viewpoint')}"
                f" {'around it' if found.is_solid else 'found in free space'}"
                f"{'' if baking is None else '; rendering and baking take a minute or more on a CPU'}"
            )
        scene = replace(scene, info=replace(info, cameras=cameras))
        if views:
            scene.check_alike(views, where)
            ratio = ratio_to_measured_depth(scene.field, scene.bounds, views)
            if ratio is not None and abs(ratio - 1) > 0.03:  # less is not worth reporting
                warnings.warn(
                    f"{where}: the photos' measured depth is {ratio:.3g} times the field's; is its scale different? The"
                    " poses of the photos would have to be scaled as well",
                    InputWarning,
                    stacklevel=2,
                )
        if baking is not None:
            tracked = None
            if views or found.is_coloured:
                if not views:
                    log.info(
                        f"{path.name}: landmarks are from rendered images, which match photos less well; `photos` builds"
                        " them from photos, as in training"
                    )
                scene, tracked = scene.with_landmarks(views, not views)
            scene = bake_if_possible(scene, views, baking, found.surface).with_survey(views, tracked)
        # Written once all of it is there: a map that lacks its landmarks would pass for a complete one.
        return scene if folder is None else scene.write_to(folder)


def _of_structure(found: ImportedField, structure: Structure, options: ImportOptions, bake: bool) -> Map:
    """Build a landmark-only map from posed images and the points that they observe."""
    capture, features = structure.capture, options.features
    origin = choose_origin(
        SE3.stack([shot.T_world_camera for shot in capture.shots if shot.T_world_camera]).translation
    )
    offset = -torch.tensor(origin, dtype=torch.float64)
    unit: LengthUnit = "metres" if options.scale != 1 else "units"
    tracked = None
    if structure.keypoints and options.images.masks is not None:
        raise InputError(
            "masks do not apply to stored keypoints",
            where=capture.path,
            expected="none, or the keypoints of photos (`keypoints` 'photos')",
        )
    if structure.keypoints:
        read, tracked = _stored_views(structure, features, origin)
    else:
        masks = options.images.mask_folder
        capture = capture if masks is None else capture.with_masks(masks)
        read = read_views(capture, replace(options.images, split="all")).about(origin)
    bounds = bounds_about(structure.positions[structure.positions.isfinite().all(-1)] + offset)
    _report_extent(found, str(capture.path), unit)
    info = MapInfo(
        "",
        {},
        bounds,
        0,
        True,
        capture.path.name,
        cameras=read.with_files(stored_cameras(read.views)),
        landmark_features=features,
        unit=unit,
        origin=origin,
    )
    scene = Map(info, NoField()).to(working_device(options.device))
    if not bake:
        return scene
    if tracked is None:
        points = [of_image[of_image >= 0].unique() for of_image in structure.observed]
        positions = structure.positions + offset
        tracked = track_views(read.views, features, known=lambda images: matches_of_points(images, points, positions))
    scene, _ = scene.with_landmarks(read.views, tracked=tracked)
    if scene.landmarks is None:
        raise InputError("its images give no landmarks", where=capture.path)
    # The quality of photos cannot be surveyed from keypoints alone.
    return scene if structure.keypoints else scene.with_survey(read.views, tracked)


def _stored_views(structure: Structure, features: str, origin: Origin) -> tuple[ReadViews, TrackedViews]:
    """Return the images of a structure as blank views, and their stored keypoints grouped into tracks.

    Keypoints that observe the same point form a track. Positions are relative to ``origin``.

    Raises ``InputError`` if the descriptors are not those of the detector ``features``.
    """
    capture, offset = structure.capture, -torch.tensor(origin, dtype=torch.float64)
    probe = detect(find_features(features), torch.rand(64, 64, 3, generator=torch.Generator().manual_seed(0)))
    channels = structure.keypoints[0].descriptors.shape[1]
    if probe.descriptors.shape[1] != channels:
        raise InputError(
            f"its descriptors have {channels} channels, those of {features!r} {probe.descriptors.shape[1]}",
            where=capture.path,
            expected="the detector that made them (`landmark_features`)",
        )
    views, images, labels = list[View](), list[ImageKeypoints](), list[Tensor]()
    for shot, keypoints, observed in zip(capture.shots, structure.keypoints, structure.observed, strict=True):
        stored, T = shot.camera, shot.T_world_camera
        assert isinstance(stored, Intrinsics)  # ensured by the importer
        assert T is not None
        camera, T = stored.at_most(USEFUL_SIDE), T.translated(offset)
        order = (observed < 0).long().argsort(stable=True)
        # At most as many keypoints are used as SIFT finds in a query, or all that observe a point if these
        # are more.
        order = order[: max(int((observed >= 0).sum()), 2000)]
        size = torch.tensor([camera.width, camera.height])
        scale = size / torch.tensor([stored.width, stored.height])
        chosen = Keypoints(
            (keypoints.pixels[order] * scale).clamp(torch.zeros(2), size),
            keypoints.sizes[order] * scale.mean(),
            keypoints.descriptors[order],
        )
        labels.append(observed[order])
        blank = torch.zeros((1, 1, 3), dtype=torch.uint8).expand(camera.height, camera.width, 3)
        views.append(View(Frame(shot.name, blank, camera), T))
        rays, depth = camera.unproject(chosen.pixels.double()), torch.zeros(len(order), dtype=torch.float64)
        images.append(ImageKeypoints(chosen, rays, depth, camera, T))
    files = {shot.name: os.path.relpath(shot.file, capture.path) for shot in capture.shots if shot.file}
    read = ReadViews(views, capture.path.name, str(capture.path), BLACK, files=files)
    label, points = torch.cat(labels), structure.positions + offset
    # A keypoint that observes no point forms a track by itself.
    label = torch.where(label >= 0, label, len(points) + torch.arange(len(label)))
    return read, TrackedViews(TrackedKeypoints(images, label, torch.arange(len(label))), features, points)


def _report_extent(found: ImportedField, where: str, unit: LengthUnit) -> None:
    """Log the extent of the scene, and warn if its lengths are unlikely to be in metres."""
    size: Sequence[float] = found.bounds.size
    if found.points is not None and len(found.points):
        lower, upper = robust_box(found.points, margin=0.0)
        size = (upper - lower).tolist()
    extent = " x ".join(f"{side:.3g}" for side in size)
    unknown = "; its unit is not stored (`scale` gives its length in metres)"
    log.info(f"{where}: extent {extent}{' metres' if unit == 'metres' else unknown}")
    # The longest side of a plausible scene is between 5 cm and 500 m; other lengths are probably in another unit.
    if not 0.05 <= max(size) <= 500:
        doubt = (
            "very large in metres; are its lengths millimetres?"
            if max(size) > 500
            else "tiny in metres; are its lengths kilometres or an arbitrary unit?"
        )
        warnings.warn(f"{where}: {extent} would be {doubt} `scale` changes them", InputWarning, stacklevel=3)


@torch.no_grad()
def ratio_to_measured_depth(field: RadianceField, bounds: SceneBounds, views: Sequence[View]) -> float | None:
    """Return the median ratio of measured to rendered depth, or None if too few rays have both."""
    measured = [view for view in views if view.frame.has_depth]
    if not measured:
        return None
    generator = torch.Generator().manual_seed(0)
    pixels = draw(measured, max(4096, len(measured)), uniform, generator, device=device_of(field)).flattened()
    seen = render(field, bounds.rays(pixels.origins, pixels.directions), bounds.background)
    both = (pixels.distance > 0) & (seen.opacity > 0.5)  # the depth of a less opaque ray is meaningless
    if int(both.sum()) < 200:
        return None
    return float((pixels.distance[both] * seen.opacity[both] / seen.distance[both]).median())


def viewpoints(
    field: RadianceField,
    bounds: SceneBounds,
    up: tuple[float, float, float] = (0.0, 0.0, 1.0),
    is_solid: bool = False,
) -> tuple[StoredCamera, ...]:
    """Return cameras that see the geometry of a field, placed all around an object or in free space within a room.

    ``up`` is the up direction in the images. The inside of an ``is_solid`` object does not count as free space,
    although rays hit nothing there. The result is deterministic.
    """
    places = torch.tensor(bounds.lower) + torch.tensor(bounds.size) * torch.rand(
        (400, 3), generator=torch.Generator().manual_seed(0)
    )
    distance = _distances(field, bounds, places)
    hit = distance > 0
    nearest = torch.where(hit, distance, torch.inf).quantile(0.1, dim=1)  # exceeded by nine out of ten rays
    # Closer to matter than this, little is visible; a place is inside a room or the like if most rays from it hit matter.
    free = (nearest > 0.04 * bounds.side) & (hit.float().mean(1) > 0.6)
    # An object with hollows (Lego: 0.09) has some such places, and a room (0.5) has many; only a room is viewed
    # from inside.
    if not is_solid and float(free.float().mean()) > 0.2:
        poses = _within(places[free], distance[free], up)
    else:  # from all around the box, at a distance from which it fills the images
        centre = torch.tensor(bounds.centre, dtype=torch.float64)
        radius = (
            0.8
            * math.dist(bounds.lower, bounds.upper)
            * math.hypot(RENDERED_CAMERA.fx, RENDERED_CAMERA.cx)
            / RENDERED_CAMERA.width
        )
        poses = [look_at(centre + radius * direction, centre, up) for direction in sphere(VIEWS)]
    rows: list[MatrixRows] = [(*((a, b, c, d) for a, b, c, d in pose.matrix().tolist()),) for pose in poses]
    return tuple(StoredCamera(f"viewpoint-{n:03d}", RENDERED_CAMERA, row) for n, row in enumerate(rows))


@torch.no_grad()
def _distances(field: RadianceField, bounds: SceneBounds, places: Float[Tensor, "p 3"]) -> Float[Tensor, "p d"]:
    """Return the distance at which each ray from ``places``, in evenly spread directions, hits geometry; 0 without a hit."""
    device = device_of(field)
    origins = places[:, None].expand(-1, VIEW_DIRECTIONS, 3).reshape(-1, 3).to(device)
    towards = sphere(VIEW_DIRECTIONS).float().expand(len(places), -1, -1).reshape(-1, 3).to(device)
    near = torch.full_like(origins[:, 0], bounds.near)
    seen = render(field, Rays(origins, towards, near, torch.full_like(near, bounds.far)), bounds.background)
    # A ray of less opacity hits nothing solid.
    found = torch.where(seen.opacity > 0.8, seen.distance / seen.opacity.clamp(min=0.8), 0)
    return found.cpu().reshape(len(places), -1)


def _within(places: Float[Tensor, "p 3"], distance: Float[Tensor, "p d"], up: tuple[float, float, float]) -> list[SE3]:
    """Return poses at free positions far from each other, facing the directions with the most distant geometry."""
    directions, vertical = sphere(VIEW_DIRECTIONS), torch.tensor(up, dtype=torch.float64)
    level = (directions @ vertical).abs() < 0.75  # neither the ceiling nor the floor
    second, first = horizontal_axes(vertical)
    a, b = directions @ first, -directions @ second
    sectors = a > b.abs(), b >= a.abs(), -a > b.abs(), -b >= a.abs()
    poses = []
    # Farthest-point sampling, which begins near the middle of the positions
    number = int((places - places.mean(0)).norm(dim=-1).argmin())
    away = torch.full_like(places[:, 0], torch.inf)
    for _ in range(min(VIEWS // 4, len(places))):
        eye = places[number]
        # In each of four sectors about the vertical, the direction with the farthest matter, which shows the
        # most.
        for sector in sectors:
            allowed = sector & level & (distance[number] > 0)
            if bool(allowed.any()):
                ray = int(torch.where(allowed, distance[number], -1).argmax())
                poses.append(look_at(eye.double(), eye.double() + directions[ray], up))
        away = torch.minimum(away, (places - eye).norm(dim=-1))
        number = int(away.argmax())
    return poses
