"""The requirements on methods, keypoint detectors and faults, with one test for each."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any, ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf.evaluation import FAULTS, Fault
from bidnerf.testing.faults import (
    Named,
    are_colours,
    calling,
    equal,
    generator,
    is_depth,
    is_one_line,
    is_refused,
    once,
    require,
)
from bidnerf.testing.textured_field import (
    POSES,
    T_MOVED_WORLD,
    MapWithLandmarks,
    moved_map,
    textured_map,
    textured_view,
    training_views,
    unseen,
)
from bidnerf_core.frames import Frame
from bidnerf_core.geometry import SE3
from bidnerf_core.localization import METHODS, Localization
from bidnerf_core.mapping import (
    Keypoints,
    find_features,
    squared_distances,
)
from bidnerf_core.maps import Localizer
from bidnerf_core.registry import interface_defects

# Methods.


class MethodContract(Named):
    """Tests of a localization method; to use them, derive a class whose name begins with ``Test`` and set ``name``.

    ``name`` is the name under which the method is registered, ``config`` a config for small images; without
    it, the default config is used. The scene is a textured ground 2.4 m wide, seen by a camera of 128 x 96
    pixels, with depth. ``largest_error`` (metres and radians) is the largest error allowed for an accepted
    pose.
    """

    kind = "method"
    config: ClassVar[Any] = None
    largest_error: ClassVar[float] = 0.03

    def test_method_says_what_it_is(self) -> None:
        method = self._part(METHODS.load)
        for defect in interface_defects(method, ("summary", "config_type"), {"solve": ("problem", "config", "seed")}):
            require(self._who, (False, defect))
        summary, kind = method.summary, method.config_type
        require(self._who, (is_one_line(summary), f"summary is {summary!r}, expected one line of text"))
        for preset, settings in method.presets.items():
            is_right, given = isinstance(settings, kind), type(settings).__name__
            require(self._who, (is_right, f"preset {preset!r} is a {given}, expected a {kind.__name__}"))

    def test_pose_is_found(self) -> None:
        found = self._first()
        error = _difference(found.T_world_camera, unseen().T_ref_camera)
        require(
            self._who,
            (
                found.converged,
                f"an image of the map's scene is rejected ({found.reason}), expected its pose; does the test's config"
                " suffice?",
            ),
            (
                error <= self.largest_error,
                f"an accepted pose is off by {error:.3g} (metres, radians), expected {self.largest_error:g} or less",
            ),
        )

    def test_answer_is_sound(self) -> None:
        found = self._first()
        covariance = torch.eye(6) if found.covariance is None else found.covariance
        require(
            self._who,
            (found.T_world_camera.is_rigid(), "the pose is not a rigid transform"),
            (found.reason.strip() != "", "the answer has no reason, expected one in words"),
            (
                torch.allclose(covariance, covariance.mT, rtol=1e-6)
                and float(torch.linalg.eigvalsh(covariance.double())[0]) > 0,
                "the covariance is not symmetric and positive definite",
            ),
        )

    def test_same_seed_gives_the_same_pose(self) -> None:
        again = self._localize(textured_map(surface=True), unseen().frame, unseen().T_ref_camera)
        first, second = (found.T_world_camera.matrix() for found in (self._first(), again))
        expected = "expected all randomness to come from it"
        require(
            self._who,
            (torch.equal(first, second), f"two calls with one seed give different poses, {expected}"),
        )

    def test_pose_moves_with_the_world(self) -> None:
        here, there = self._first(), self._localize(moved_map(), unseen().frame, T_MOVED_WORLD @ unseen().T_ref_camera)
        error = _difference(there.T_world_camera, T_MOVED_WORLD @ here.T_world_camera)
        require(
            f"{self._who}, in a world that is moved",
            (there.converged, f"the image is rejected ({there.reason})"),
            (
                error <= self.largest_error,
                f"the pose is off by {error:.3g} (metres, radians) from the moved one, expected"
                f" {self.largest_error:g} or less; does it depend on the world's axes or origin?",
            ),
        )

    def test_image_of_another_scene_is_rejected(self) -> None:
        found = self._localize(textured_map(surface=True), textured_view(POSES[1], "other", seed=1).frame, POSES[1])
        require(
            self._who,
            (
                not found.converged,
                f"the pose of an image of another scene is accepted ({found.reason}), expected an outcome other than"
                " CONVERGED",
            ),
        )

    def _first(self) -> Localization:
        """Return the answer for an image of the map's scene, found once per test class."""
        scene, view = textured_map(surface=True), unseen()
        return once(self, lambda: self._localize(scene, view.frame, view.T_ref_camera))

    def _localize(self, scene: MapWithLandmarks, frame: Frame, truth: SE3) -> Localization:
        # A tangent vector (metres, radians) from the true pose to the start of methods that need one.
        off = torch.tensor((0.02, -0.015, 0.02, 0.01, -0.008, 0.012), dtype=torch.float64)
        near = truth.to("cpu", torch.float64).retract(off)
        with calling(self._who):
            localizer = Localizer(scene, self.name, self.config, warm_up=False)
            return localizer(frame, near if self._part(METHODS.load).needs_start else None)


def _difference(found: SE3, truth: SE3) -> float:
    return float((truth.to(dtype=torch.float64).inverse() @ found.to(dtype=torch.float64)).log().norm())


# Keypoint detectors.

PIXEL_SHIFT = 6
"""Pixels by which an image is shifted."""


class FeaturesContract(Named):
    """Tests of a keypoint detector; to use them, derive a class whose name begins with ``Test`` and set the detector's ``name``.

    ``repeated`` is the minimum repeatability: the fraction of keypoints that must be detected again, and
    matched by their descriptors, in an image shifted by a few pixels.
    """

    kind = "detector"
    repeated: ClassVar[float] = 0.5

    def test_keypoints_are_well_formed(self) -> None:
        for number, image in enumerate(_images()):
            found = self._detect(image)
            pixels, sizes, descriptors = found.pixels, found.sizes, found.descriptors
            count, (height, width) = len(pixels), image.shape[:2]
            shapes = tuple(pixels.shape), tuple(sizes.shape), tuple(descriptors.shape[:1])
            who = f"{self._who}, image {number}"
            require(
                who,
                (count > 0, "no keypoint in a textured image, expected some"),
                (
                    shapes == ((count, 2), (count,), (count,)) and descriptors.ndim == 2,
                    f"pixels, sizes and descriptors have shapes {shapes}, expected (n, 2), (n) and (n, d)",
                ),
                (
                    descriptors.dtype == torch.uint8,
                    f"descriptors are {descriptors.dtype}, expected bytes;"
                    " bidnerf_core.mapping.quantize converts numbers to bytes",
                ),
            )
            inside = (pixels >= 0).all() and (pixels <= torch.tensor([width, height])).all()
            require(
                who,
                (inside, "keypoints lie outside the image"),
                ((sizes > 0).all(), "sizes are not positive, expected pixels"),
            )

    def test_descriptors_have_one_length(self) -> None:
        lengths = {self._detect(image).descriptors.shape[1] for image in (*_images(), _blank())}
        require(
            self._who,
            (
                len(lengths) == 1,
                f"descriptors have {sorted(lengths)} channels in different images (a blank one among them), expected one"
                " number",
            ),
        )

    def test_same_image_gives_the_same_keypoints(self) -> None:
        image = _images()[0]
        expected = self._detect(image)
        with ThreadPoolExecutor(4) as pool:
            same = [
                torch.equal(found.pixels, expected.pixels) and torch.equal(found.descriptors, expected.descriptors)
                for found in pool.map(self._detect, [image] * 8)
            ]
        require(
            self._who,
            (all(same), "several threads with one image get different keypoints, expected the same"),
        )

    def test_blank_image_has_no_keypoints(self) -> None:
        count = len(self._detect(_blank()).pixels)
        require(self._who, (count == 0, f"{count} keypoints in an image of one colour, expected none"))

    def test_keypoints_move_with_the_image(self) -> None:
        image = _images()[0]
        first, second = (
            self._detect(image[:-PIXEL_SHIFT, :-PIXEL_SHIFT]),
            self._detect(image[PIXEL_SHIFT:, PIXEL_SHIFT:]),
        )
        require(self._who, (len(second.pixels) > 0, "no keypoint in a shifted image"))
        moved = first.pixels - PIXEL_SHIFT
        height, width = image.shape[0] - PIXEL_SHIFT, image.shape[1] - PIXEL_SHIFT
        shared = ((moved > 0) & (moved < torch.tensor([width - PIXEL_SHIFT, height - PIXEL_SHIFT]))).all(1)
        nearest = squared_distances(first.descriptors, second.descriptors).argmin(1)
        off = torch.linalg.vector_norm(second.pixels[nearest] - moved, dim=-1)
        # Keypoints at most 1.5 pixels apart count as the same.
        share = float((off[shared] <= 1.5).double().mean()) if bool(shared.any()) else 0.0
        require(
            self._who,
            (
                share >= self.repeated,
                f"of the keypoints, {share:.0%} are recognised in the image shifted by {PIXEL_SHIFT} pixels, expected"
                f" {self.repeated:.0%} or more; is the centre of the first pixel at (0.5, 0.5)?",
            ),
        )

    def _detect(self, rgb: Float[Tensor, "h w 3"]) -> Keypoints:
        with calling(self._who):
            return self._part(find_features)(rgb)


def _images() -> tuple[Float[Tensor, "h w 3"], ...]:
    """Return two images of 256 x 192 pixels."""
    small = torch.stack([view.frame.rgb for view in training_views()[:2]]).movedim(-1, 1)
    large = torch.nn.functional.interpolate(small, scale_factor=2, mode="bicubic").clamp(0, 1).movedim(1, -1)
    return large[0], large[1]


def _blank() -> Float[Tensor, "h w 3"]:
    return torch.full((96, 128, 3), 0.4)


# Faults.


class FaultContract(Named):
    """Tests of a fault; to use them, derive a class whose name begins with ``Test``, and set ``name`` to that of the fault."""

    kind = "fault"

    def test_fault_says_what_it_is(self) -> None:
        fault = self._fault
        sizes = [*fault.sizes, *([] if fault.neutral is None else [fault.neutral])]
        require(
            self._who,
            *(
                (is_one_line(t), f"{what} is {t!r}, expected one line of text")
                for what, t in (("summary", fault.summary), ("unit", fault.unit))
            ),
            (len(fault.sizes) > 0, "no sizes, expected those worth measuring"),
            *((s in fault.allowed, f"size {s:g} is not allowed, expected {fault.allowed}") for s in sizes),
        )

    def test_other_sizes_change_something(self) -> None:
        frame = _frame()
        for size in self._fault.sizes:
            found = self._change(frame, size)
            require(
                self._who,
                (
                    not _same(found, frame)
                    or found.intrinsics != frame.intrinsics
                    or found.focal_is_approximate != frame.focal_is_approximate
                    or self._fault.T_true_faulty is not None,
                    f"size {size:g} changes nothing, expected a fault",
                ),
            )

    def test_same_seed_gives_the_same_image(self) -> None:
        expected = "expected all randomness to come from the generator"
        for size in self._fault.sizes:
            require(
                self._who,
                (
                    _same(*(self._change(_frame(), size) for _ in range(2))),
                    f"two calls with one seed differ, {expected}",
                ),
            )

    def test_image_stays_an_image(self) -> None:
        for size in self._fault.sizes:
            found = self._change(_frame(), size)
            shape, rgb, depth = (found.intrinsics.height, found.intrinsics.width), found.rgb, found.depth
            require(
                f"{self._who} of size {size:g}",
                (
                    tuple(rgb.shape) == (*shape, 3) and rgb.dtype == torch.float32,
                    f"colours are {rgb.dtype} of shape {tuple(rgb.shape)}, expected float32 of shape {(*shape, 3)}, as the"
                    " intrinsics say",
                ),
                (are_colours(rgb), "colours are not from 0 to 1"),
                (
                    depth is None or (tuple(depth.shape) == shape and depth.dtype == torch.float32),
                    f"depth is not float32 of {shape}",
                ),
                (
                    is_depth(depth),
                    "depth is negative or not finite, expected metres, 0 where there is none",
                ),
            )

    def test_given_image_is_left_alone(self) -> None:
        frame = _frame()
        for size in self._fault.sizes:
            self._change(frame, size)
        require(self._who, (_same(frame, _frame()), "writes into the given image, expected a new one"))

    def test_fault_of_depth_needs_depth(self) -> None:
        fault, bare = self._fault, _frame().replace(depth=None)
        refused = not fault.needs_depth or is_refused(lambda: fault.change(bare, fault.sizes[0], generator()))
        require(self._who, (refused, "changes depth, but accepts an image without it, expected an InputError"))

    @property
    def _fault(self) -> Fault:
        return self._part(FAULTS.load)

    def _change(self, frame: Frame, size: float) -> Frame:
        with calling(f"{self._who} of size {size:g}"):
            return self._fault.change(frame, size, generator())


def _frame() -> Frame:
    frame = training_views()[0].frame
    assert frame.depth is not None
    return replace(frame, rgb=frame.rgb.clone(), depth=frame.depth.float().clone())


def _same(a: Frame, b: Frame) -> bool:
    return equal(a.rgb, b.rgb) and equal(a.depth, b.depth)
