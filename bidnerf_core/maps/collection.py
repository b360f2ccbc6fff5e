"""Localization in several maps: finding the map that an image shows, and the pose of the image in that map."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, TypeVar

import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from bidnerf_core.camera import Intrinsics
from bidnerf_core.datasets import unique_names
from bidnerf_core.errors import InputError, UsageError, amount
from bidnerf_core.frames import Frame
from bidnerf_core.geometry import SE3
from bidnerf_core.localization import USUAL_METHOD, VOTERS, Localization, Outcome, Verdict, localize_by_landmarks
from bidnerf_core.mapping import CachedFeatures, DescriptorCells, InvertedFile, LandmarkMap, detect, find_features
from bidnerf_core.maps.description import load_info
from bidnerf_core.maps.description_file import maps_in
from bidnerf_core.maps.localizer import Localizer
from bidnerf_core.maps.map import Map, load_map
from bidnerf_core.maps.scene import origin_of, unit_of
from bidnerf_core.maps.store import read_part
from bidnerf_core.progress import Cancel, ProgressCallback, job_context, log, report_each

_Scene = TypeVar("_Scene", bound=Map | str | Path)

CANDIDATES = 16
"""Number of landmarks that a keypoint that votes for maps compares."""
CLEAR = 0.9
"""Largest ratio of the distance to a landmark that a keypoint recognises and that to the last of its candidates."""
RIVAL, CERTAIN = 0.3, 0.05
"""Share of the votes of the best map with which another map may be the one that an image shows, and share of all votes below which any
may be."""


@dataclass(frozen=True, eq=False)
class Placement:
    """The map that an image shows, the pose of the image in that map, and the runner-up."""

    map: str  # the map of the best answer, even if that was refused
    found: Localization
    runner_up: tuple[str, Localization] | None  # the second best answer; None if only one map was tried
    # all maps, most similar first: the share of the voting keypoints that recognise landmarks of it, -1 if a map has none
    ranking: Mapping[str, float]
    tried: tuple[str, ...]  # maps in which the image was localized, in order
    backend: str  # backend of the map's field

    @property
    def converged(self) -> bool:
        """Whether the image was localized in a map."""
        return self.found.converged

    def plain(self) -> dict[str, Any]:
        """Return the map, its similarity and the runner-up as JSON values."""
        runner_up, similarity = None, {name: round(share, 4) for name, share in self.ranking.items()}
        if self.runner_up is not None:
            name, other = self.runner_up
            runner_up = {
                "map": name,
                "outcome": str(other.outcome),
                "converged": other.converged,
                "similarity": similarity[name],
            }
        return {"map": self.map, "similarity": similarity[self.map], "runner_up": runner_up}


@dataclass(frozen=True, eq=False)
class Ballot:
    """An index of the landmarks of several maps, by which the keypoints of an image vote for the maps that it may show."""

    owner: Int[Tensor, "n"]  # number of each landmark's map
    index: InvertedFile

    @staticmethod
    def of(descriptors: Sequence[UInt8[Tensor, "n d"]]) -> Ballot:
        """Index the descriptors of each map's landmarks."""
        joined = torch.cat([*descriptors])
        owner = torch.arange(len(descriptors)).repeat_interleave(torch.tensor([*map(len, descriptors)]))
        return Ballot(owner, InvertedFile(joined, DescriptorCells.of(joined)))

    def shares(self, descriptors: UInt8[Tensor, "q d"], maps: int) -> Float[Tensor, "m"]:
        """Return the share of some ``descriptors`` that vote for each of ``maps``.

        A keypoint votes for all maps with a landmark about as similar to it as the nearest one, unless all of its candidates are: what
        looks alike in many maps tells none from another, but two maps of one place are both right.
        """
        voters = torch.linspace(0, len(descriptors) - 1, min(len(descriptors), VOTERS)).long()
        distance, landmark = self.index.nearest(descriptors[voters], min(CANDIDATES, len(self.owner)), cells=4)
        alike = distance * CLEAR**2 <= distance[:, :1]
        alike &= ~alike[:, -1:]
        votes = torch.zeros((len(voters), maps), dtype=torch.bool)
        row, column = alike.nonzero().unbind(-1)
        votes[row, self.owner[landmark[row, column]]] = True
        return votes.double().mean(0)


class MapCollection:
    """Finds the map that an image shows, and the pose of the image in that map.

    The keypoints of an image vote for the maps whose landmarks they recognise. The image is localized in the map with the most votes,
    and in others only if these have nearly as many, or if none has many. Maps without landmarks cannot be ranked; all of them are
    tried last. Recently used maps stay in memory. A collection must be used from one thread only.
    """

    def __init__(
        self,
        scenes: str | Path | Sequence[Map | str | Path] | Mapping[str, Map],
        method: str = USUAL_METHOD,
        config: Any = None,
        limit: int = 5,
        progress: ProgressCallback | None = None,
        cancel: Cancel | None = None,
        localizers: Mapping[str, Localizer] | None = None,
        device: torch.device | str = "cpu",
    ) -> None:
        """Read the landmarks of all maps.

        ``scenes`` is a folder whose subfolders are maps, a list of maps and of folders of maps, or maps by name.
        ``method`` and ``config`` select how images are localized, see ``Localizer``. ``limit`` is the
        largest number of ranked maps that are tried, the most similar ones first. ``localizers`` holds existing localizers by
        the names of their maps; ``device`` is that of the maps in folders. Raises ``InputError`` if there is no map or the same one twice, and
        ``Cancelled`` once ``cancel`` returns True.
        """
        if limit < 1:
            raise InputError(f"limit is {limit}", expected="1 or more")
        self.method, self.config, self.limit = method, config, limit
        self._maps = _maps_by_name(scenes)
        self._given_localizers, self._device = localizers or {}, device
        self._localizer = lru_cache(maxsize=6)(self._load)  # this many maps stay in memory after use
        self._infos = {
            name: scene.info if isinstance(scene, Map) else load_info(scene) for name, scene in self._maps.items()
        }
        landmarks: dict[str, LandmarkMap] = {}
        with job_context(progress, cancel):
            for name, scene in report_each(self._maps.items(), "reading", "maps"):
                found = scene.landmarks if isinstance(scene, Map) else read_part(scene, self._infos[name], "landmarks")
                if found is not None and len(found):
                    landmarks[name] = found.to("cpu")
        # The maps with landmarks by the detector and the length of their descriptors, and an index of each such group.
        groups = dict[tuple[str, int], list[str]]()
        for name, found in landmarks.items():
            groups.setdefault((found.features, found.descriptors.shape[1]), []).append(name)
        self._ballots = [
            (features, channels, names, Ballot.of([landmarks[name].descriptors for name in names]))
            for (features, channels), names in groups.items()
        ]
        if bare := [name for name in self._maps if name not in landmarks]:
            log.info(f"{amount(len(bare), 'map')} without landmarks, tried last: {', '.join(bare)}")

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the maps: the given ones or folder names, with as many parent folders as needed to be unique."""
        return tuple(self._maps)

    @property
    def cameras(self) -> tuple[Intrinsics, ...]:
        """The cameras of the images of all maps, used as candidates for photos whose camera is unknown."""
        return tuple(camera.intrinsics for info in self._infos.values() for camera in info.cameras)

    def localizer(self, name: str) -> Localizer:
        """Return the localizer of a map, loaded from its folder unless used recently.

        Raises ``InputError`` for an unknown name.
        """
        if name not in self._maps:
            raise InputError(f"no map {name!r}", expected=f"one of {', '.join(self._maps)}")
        return self._given_localizers.get(name) or self._localizer(name)

    def _load(self, name: str) -> Localizer:
        scene = self._maps[name]
        scene = scene if isinstance(scene, Map) else load_map(scene, self._device)
        return Localizer(scene, self.method, self.config, warm_up=False)

    def rank(self, frame: Frame, detectors: dict[str, CachedFeatures] | None = None) -> dict[str, float]:
        """Return the share of an image's keypoints that vote for each map, most votes first; -1 where it cannot be computed.

        The detectors, which then know the image's keypoints, are stored in ``detectors`` by name.
        """
        detectors = {} if detectors is None else detectors
        found = dict.fromkeys(self._maps, -1.0)
        for features, channels, names, ballot in self._ballots if frame.has_colour else ():
            detector = detectors.setdefault(features, CachedFeatures(partial(detect, find_features(features))))
            descriptors = detector(frame.rgb_bytes).descriptors
            if len(descriptors) and descriptors.shape[1] == channels:
                found |= zip(names, ballot.shares(descriptors, len(names)).tolist(), strict=True)
        return dict(sorted(found.items(), key=lambda item: -item[1]))

    def __call__(self, frame: Frame, seed: int = 0) -> Placement:
        """Find the map that a frame shows, and the pose of the frame in that map.

        If a map has many votes, those with far fewer are not tried, since rooms that look alike would accept what the right one refuses.
        The frame is localized by the full method in a single map that is left, and that is the answer unless it is refused. Otherwise,
        the frame is localized with the landmarks of the most similar maps in turn until one map accepts it, and then in one
        more map, as a possible runner-up. The full method then localizes the frame in the best of the maps tried: among those that accept
        it, or among all if none does, the one with the most inliers.
        Raises ``InputError`` for a frame that cannot be localized at all.
        """
        detectors = dict[str, CachedFeatures]()
        ranking = self.rank(frame, detectors)
        compared = [name for name, share in ranking.items() if share > -1.0]
        bare = [name for name in ranking if name not in compared]
        if compared and (most := ranking[compared[0]]) >= CERTAIN:
            compared = [name for name in compared if ranking[name] >= RIVAL * most]
        full, quick = dict[str, Localization](), dict[str, Localization]()
        if len(compared) == 1:
            best = compared[0]
            full[best] = found = self._in_map(best, frame, seed, detectors)
            if found.converged:
                return Placement(best, found, None, ranking, (best,), self._infos[best].backend)
        for name in [*compared[: self.limit], *bare]:
            recognised = any(found.converged for found in quick.values())
            quick[name] = full[name] if name in full else self._in_map(name, frame, seed, detectors, quick=True)
            if recognised:
                break
        chosen = max(quick, key=lambda name: _merit(quick[name]))  # the first of equal ones
        found = full[chosen] if chosen in full else self._in_map(chosen, frame, seed, detectors)
        second = max([name for name in quick if name != chosen], key=lambda name: _merit(quick[name]), default=None)
        return Placement(
            chosen,
            found,
            None if second is None else (second, quick[second]),
            ranking,
            tuple(quick),
            self._infos[chosen].backend,
        )

    def _in_map(
        self, name: str, frame: Frame, seed: int, detectors: Mapping[str, CachedFeatures], quick: bool = False
    ) -> Localization:
        """Localize a frame in a map by the full method or, if ``quick``, by the landmarks of a map that has some.

        Methods that do not match landmarks are used in full. What the ``detectors`` have found is not detected again.
        """
        localizer = self.localizer(name)
        problem = localizer.problem(frame)
        if problem.matcher is not None and (known := detectors.get(problem.matcher.landmarks.features)) is not None:
            problem = replace(problem, matcher=problem.matcher.for_query(known))
        if not quick or not localizer.matches_landmarks:
            return localizer.answer(problem, seed)
        try:
            found = localize_by_landmarks(problem, getattr(localizer.config, "fused_rays", 0), seed)
        except InputError as error:  # such as a map without a surface
            why, losses = Verdict(Outcome.TOO_FEW_MATCHES, str(error)), torch.zeros(0, dtype=torch.float64)
            return Localization.of(why, SE3.unknown()[None], losses, self.method, time.perf_counter(), math.nan)
        return replace(found, unit=unit_of(localizer.scene)).translated(origin_of(localizer.scene))


def name_maps(scenes: Sequence[_Scene]) -> dict[str, _Scene]:
    """Return maps by name: that of the folder, with as many parent folders as are needed to make it unique.

    A map in memory is named after its data, preceded by its backend if needed; maps that cannot be distinguished in this
    way are numbered. Raises ``InputError`` for a map that is given twice.
    """
    paths, known = list[tuple[str, ...]](), set[object]()
    for scene in scenes:
        folder = scene.folder if isinstance(scene, Map) else Path(scene)
        if folder is not None:
            paths.append(Path(os.path.abspath(folder)).parts)  # a link keeps its own name
        elif isinstance(scene, Map):
            paths.append((scene.info.backend, scene.info.data or "map"))
        identity = id(scene) if folder is None else folder.resolve()
        if identity in known:
            raise UsageError(f"two maps are named {paths[-1][-1]!r}", expected="each map once")
        known.add(identity)
    return dict(zip(unique_names(paths, "/"), scenes, strict=True))


def _maps_by_name(scenes: str | Path | Sequence[Map | str | Path] | Mapping[str, Map]) -> Mapping[str, Map | Path]:
    """Return the maps by name; each of ``scenes`` may be a folder of maps."""
    if isinstance(scenes, Mapping):
        return scenes
    found = list[Map | Path]()
    for scene in [scenes] if isinstance(scenes, str | Path) else scenes:
        own: list[Map | Path] = [scene] if isinstance(scene, Map) else [*maps_in(Path(scene))]
        if not own:
            raise InputError("no map in it", where=scene, expected="a map or a folder of maps")
        found += own
    if not found:
        raise InputError("no maps", expected="at least one")
    return name_maps(found)


def _merit(found: Localization) -> tuple[bool, float, float]:
    """Return the key that ranks answers from several maps: acceptance, then inliers, then confidence."""
    return (
        found.converged,
        float(getattr(found.diagnostics, "inliers", 0)),
        -1.0 if found.confidence is None else found.confidence,
    )
