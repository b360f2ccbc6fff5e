"""``localize``: the poses of photos, frames or a dataset in a map or among several, collected as answers."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bidnerf.results.answers import Answer, Answers, Failure
from bidnerf.results.matches import agreeing_matches
from bidnerf_core.camera import CameraSource
from bidnerf_core.datasets import (
    DatasetFrames,
    DatasetOptions,
    Photos,
    Query,
    QuerySource,
    find_reader,
    open_dataset,
    photo_files,
)
from bidnerf_core.depth import UNKNOWN_SENSOR, describe_depth_noise
from bidnerf_core.errors import InputError, UsageError
from bidnerf_core.frames import Frame, View
from bidnerf_core.geometry import SE3
from bidnerf_core.io import looks_like_image
from bidnerf_core.localization import Outcome, SceneMap, record_search
from bidnerf_core.maps import Localizer, MapCollection, PixelArray, frame_of_pixels, origin_of
from bidnerf_core.progress import Cancel, ProgressCallback, counter, job_context, log


def localize(
    scene: SceneMap | Localizer | MapCollection | str | Path,
    queries: QuerySource
    | str
    | Path
    | Frame
    | PixelArray
    | Sequence[str | Path | Frame | PixelArray | View | Sequence[View]],
    *,
    start: Callable[[Query], SE3 | None] | None = None,
    seed: int = 0,
    answers: Answers | None = None,
    each: Callable[[Query, Answer | Failure], None] | None = None,
    progress: ProgressCallback | None = None,
    cancel: Cancel | None = None,
) -> Answers:
    """Localize each query in a map or, among several maps, in the one that the query shows.

    ``scene`` is a map, its folder, a localizer with its own settings, or a collection of maps. ``queries`` are photos: files, folders, or
    frames or pixels in memory, views or rigs of views; or a dataset, whose test images are localized; or what yields them, a ``QuerySource``.

    A query that cannot be read or localized does not stop the others, but if it is the only query, its error is
    raised. ``start`` returns the initial T_world_camera of a query; method ``auto`` needs none, and with
    several maps ``start`` is not used. ``answers`` is the object that collects the answers, by default a new
    one; if an error ends the run, it holds the answers so far. ``each`` is called with each query and its
    answer; for a failure, the query has only a name. Raises ``InputError``, and ``Cancelled`` once ``cancel``
    returns True.
    """
    localizer = scene if isinstance(scene, Localizer | MapCollection) else Localizer(scene)
    if not isinstance(queries, QuerySource):
        queries = _queries(localizer, queries)
    if answers is None:
        answers = Answers(localizer if isinstance(localizer, MapCollection) else localizer.scene)
    with job_context(progress, cancel):
        count, total = counter("localizing", "images"), len(queries.names)
        count(0, total)
        for number, name in enumerate(queries.names):
            answer: Answer | Failure
            query, placement, matches = Query(name, ()), None, None
            try:
                query = queries.read(number)
                truth = query.truth
                if isinstance(localizer, MapCollection):
                    if len(query.views) != 1:
                        raise InputError("is a rig", where=name, expected="single images for several maps")
                    placement = localizer(query.views[0].frame, seed)
                    localization, truth = placement.found, None
                else:
                    if number == 0:
                        _log_depth(query, getattr(localizer.config, "depth_sensor", UNKNOWN_SENSOR))
                    begin = None if start is None else start(query)
                    with record_search() as record:
                        localization = localizer(query.views, begin, seed=seed)
                    local = localization.translated(-origin_of(localizer.scene))
                    matches = agreeing_matches(local, record, query.frame.intrinsics)
                frame = query.frame.replace(name=query.name)
                answer = Answer.of(
                    frame, number, localization, truth=truth, file=query.file, placement=placement, matches=matches
                )
                no_pose = not localization.T_world_camera.is_finite  # a refused answer may be without one
                if no_pose and localization.outcome in (Outcome.CONVERGED, Outcome.DIVERGED):
                    raise InputError(
                        f"{localization.method} diverged to a pose that is not finite; is the map valid?", where=name
                    )
            except UsageError:
                raise
            except InputError as error:
                if total == 1:
                    raise
                answer = Failure(name, localizer.method, str(error))
            answers.append(answer)
            if each is not None:
                each(query, answer)
            count(number + 1, total)
    return answers


def _queries(localizer: Localizer | MapCollection, given: Any) -> QuerySource:
    """Return photos, frames and a dataset as queries. Raises ``InputError`` for anything else."""
    is_one = isinstance(given, str | Path | Frame | PixelArray | View) or not isinstance(given, Iterable)
    assumed, background = (
        (localizer.cameras, None)
        if isinstance(localizer, MapCollection)
        else (localizer.assumed_cameras, localizer.scene.bounds.background)
    )
    listed = [frame_of_pixels(each, assumed) for each in ([given] if is_one else given)]
    paths = [Path(each) for each in listed if isinstance(each, str | Path)]
    if listed and len(paths) == len(listed):
        if len(paths) == 1 and not looks_like_image(paths[0]) and find_reader(paths[0]) is not None:
            return DatasetFrames(open_dataset(paths[0], background))
        options = DatasetOptions(CameraSource(assumed=tuple(assumed)), background=background)
        return Photos(photo_files(paths), options)
    rigs = list[tuple[View, ...]]()
    for each in listed:
        rig = [View(each, SE3.identity())] if isinstance(each, Frame) else [each] if isinstance(each, View) else each
        if not isinstance(rig, list | tuple) or not rig or not all(isinstance(view, View) for view in rig):
            raise InputError(
                f"got a {type(each).__name__}",
                where="queries",
                expected="photos or a dataset by path, or pixels, a Frame, View or list of Views for each",
            )
        rigs.append(tuple(rig))
    return _Rigs(rigs)


@dataclass(frozen=True)
class _Rigs:
    """Frames in memory, alone or as rigs with known relative poses, as queries."""

    rigs: Sequence[Sequence[View]]

    @property
    def names(self) -> Sequence[str]:
        return [rig[-1].frame.name or str(number) for number, rig in enumerate(self.rigs)]

    def read(self, index: int) -> Query:
        """Return the query with this index."""
        return Query(self.names[index], tuple(self.rigs[index]))


def _log_depth(query: Query, sensor: str) -> None:
    """Log if the images of a dataset have no measured depth, or if the depth noise does not match the sensor."""
    bare = [view.frame.name for view in query.views if not view.frame.has_depth]
    if bare and query.truth is not None:
        log.info("%s: no measured depth; colour only", ", ".join(bare))
    depth = query.frame.depth if query.frame.has_depth and sensor != UNKNOWN_SENSOR else None
    remark = None if depth is None else describe_depth_noise(depth, query.frame.intrinsics, sensor)
    if remark is not None:
        log.info("%s: %s", query.name, remark)
