"""``ReaderContract``: the requirements on every dataset reader, one test each."""

from __future__ import annotations

import math
import tempfile
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import ClassVar

import torch

from bidnerf_core.captures import pose_contradiction
from bidnerf_core.datasets import READERS, Capture, DatasetOptions
from bidnerf_core.frames import View
from bidnerf_core.mapping import DEFAULT_LANDMARKS, TrackedViews, depth_ratio, tracked_views
from bidnerf_core.testing.faults import Named, calling, require_that

ENOUGH_POINTS = 30
"""Smallest number of points that several images must agree on for their poses to be judged."""
UNUSUAL_RATIO = 0.1
"""Largest relative difference between measured depth and triangulated depth."""
MOST_VIEWS = 24
"""Largest number of images that are compared with each other."""


class ReaderContract(Named):
    """Tests of a reader: derive a class whose name begins with ``Test``, and set ``name`` and ``folder``.

    ``name`` is the name under which the reader is registered, ``folder`` a capture in its format: at least
    ten images of something textured, taken from different places, as small as possible. It is opened with
    ``options``.
    """

    folder: ClassVar[Path | str] = ""
    options: ClassVar[DatasetOptions] = DatasetOptions()

    def test_folder_is_recognised_and_an_empty_one_is_not(self) -> None:
        reader, who = self._part(READERS.load), f"reader {self.name!r}"
        require_that(reader.recognises(Path(self.folder)), f"{who} does not recognise {self.folder}")
        with tempfile.TemporaryDirectory() as empty, calling(f"{who}.recognises of an empty folder"):
            require_that(not reader.recognises(Path(empty)), f"{who} recognises an empty folder")
        text = isinstance(reader.expected, str) and reader.expected.strip() != ""
        require_that(
            text, f"{who}.expected is {reader.expected!r}, expected the files of the format in words"
        )

    def test_names_are_unique(self) -> None:
        data = self._dataset()
        for split in data.splits:
            names = data.frame_names(split)
            twice = sorted({name for name in names if names.count(name) > 1})
            require_that(not twice, f"reader {self.name!r}: {twice[:3]} occur twice in split {split!r}")
            read = [view.frame.name for view in self._views(split)]
            require_that(
                read == names[: len(read)],
                f"reader {self.name!r}: views of {split!r} have other names: {read[:3]}",
            )

    def test_background_is_the_one_that_is_asked_for(self) -> None:
        colour = (1.0, 0.5, 0.0)
        with calling(f"reader {self.name!r}: read of {self.folder}"):
            data = replace(self.options, background=colour).open(self.folder, [self._part(READERS.load)])
        require_that(
            tuple(data.background) == colour,
            f"reader {self.name!r}: the background is {data.background}, expected {colour}, as its options say",
        )

    def test_poses_are_rigid(self) -> None:
        for view in self._views():
            pose = view.T_ref_camera
            require_that(
                bool(pose.is_rigid()) and pose.translation.dtype == torch.float64,
                f"reader {self.name!r}: the pose of {view.frame.name} is not a rigid transform in float64",
            )

    def test_images_are_images(self) -> None:
        for view in self._views():
            frame, who = view.frame, f"reader {self.name!r}, {view.frame.name}"
            shape = frame.intrinsics.height, frame.intrinsics.width
            require_that(
                tuple(frame.rgb.shape) == (*shape, 3), f"{who}: the intrinsics have another size: {shape}"
            )
            require_that(
                bool((frame.rgb >= 0).all() and (frame.rgb <= 1).all()), f"{who}: colours are not from 0 to 1"
            )
            if frame.depth is not None:
                sound = frame.depth.isfinite().all() and (frame.depth >= 0).all()
                require_that(
                    bool(sound), f"{who}: depth is negative or not finite, expected metres, 0 for none"
                )

    def test_axes_are_those_of_opencv(self) -> None:
        tracked = self._tracked()
        other = pose_contradiction(tracked.observations.images)
        require_that(other is None, f"reader {self.name!r}: {'' if other is None else other.sentence}")
        seen, _ = tracked.triangulated(DEFAULT_LANDMARKS)
        count = seen.count
        require_that(
            count >= ENOUGH_POINTS,
            f"reader {self.name!r}: the images agree on {count} points, expected {ENOUGH_POINTS} or more; are the poses"
            " T_world_camera with x right, y down and z forward, and the intrinsics in pixels of these images? or does"
            f" {self.folder} show too little texture, or everything from one place?",
        )

    def test_depth_has_the_unit_of_the_poses(self) -> None:
        tracked = self._tracked()
        if not bool((tracked.observations.depth > 0).any()):
            return
        seen, points = tracked.triangulated(DEFAULT_LANDMARKS)
        ratio = depth_ratio(seen, points)
        require_that(
            ratio is None or abs(ratio - 1) <= UNUSUAL_RATIO,
            f"reader {self.name!r}: depth is {ratio or math.nan:.3g} times the depth that the poses and"
            " images imply, expected planar z (not the distance along the ray) in the unit of the poses,"
            " metres",
        )

    def test_sequence_is_in_order_of_time(self) -> None:
        with calling(f"reader {self.name!r}: read of {self.folder}"):
            sequence = self.options.open_sequence(self.folder, [self._part(READERS.load)])
        times = [timed.time for timed in sequence]
        require_that(
            len(times) == len(sequence),
            f"reader {self.name!r}: the sequence has a different length than it states",
        )
        known = [time for time in times if time is not None]
        require_that(
            len(known) in (0, len(times)), f"reader {self.name!r}: some frames have a time, others have none"
        )
        late = [i for i, (a, b) in enumerate(pairwise(known)) if b < a]
        require_that(
            not late, f"reader {self.name!r}: frame {late[:1]} of the sequence is later than the next"
        )

    def test_reading_twice_gives_the_same(self) -> None:
        first, second = self._views(), self._views()
        for a, b in zip(first, second, strict=True):
            depths = [view.frame.depth for view in (a, b)]
            same = (
                a.frame.name == b.frame.name
                and torch.equal(a.frame.rgb, b.frame.rgb)
                and torch.equal(a.T_ref_camera.matrix(), b.T_ref_camera.matrix())
                and a.frame.intrinsics == b.frame.intrinsics
                and (depths[0] is depths[1] or (None not in depths and torch.equal(*depths)))  # type: ignore[arg-type]
            )
            require_that(same, f"reader {self.name!r}: {a.frame.name} differs when it is read again")

    def _dataset(self) -> Capture:
        with calling(f"reader {self.name!r}: read of {self.folder}"):
            return self.options.open(self.folder, [self._part(READERS.load)])

    def _views(self, split: str | None = None) -> list[View]:
        data = self._dataset()
        split = data.splits[0] if split is None else split
        with calling(f"reader {self.name!r}: views of {split!r}"):
            return data.views(split, data.frame_names(split)[:MOST_VIEWS])

    def _tracked(self) -> TrackedViews:
        """Return the keypoints of the images, joined into tracks; computed once per test class."""
        kept = type(self).__dict__.get("_kept")
        if kept is None:
            kept = type(self)._kept = tracked_views(self._views())  # type: ignore[attr-defined]
        return kept
