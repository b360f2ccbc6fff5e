"""The requirements on readers, with one test for each."""

from __future__ import annotations

import math
import tempfile
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any, ClassVar

import torch

from bidnerf.testing.faults import Named, are_colours, calling, equal, is_depth, once, require
from bidnerf_core.captures import pose_contradiction
from bidnerf_core.datasets import READERS, Capture, DatasetOptions
from bidnerf_core.frames import View
from bidnerf_core.mapping import (
    DEFAULT_LANDMARKS,
    TrackedViews,
    depth_ratio,
    track_views,
)

ENOUGH_POINTS = 30
"""Minimum number of points on which several images must agree for their poses to be judged."""


class ReaderContract(Named):
    """Tests of a reader; to use them, derive a class whose name begins with ``Test`` and set ``name`` and ``folder``.

    ``name`` is the name under which the reader is registered, ``folder`` a capture in its format: at least
    ten images of a textured scene from different positions, as small as possible. The capture is opened
    with ``options``.
    """

    kind = "reader"
    folder: ClassVar[Path | str] = ""
    options: ClassVar[DatasetOptions] = DatasetOptions()

    def test_folder_is_recognised_and_an_empty_one_is_not(self) -> None:
        reader = self._part(READERS.load)
        with tempfile.TemporaryDirectory() as empty, calling(f"{self._who}.recognises"):
            is_own, is_any = reader.recognises(Path(self.folder)), reader.recognises(Path(empty))
        require(
            self._who,
            (is_own, f"does not recognise {self.folder}"),
            (not is_any, "recognises an empty folder"),
            (
                isinstance(reader.expected, str) and reader.expected.strip() != "",
                f"expected is {reader.expected!r}, expected the files of the format in words",
            ),
        )

    def test_names_are_unique(self) -> None:
        data = self._dataset()
        for split in data.splits:
            names = data.frame_names(split)
            twice = sorted({name for name in names if names.count(name) > 1})
            read = [view.frame.name for view in self._views(split)]
            require(
                self._who,
                (not twice, f"{twice[:3]} occur twice in split {split!r}"),
                (read == names[: len(read)], f"views of {split!r} have other names: {read[:3]}"),
            )

    def test_background_is_the_one_that_is_asked_for(self) -> None:
        colour = (1.0, 0.5, 0.0)
        found = tuple(self._dataset(background=colour).background)
        require(self._who, (found == colour, f"the background is {found}, expected {colour}, as its options say"))

    def test_poses_are_rigid(self) -> None:
        for view in self._views():
            pose = view.T_ref_camera
            require(
                self._who,
                (
                    bool(pose.is_rigid()) and pose.translation.dtype == torch.float64,
                    f"the pose of {view.frame.name} is not a rigid transform in float64",
                ),
            )

    def test_images_are_images(self) -> None:
        for frame in (view.frame for view in self._views()):
            shape = frame.intrinsics.height, frame.intrinsics.width
            require(
                f"{self._who}, {frame.name}",
                (tuple(frame.rgb.shape) == (*shape, 3), f"the intrinsics have another size: {shape}"),
                (are_colours(frame.rgb), "colours are not from 0 to 1"),
                (is_depth(frame.depth), "depth is negative or not finite, expected metres, 0 for none"),
            )

    def test_axes_are_those_of_opencv(self) -> None:
        tracked = self._tracked()
        other = pose_contradiction(tracked.observations.images)
        count = tracked.triangulate(DEFAULT_LANDMARKS)[0].count
        require(
            self._who,
            (other is None, "" if other is None else other.sentence),
            (
                count >= ENOUGH_POINTS,
                f"the images agree on {count} points, expected {ENOUGH_POINTS} or more; are the poses T_world_camera with"
                " x right, y down and z forward, and the intrinsics in pixels of these images? or does"
                f" {self.folder} show too little texture, or everything from one place?",
            ),
        )

    def test_depth_has_the_unit_of_the_poses(self) -> None:
        tracked = self._tracked()
        if not bool((tracked.observations.depth > 0).any()):
            return
        ratio = depth_ratio(*tracked.triangulate(DEFAULT_LANDMARKS))
        require(
            self._who,
            (
                ratio is None or abs(ratio - 1) <= 0.1,
                f"depth is {ratio or math.nan:.3g} times the depth that the poses and images imply, expected planar z (not"
                " the distance along the ray) in the unit of the poses, metres",
            ),
        )

    def test_sequence_is_in_order_of_time(self) -> None:
        with calling(f"{self._who}: read of {self.folder}"):
            sequence = self.options.open_sequence(self.folder, [self._part(READERS.load)])
        times = [timed.time for timed in sequence]
        known = [time for time in times if time is not None]
        late = [i for i, (a, b) in enumerate(pairwise(known)) if b < a]
        require(
            self._who,
            (len(times) == len(sequence), "the sequence has a different length than it states"),
            (len(known) in (0, len(times)), "some frames have a time, others have none"),
            (not late, f"frame {late[:1]} of the sequence is later than the next"),
        )

    def test_reading_twice_gives_the_same(self) -> None:
        for a, b in zip(self._views(), self._views(), strict=True):
            require(
                self._who,
                (
                    a.frame.name == b.frame.name
                    and torch.equal(a.frame.rgb, b.frame.rgb)
                    and torch.equal(a.T_ref_camera.matrix(), b.T_ref_camera.matrix())
                    and a.frame.intrinsics == b.frame.intrinsics
                    and equal(a.frame.depth, b.frame.depth),
                    f"{a.frame.name} differs when it is read again",
                ),
            )

    def _dataset(self, **options: Any) -> Capture:
        with calling(f"{self._who}: read of {self.folder}"):
            return replace(self.options, **options).open(self.folder, [self._part(READERS.load)])

    def _views(self, split: str | None = None) -> list[View]:
        data = self._dataset()
        split = split or data.splits[0]
        with calling(f"{self._who}: views of {split!r}"):
            return data.views(split, data.frame_names(split)[:24])  # as many are compared with each other

    def _tracked(self) -> TrackedViews:
        """Return the keypoints of the images, joined into tracks; computed once per test class."""
        return once(self, lambda: track_views(self._views()))
