"""``Map``: a radiance field together with the surface, landmarks and cameras used for localization."""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor, nn

from bidnerf_core.captures import (
    CaptureReport,
    UpDirection,
    poses_of,
    refinement_updates,
    stored_cameras,
    summary,
    survey_capture,
    tried_field,
    tried_landmarks,
    up_direction,
    up_from_gravity,
)
from bidnerf_core.datasets import AS_STORED, DatasetOptions
from bidnerf_core.errors import InputError, amount
from bidnerf_core.fields import (
    RadianceField,
    RenderedImage,
    SceneBounds,
    has_field,
    levels,
    render_image,
    trained_field,
)
from bidnerf_core.frames import View
from bidnerf_core.geometry import LengthUnit
from bidnerf_core.io import lock
from bidnerf_core.mapping import (
    BakeConfig,
    LandmarkMap,
    SurfaceMap,
    TrackedViews,
    bake,
    colour_noise,
    find_features,
    render_views,
    surface_of_points,
    track_views,
    update_scatter,
)
from bidnerf_core.maps.description import Anchor, LandmarkSource, MapInfo, cameras_of, load_info
from bidnerf_core.maps.scene import move_map_to, origin_of
from bidnerf_core.maps.store import (
    build_frozen_field,
    content_digest,
    load_state,
    map_folder,
    read_part,
    with_images,
    with_tracks_in,
    write_parts,
)
from bidnerf_core.maps.summary import MapSummary
from bidnerf_core.maps.views import ViewSource, views_again
from bidnerf_core.progress import Cancel, ProgressCallback, check_cancelled, counter, job_context, log
from bidnerf_core.settings import LARGEST_LENGTH
from bidnerf_core.training import TrainingState

USUAL_BAKE = BakeConfig()


@dataclass(frozen=True, eq=False)
class Map:
    """A map ready for use, with a frozen field (no parameter requires a gradient).

    A map loaded from a folder or trained into one keeps the folder's path, and baking stores new parts there.
    """

    info: MapInfo
    field: RadianceField
    surface: SurfaceMap | None = None  # None if not baked
    landmarks: LandmarkMap | None = None  # None if none were built
    folder: Path | None = None  # None for a map in memory
    record: CaptureReport | None = None  # capture record, for a map in memory; see ``capture``

    def __repr__(self) -> str:
        """A one-line description without tensors or cameras; ``describe`` gives the details."""
        info = self.info
        trained = f"{info.backend}, {amount(info.step, 'step')}{'' if info.complete else ' (not complete)'}"
        surfels = amount(0 if self.surface is None else len(self.surface.surfels), "surfel")
        landmarks = amount(0 if self.landmarks is None else len(self.landmarks), "landmark")
        return f"<Map {self.name}: {trained if self.has_field else 'no field'}, {surfels}, {landmarks}>"

    @property
    def has_field(self) -> bool:
        """Whether the map has a radiance field; a landmark-only map has none and localizes images with its landmarks."""
        return has_field(self.field)

    @property
    def bounds(self) -> SceneBounds:
        """The scene's box, range of distances and background."""
        return self.info.bounds

    @property
    def origin(self) -> tuple[float, float, float]:
        """The origin of the map's local coordinate frame, in world coordinates.

        Poses passed to the map and its localizers, and the poses they return, are in the world frame of the
        training data. Positions of the map's parts are relative to the origin, which is 0 unless the data lie
        far from the world's origin.
        """
        return self.info.origin

    @property
    def anchor(self) -> Anchor | None:
        """The map's geographic anchor, or None if its location on earth is unknown."""
        return self.info.anchor

    @property
    def has_distances(self) -> bool:
        """Whether the training images determine distances; False if all were taken from one position."""
        return self.info.distances

    @property
    def unit(self) -> LengthUnit:
        """The unit of all lengths: ``"metres"``, or ``"units"`` if the metric scale is unknown."""
        return self.info.unit

    @cached_property
    def up(self) -> UpDirection | None:
        """The up direction in the world frame, with its source; None without measured gravity and without cameras.

        The direction is taken from gravity if the capture measured it, and is otherwise estimated from planes
        of the surface and from the cameras.
        """
        if self.info.gravity_up is not None:
            return up_from_gravity(self.info.gravity_up)
        if not self.info.cameras:
            return None
        return up_direction(poses_of(self.info.cameras), None if self.surface is None else self.surface.surfels.normals)

    @property
    def colour_noise(self) -> float | None:
        """Root mean square error of the field's colours (in [0, 1]) on the map's training images; None if unknown."""
        return self.info.colour_noise

    @cached_property
    def capture(self) -> CaptureReport | None:
        """Capture record of the photos the landmarks were built from (loaded lazily); None if there is none.

        Raises ``InputError`` if its file is damaged.
        """
        if self.record is not None or self.folder is None:
            return self.record
        return read_part(self.folder, self.info, "capture")

    @cached_property
    def training(self) -> str:
        """Identifier of the training run: the weights file's name or, for a map in memory, a content digest."""
        return self.info.weights or f"memory-{content_digest(self.field, self.surface, self.landmarks)}"

    @property
    def name(self) -> str:
        """The name of the map in messages: its folder or, for a map in memory, its dataset."""
        return str(self.folder or self.info.data or "map in memory")

    def to(self, device: torch.device | str) -> Map:
        """Return the map with its field, surface and landmarks on ``device``; parts already on the device are not copied.

        Of all computations with landmarks, only the comparison of descriptors runs on ``device``, see
        ``LandmarkMap.to``. Raises ``InputError`` for a device that is not usable on this machine.
        """
        return move_map_to(self, device)

    def describe(self) -> MapSummary:
        """Return the facts about the map; ``str()`` gives a human-readable description."""
        return MapSummary.of(self)

    def scaled(self, factor: float, unit: LengthUnit = "metres") -> Map:
        """Return a map in memory with all lengths multiplied by ``factor``.

        The factor applies to the field, bounds, surface, landmarks, capture record and anchor. ``unit`` is the
        length unit of the result; ``scaled(1)`` declares that lengths already are metres. ``save`` stores the
        scaled map, and may overwrite the original. Raises ``InputError`` if ``factor`` is not positive or would
        make lengths too large or too small, and if the map's training is incomplete.
        """
        if isinstance(factor, bool) or not (isinstance(factor, int | float) and 0 < factor < math.inf):
            raise InputError(f"factor is {factor!r}", expected="a positive number")
        if self.info.interruption is not None:
            raise InputError(f"cannot be scaled: {self.info.interruption}", where=self.name)
        if self.unit == unit == "metres" and factor != 1:
            log.info(f"{self.name}: was in metres before; its lengths are multiplied by {factor:.6g} all the same")
        extent = max(map(abs, (*self.bounds.lower, *self.bounds.upper, self.bounds.far)))
        if not extent * factor <= LARGEST_LENGTH or not factor >= 1 / LARGEST_LENGTH:
            raise InputError(f"factor is {factor:g}, which makes the lengths of {self.name} too large or too small")
        whole, capture = self.whole(), self.capture
        info = whole.info.scaled(factor, unit)
        return Map(
            info,
            info.in_map_unit(trained_field(whole.field)),
            None if whole.surface is None else whole.surface.scaled(factor),
            None if whole.landmarks is None else whole.landmarks.scaled(factor),
            record=None if capture is None else capture.scaled(factor),
        )

    def render(self, view: View, level: int | None = None) -> RenderedImage:
        """Render colour (h, w, 3) in [0, 1] and depth (h, w), planar z in metres, with the camera and pose of ``view``.

        ``level`` is the level of detail, 0 being the coarsest; None selects the field itself. Raises
        ``InputError`` for a level that the field does not have, and if ``view`` is not a ``View``.
        """
        if not isinstance(view, View):
            raise InputError(
                f"view is a {type(view).__name__}", where=self.name, expected="a View(frame, T_world_camera)"
            )
        field = self.field
        if level is not None:
            offered = levels(field)
            if not 0 <= level < len(offered):
                raise InputError(f"`level` is {level}", where=self.name, expected=f"0 to {len(offered) - 1}")
            field = offered[level]
        T = view.T_ref_camera.translated(-origin_of(self))
        return render_image(field, view.frame.intrinsics, T, self.bounds, motion=view.motion)

    def bake(
        self,
        data: ViewSource | None = None,
        config: BakeConfig = USUAL_BAKE,
        *,
        images: DatasetOptions = AS_STORED,
        rendered_landmarks: bool = False,
        features: str | None = None,
        progress: ProgressCallback | None = None,
        cancel: Cancel | None = None,
    ) -> Map:
        """Bake a new surface and new landmarks, and return the map with them; a map with a folder stores them there.

        Views with measured depth replace rendered views for the surface; landmarks are built from all views of
        ``data`` (for a dataset or a path, those of ``images.split``). Without ``data``, landmarks built from
        photos are kept unless ``rendered_landmarks`` is set, and otherwise new landmarks are built from
        rendered images. ``features`` names a landmark detector other than the map's. Raises ``InputError`` if
        the data cannot be used or shows another scene, if nothing can be baked, and if another program is
        writing to the folder. Raises ``Cancelled`` once ``cancel`` returns True; the parts finished by then are
        kept.
        """
        if rendered_landmarks and data is not None:
            raise InputError("rendered_landmarks uses no photos, but data gives some;", expected="only one of them")
        scene = self
        if features is not None and features != self.info.landmark_features:
            find_features(features)
            if data is None and not rendered_landmarks and self.info.landmark_source == "photos":
                raise InputError(
                    f"its landmarks are from photos and detector {self.info.landmark_features!r}; for"
                    f" {features!r}, give the photos again (`data`) or use `rendered_landmarks`",
                    where=self.name,
                )
            scene = replace(self, info=replace(self.info, landmark_features=features))
        with (
            job_context(progress, cancel),
            contextlib.nullcontext() if self.folder is None else lock(self.folder),
        ):
            views = list[View]()
            if data is not None:
                _, views = views_again(self.info, data, images, folder=self.folder)
                own = {(camera.name, camera.T_world_camera) for camera in self.info.cameras}
                if own and not any((c.name, c.T_world_camera) in own for c in stored_cameras(views)):
                    # None of them was used to build the map: they may be of another scene.
                    self.check_alike(views, self.name)
            scene, tracked = scene.with_landmarks(views, rendered_landmarks)
            return scene.with_surface(views, config).with_survey(views, tracked)

    def check_alike(self, views: Sequence[View], where: str) -> None:
        """Raise ``InputError`` if photos differ too much from the field's renderings, whether or not the map was built from them."""
        # The difference (RMS) between rendered and photographed colours indicates another scene if it is much larger than for the
        # photos from which the map was built or, in a map that was never baked, if it is large in itself.
        error, usual = colour_noise(self.field, self.bounds, views), self.info.colour_noise
        if error > (0.3 if usual is None else max(0.2, 2 * usual)):
            raise InputError(
                f"built from {self.info.data or 'other views'!r}, and its renderings differ from the photos by"
                f" {error:.0%} of the range of colours;",
                where=where,
                expected="photos of the same scene, with poses in the coordinates of the map",
            )

    def with_landmarks(
        self, views: Sequence[View], rendered: bool = False, tracked: TrackedViews | None = None
    ) -> tuple[Map, TrackedViews | None]:
        """Return the map with new landmarks, and the tracked keypoints from which they were built.

        Landmarks are built from ``views`` or, without views, from rendered images, which require a field. If
        the images show too little texture, none are built. Without views, existing landmarks from photos are
        kept unless ``rendered`` is set, and no keypoints are returned for them. The caller must hold the
        folder's lock, as for ``with_parts``.
        """
        check_cancelled("landmarks")
        if not views and not rendered and self.info.landmark_source != "rendered images":
            photos = self.landmarks
            if photos is None and self.folder is not None:
                try:
                    photos = read_part(self.folder, self.info, "landmarks")
                except InputError as error:  # damaged, so that they are replaced
                    log.info(str(error))
            if photos is not None:
                log.info(f"{self.name}: its landmarks from photos are kept; `rendered_landmarks` replaces them")
                return replace(self, landmarks=photos), None
        started, info, landmarks = time.monotonic(), self.info, None
        source: LandmarkSource = "photos" if views else "rendered images"
        images = views or render_views(self.field, info.bounds, cameras_of(info))
        if not images:
            raise self._no_cameras()
        if tracked is None:
            tracked = track_views(images, info.landmark_features)
        if views and not info.distances:
            tracked = tracked.at_distance(info.bounds.side / 2)  # the directions are still informative
        counter("trying the landmarks on images", "stage")(0, 1)
        try:
            landmarks = tried_landmarks(tracked, images, report=log.info)
        except InputError as error:
            log.info(f"{self.name}: no landmarks: {error}")
        else:
            # Poses found in the map are compared with poses from the source of the training poses. If training
            # kept most of these, few poses have an update and their errors count as negligible.
            by_source = update_scatter(refinement_updates(info.cameras))
            if by_source is not None:
                landmarks = replace(landmarks, pose_covariance=landmarks.pose_covariance + by_source)
            if views:
                landmarks = with_tracks_in(info, landmarks, [view.frame.name for view in views])
            else:
                landmarks = replace(landmarks, tracks=None)  # in rendered images, which are not stored
            info = replace(info, landmark_source=source, landmark_features=landmarks.features)
            log.info(
                f"{self.name}: {len(landmarks)} landmarks ({landmarks.megabytes:.1f} MB) from {len(images)} {source},"
                f" {time.monotonic() - started:.1f} s"
            )
        return replace(self, info=info).with_parts(None, landmarks), tracked

    def with_surface(
        self,
        views: Sequence[View],
        config: BakeConfig,
        scan: tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"]] | None = None,
    ) -> Map:
        """Return the map with a new surface.

        It is baked from the points of a ``scan`` (metres, world) and their colours, if given, otherwise from the
        measured depth of the views, or else from depth rendered by the field at the map's cameras or, if it has none,
        at those of the views. Raises ``InputError`` if there are no cameras at all, and if the images do not agree on
        a surface.
        """
        counter("baking the surface", "stage")(0, 1)
        started = time.monotonic()
        cameras = cameras_of(self.info) or [(view.frame.intrinsics, view.T_ref_camera) for view in views]
        if scan is not None:
            surface, source = surface_of_points(*scan, self.bounds, cameras, config), "its own points"
        elif not cameras:
            raise self._no_cameras()
        else:
            # A few points do not make a surface.
            is_dense = any(view.frame.has_dense_depth for view in views)
            measured = [view for view in views if is_dense and view.frame.has_depth]
            surface = bake(self.field, self.bounds, [] if measured else cameras, measured, config)
            source = f"{len(measured)} measured views" if measured else f"{len(cameras)} rendered views"
        log.info(
            f"{self.name}: surface of {len(surface.surfels)} surfels from {source}, {time.monotonic() - started:.1f} s"
        )
        return self.with_parts(surface)

    def _no_cameras(self) -> InputError:
        return InputError("holds no cameras to render from; give a dataset of its views (`data`)", where=self.name)

    def with_survey(self, views: Sequence[View], tracked: TrackedViews | None) -> Map:
        """Return the map with the capture record of the photos ``views`` and the field's colour error on them.

        ``tracked`` holds the keypoints of the photos. If it is None, they are tracked unless the map has a capture record.
        Without photos, the map is returned unchanged.
        """
        if not views or (tracked is None and self.info.capture is not None):
            return self
        check_cancelled("survey")
        if tracked is None:
            tracked = track_views(views, self.info.landmark_features)
        scene = replace(
            self,
            info=replace(
                self.info, colour_noise=colour_noise(self.field, self.bounds, views) if self.has_field else None
            ),
        )
        counter("surveying the photos", "stage")(0, 1)
        landmarks = self.landmarks
        if landmarks is not None:
            landmarks = replace(landmarks, trial=tried_field(scene, views, landmarks.trial))
        capture = survey_capture(tracked, views, trial=None if landmarks is None else landmarks.trial, up=self.up)
        for line in summary(capture, self.unit):
            log.info(line)
        return scene.with_parts(None, landmarks, capture)

    def with_parts(
        self,
        surface: SurfaceMap | None = None,
        landmarks: LandmarkMap | None = None,
        record: CaptureReport | None = None,
    ) -> Map:
        """Return the map with the given parts replaced, also in its folder; the caller must hold the folder's lock."""
        info = self.info
        if landmarks is not None:
            landmarks = with_images(landmarks, info)
        if self.folder is not None and any(part is not None for part in (surface, landmarks, record)):
            info = write_parts(self.folder, info, None, surface, landmarks, record)
        return replace(
            self,
            info=info,
            surface=surface or self.surface,
            landmarks=self.landmarks if landmarks is None else landmarks,
            record=record or self.record,
        )

    def save(self, folder: str | Path, overwrite: bool = False) -> Map:
        """Write the complete map to a folder, and return the map with that folder set.

        Baked parts that were not loaded (``load_map`` with ``baked=False``) are written and returned as well.
        Raises ``InputError`` if the folder cannot be written, if it is not empty and ``overwrite`` is not set,
        and if the field does not come from a backend.
        """
        with map_folder(Path(folder), overwrite):
            return self.write_to(Path(folder))

    def write_to(self, folder: Path) -> Map:
        """Write the complete map to a folder as ``save`` does; the caller must hold the folder's lock."""
        field = trained_field(self.field)
        if not isinstance(field, nn.Module):
            raise InputError(
                f"the map's field is a {type(field).__name__}",
                where=folder,
                expected="an nn.Module of a backend",
            )
        state = (
            TrainingState(self.info.step, field.state_dict(), {})
            if self.info.training is None or self.folder is None
            else load_state(self.folder, self.info, self.field)
        )
        whole = self.whole()
        here = whole.to("cpu")
        info = write_parts(folder, whole.info, state, here.surface, here.landmarks, self.capture)
        return replace(whole, info=info, folder=folder, record=self.capture)

    def whole(self) -> Map:
        """Return the map with all parts of its folder, including those not loaded and an anchor added later."""
        if self.folder is None:
            return self
        folder, info = self.folder, self.info
        return replace(
            self,
            info=replace(info, anchor=load_info(folder).anchor if info.anchor is None else info.anchor),
            surface=read_part(folder, info, "surface") if self.surface is None else self.surface,
            landmarks=read_part(folder, info, "landmarks") if self.landmarks is None else self.landmarks,
        )


def load_map(folder: str | Path, device: torch.device | str = "cpu", baked: bool = True) -> Map:
    """Load the map in ``folder`` onto ``device``, with its field built by the map's backend and frozen.

    ``baked`` is whether to load the surface and landmarks. The parts match each other even while a training run is
    replacing the map. Raises ``InputError`` if the folder does not hold a map, or the map is damaged.
    """
    folder = Path(folder)
    info = load_info(folder)
    # A training run may replace the map between the reading of its description and of its parts. Checkpoints are seconds
    # apart, so each further failure requires a disk slower than that.
    for _ in range(5):
        try:
            weights = read_part(folder, info, "weights") or {}
            surface, landmarks = (read_part(folder, info, part) if baked else None for part in ("surface", "landmarks"))
            break
        except InputError as error:
            before, info = info, load_info(folder)
            if replace(before, bidnerf="") == replace(info, bidnerf=""):
                raise
            latest = error
    else:
        raise InputError("is being replaced faster than it can be read; try again later", where=folder) from latest
    if info.interruption is not None:
        log.info(f"{folder}: {info.interruption}")
    return Map(info, build_frozen_field(info, weights, folder), surface, landmarks, folder).to(device)
