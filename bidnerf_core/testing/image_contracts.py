"""``FeaturesContract`` and ``FaultContract``: the requirements on keypoint detectors and on faults, one test each."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.errors import InputError
from bidnerf_core.evaluation import FAULTS
from bidnerf_core.frames import Frame
from bidnerf_core.mapping import Keypoints, find_features, squared_distances
from bidnerf_core.testing.faults import Named, calling, require_that
from bidnerf_core.testing.textured_field import training_views

SHIFT = 6
"""Pixels by which an image is shifted."""
NEAR = 1.5
"""Largest distance (pixels) between keypoints that count as the same."""


class FeaturesContract(Named):
    """Tests of a detector: derive a class whose name begins with ``Test``, and set its registered ``name``.

    ``repeated`` is the minimum repeatability: the fraction of keypoints that must be detected again, and
    matched by their descriptors, in an image shifted by a few pixels.
    """

    repeated: ClassVar[float] = 0.5

    def test_keypoints_are_well_formed(self) -> None:
        for number, image in enumerate(_images()):
            found, who = self._found(image), f"detector {self.name!r}, image {number}"
            count, (height, width) = len(found.pixels), image.shape[:2]
            require_that(count > 0, f"{who}: no keypoint in a textured image, expected some")
            shapes = tuple(found.pixels.shape), tuple(found.sizes.shape), tuple(found.descriptors.shape[:1])
            require_that(
                shapes == ((count, 2), (count,), (count,)) and found.descriptors.ndim == 2,
                f"{who}: pixels, sizes and descriptors have shapes {shapes}, expected (n, 2), (n) and (n, d)",
            )
            require_that(
                found.descriptors.dtype == torch.uint8,
                f"{who}: descriptors are {found.descriptors.dtype}, expected bytes;"
                " bidnerf_core.mapping.landmarks.features.quantized converts numbers to bytes",
            )
            inside = (found.pixels >= 0).all() and (found.pixels <= torch.tensor([width, height])).all()
            require_that(bool(inside), f"{who}: keypoints lie outside the image")
            require_that(bool((found.sizes > 0).all()), f"{who}: sizes are not positive, expected pixels")

    def test_descriptors_have_one_length(self) -> None:
        lengths = {self._found(image).descriptors.shape[1] for image in (*_images(), _blank())}
        require_that(
            len(lengths) == 1,
            f"detector {self.name!r}: descriptors have {sorted(lengths)} channels in different images (a blank one among"
            " them), expected one number",
        )

    def test_same_image_gives_the_same_keypoints(self) -> None:
        image = _images()[0]
        expected = self._found(image)
        with ThreadPoolExecutor(4) as pool:
            for found in pool.map(self._found, [image] * 8):
                same = torch.equal(found.pixels, expected.pixels) and torch.equal(
                    found.descriptors, expected.descriptors
                )
                require_that(
                    same,
                    f"detector {self.name!r}: several threads with one image get different keypoints, expected the same",
                )

    def test_blank_image_has_no_keypoints(self) -> None:
        found = self._found(_blank())
        require_that(
            len(found.pixels) == 0,
            f"detector {self.name!r}: {len(found.pixels)} keypoints in an image of one colour, expected none",
        )

    def test_keypoints_move_with_the_image(self) -> None:
        image = _images()[0]
        first, second = self._found(image[:-SHIFT, :-SHIFT]), self._found(image[SHIFT:, SHIFT:])
        require_that(len(second.pixels) > 0, f"detector {self.name!r}: no keypoint in a shifted image")
        moved = first.pixels - SHIFT
        height, width = image.shape[0] - SHIFT, image.shape[1] - SHIFT
        shared = ((moved > 0) & (moved < torch.tensor([width - SHIFT, height - SHIFT]))).all(1)
        nearest = squared_distances(first.descriptors, second.descriptors).argmin(1)
        off = torch.linalg.vector_norm(second.pixels[nearest] - moved, dim=-1)
        share = float((off[shared] <= NEAR).double().mean()) if bool(shared.any()) else 0.0
        require_that(
            share >= self.repeated,
            f"detector {self.name!r}: of the keypoints, {share:.0%} are recognised in the image shifted by {SHIFT} pixels,"
            f" expected {self.repeated:.0%} or more; is the centre of the first pixel at (0.5, 0.5)?",
        )

    def _found(self, rgb: Float[Tensor, "h w 3"]) -> Keypoints:
        with calling(f"detector {self.name!r}"):
            return self._part(find_features)(rgb)


class FaultContract(Named):
    """Tests of a fault: derive a class whose name begins with ``Test``, and set its registered ``name``."""

    def test_fault_says_what_it_is(self) -> None:
        fault, who = self._part(FAULTS.load), f"fault {self.name!r}"
        for what, text in (("summary", fault.summary), ("unit", fault.unit)):
            one_line = isinstance(text, str) and text.strip() != "" and "\n" not in text
            require_that(one_line, f"{who}: {what} is {text!r}, expected one line of text")
        require_that(len(fault.sizes) > 0, f"{who}: no sizes, expected those worth measuring")
        neutral = [] if fault.neutral is None else [fault.neutral]
        for size in (*fault.sizes, *neutral):
            require_that(
                size in fault.allowed, f"{who}: size {size:g} is not allowed, expected {fault.allowed}"
            )

    def test_other_sizes_change_something(self) -> None:
        frame = _frame()
        for size in self._part(FAULTS.load).sizes:
            found = self._changed(frame, size)
            changed = not _same(found, frame) or found.intrinsics != frame.intrinsics
            changed = changed or found.focal_is_approximate != frame.focal_is_approximate
            changed = changed or self._part(FAULTS.load).T_true_faulty is not None
            require_that(changed, f"fault {self.name!r}: size {size:g} changes nothing, expected a fault")

    def test_same_seed_gives_the_same_image(self) -> None:
        for size in self._part(FAULTS.load).sizes:
            first, second = (self._changed(_frame(), size) for _ in range(2))
            require_that(
                _same(first, second),
                f"fault {self.name!r}: two calls with one seed differ, expected all randomness to come from the generator",
            )

    def test_image_stays_an_image(self) -> None:
        for size in self._part(FAULTS.load).sizes:
            found, who = self._changed(_frame(), size), f"fault {self.name!r} of size {size:g}"
            shape = found.intrinsics.height, found.intrinsics.width
            require_that(
                tuple(found.rgb.shape) == (*shape, 3) and found.rgb.dtype == torch.float32,
                f"{who}: colours are {found.rgb.dtype} of shape {tuple(found.rgb.shape)}, expected float32 of shape"
                f" {(*shape, 3)}, as the intrinsics say",
            )
            inside = found.rgb.isfinite().all() and (found.rgb >= 0).all() and (found.rgb <= 1).all()
            require_that(bool(inside), f"{who}: colours are not from 0 to 1")
            if found.depth is None:
                continue
            require_that(
                tuple(found.depth.shape) == shape and found.depth.dtype == torch.float32,
                f"{who}: depth is {found.depth.dtype} of shape {tuple(found.depth.shape)}, expected float32 of {shape}",
            )
            sound = found.depth.isfinite().all() and (found.depth >= 0).all()
            require_that(
                bool(sound), f"{who}: depth is negative or not finite, expected metres, 0 where there is none"
            )

    def test_given_image_is_left_alone(self) -> None:
        frame, before = _frame(), _frame()
        for size in self._part(FAULTS.load).sizes:
            self._changed(frame, size)
        require_that(
            _same(frame, before), f"fault {self.name!r}: writes into the given image, expected a new one"
        )

    def test_fault_of_depth_needs_depth(self) -> None:
        if not self._part(FAULTS.load).needs_depth:
            return
        try:
            self._part(FAULTS.load).change(
                _frame().replace(depth=None), self._part(FAULTS.load).sizes[0], _generator()
            )
        except InputError:
            return
        require_that(
            False,
            f"fault {self.name!r} changes depth, but accepts an image without it, expected an InputError",
        )

    def _changed(self, frame: Frame, size: float) -> Frame:
        with calling(f"fault {self.name!r} of size {size:g}"):
            return self._part(FAULTS.load).change(frame, size, _generator())


def _images() -> tuple[Float[Tensor, "h w 3"], ...]:
    """Return images of 256 x 192 pixels."""
    small = torch.stack([view.frame.rgb for view in training_views()[:2]]).movedim(-1, 1)
    large = torch.nn.functional.interpolate(small, scale_factor=2, mode="bicubic").clamp(0, 1).movedim(1, -1)
    return large[0], large[1]


def _blank() -> Float[Tensor, "h w 3"]:
    return torch.full((96, 128, 3), 0.4)


def _frame() -> Frame:
    frame = training_views()[0].frame
    assert frame.depth is not None
    return replace(frame, rgb=frame.rgb.clone(), depth=frame.depth.float().clone())


def _generator() -> torch.Generator:
    return torch.Generator().manual_seed(7)


def _same(a: Frame, b: Frame) -> bool:
    def equal(x: Tensor | None, y: Tensor | None) -> bool:
        return x is y or (x is not None and y is not None and torch.equal(x, y))

    return equal(a.rgb, b.rgb) and equal(a.depth, b.depth)
