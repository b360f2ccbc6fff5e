"""``MethodContract``: the requirements on every localization method, one test for each."""

from __future__ import annotations

from typing import Any, ClassVar

import torch

from bidnerf_core.errors import InputError
from bidnerf_core.geometry import SE3
from bidnerf_core.localization import METHODS, Localization, Localizer
from bidnerf_core.registry import interface_defects
from bidnerf_core.testing.faults import Named, calling, require_that
from bidnerf_core.testing.textured_field import (
    CAMERA,
    POSES,
    T_MOVED_WORLD,
    MapWithLandmarks,
    moved_map,
    seen,
    textured_map,
    unseen,
)

START_OFF = (0.02, -0.015, 0.02, 0.01, -0.008, 0.012)
"""Tangent vector (metres, radians) from the true pose to the start of methods that need one."""


class MethodContract(Named):
    """Tests of a localization method: derive a class whose name begins with ``Test``, and set ``name``.

    ``name`` is the name under which the method is registered, ``config`` a config for small images; without
    it, the default config is used. The scene is a textured ground 2.4 m wide, seen by a camera of 128 x 96
    pixels, with depth. ``largest_error`` (metres and radians) is the largest error allowed for an accepted
    pose.
    """

    config: ClassVar[Any] = None
    largest_error: ClassVar[float] = 0.03

    def test_method_says_what_it_is(self) -> None:
        method = self._part(METHODS.load)
        wrong = next(
            interface_defects(method, ("summary", "config_type"), {"solve": ("problem", "config", "seed")}),
            "",
        )
        require_that(not wrong, f"method {self.name!r}: {wrong}")
        one_line = method.summary.strip() != "" and "\n" not in method.summary
        require_that(
            one_line, f"method {self.name!r}: summary is {method.summary!r}, expected one line of text"
        )
        for preset, settings in method.presets.items():
            kind = method.config_type
            require_that(
                isinstance(settings, kind),
                f"method {self.name!r}: preset {preset!r} is a {type(settings).__name__}, expected a {kind.__name__}",
            )

    def test_pose_is_found(self) -> None:
        found = self._found(textured_map(surface=True))
        require_that(
            found.converged,
            f"method {self.name!r}: an image of the map's scene is rejected ({found.reason}), expected its pose; does the"
            " test's config suffice?",
        )
        error = _difference(found.T_world_camera, unseen().T_ref_camera)
        require_that(
            error <= self.largest_error,
            f"method {self.name!r}: an accepted pose is off by {error:.3g} (metres, radians), expected"
            f" {self.largest_error:g} or less",
        )

    def test_answer_is_sound(self) -> None:
        found, who = self._found(textured_map(surface=True)), f"method {self.name!r}"
        require_that(bool(found.T_world_camera.is_rigid()), f"{who}: the pose is not a rigid transform")
        require_that(found.reason.strip() != "", f"{who}: the answer has no reason, expected one in words")
        if found.covariance is not None:
            lowest = float(torch.linalg.eigvalsh(found.covariance.double())[0])
            symmetric = torch.allclose(found.covariance, found.covariance.mT, rtol=1e-6)
            require_that(
                symmetric and lowest > 0, f"{who}: the covariance is not symmetric and positive definite"
            )

    def test_same_seed_gives_the_same_pose(self) -> None:
        first, second = (self._found(textured_map(surface=True)).T_world_camera.matrix() for _ in range(2))
        require_that(
            torch.equal(first, second),
            f"method {self.name!r}: two calls with one seed give different poses, expected all randomness to"
            " come from it",
        )

    def test_pose_moves_with_the_world(self) -> None:
        here, there = self._found(textured_map(surface=True)), self._found(moved_map(), moved=True)
        who = f"method {self.name!r}"
        require_that(
            there.converged, f"{who}: in a world that is moved, the image is rejected ({there.reason})"
        )
        error = _difference(there.T_world_camera, T_MOVED_WORLD @ here.T_world_camera)
        require_that(
            error <= self.largest_error,
            f"{who}: in a world that is moved, the pose is off by {error:.3g} (metres, radians) from the moved one,"
            f" expected {self.largest_error:g} or less; does it depend on the world's axes or origin?",
        )

    def test_image_of_another_scene_is_rejected(self) -> None:
        scene = textured_map(surface=True)
        found = self._localized(scene, seen(POSES[1], CAMERA, "other", seed=1).frame, POSES[1])
        require_that(
            not found.converged,
            f"method {self.name!r}: the pose of an image of another scene is accepted ({found.reason}), expected an"
            " outcome other than CONVERGED",
        )

    def test_missing_start_is_refused(self) -> None:
        if not self._part(METHODS.load).needs_start:
            return
        try:
            Localizer(textured_map(surface=True), self.name, self.config, warm_up=False)(unseen().frame)
        except InputError:
            return
        require_that(
            False, f"method {self.name!r} needs a start, but does without one, expected an InputError"
        )

    def _found(self, scene: MapWithLandmarks, moved: bool = False) -> Localization:
        truth = unseen().T_ref_camera
        return self._localized(scene, unseen().frame, T_MOVED_WORLD @ truth if moved else truth)

    def _localized(self, scene: MapWithLandmarks, frame: Any, truth: SE3) -> Localization:
        near = truth.to("cpu", torch.float64).retract(torch.tensor(START_OFF, dtype=torch.float64))
        with calling(f"method {self.name!r}"):
            localizer = Localizer(scene, self.name, self.config, warm_up=False)
            return localizer(frame, near if self._part(METHODS.load).needs_start else None)


def _difference(found: SE3, truth: SE3) -> float:
    return float((truth.to(dtype=torch.float64).inverse() @ found.to(dtype=torch.float64)).log().norm())
