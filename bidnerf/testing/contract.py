"""``BackendContract``: the requirements on every backend, with one test for each."""

from __future__ import annotations

import contextlib
import copy
import dataclasses
import json
from collections.abc import Callable, Iterator
from typing import Any, ClassVar, cast

import torch
from torch import Tensor, nn

from bidnerf.testing import field_checks, recipes
from bidnerf.testing.faults import calling, is_one_line, once, query, require
from bidnerf.testing.scene import SCENE_BOUNDS, awkward_rays, points, rgb_views, rgbd_views
from bidnerf_core.backend import backend_defects, load_backend
from bidnerf_core.devices import move_to
from bidnerf_core.fields import RadianceField, Rays, levels
from bidnerf_core.io import from_plain, to_plain


def _on_levels(check: Callable[[RadianceField], None]) -> Callable[[BackendContract], None]:
    """Return a test that runs ``check`` on all levels of an untrained and of a trained field."""

    def test(contract: BackendContract) -> None:
        for field in contract._fields():
            for level in levels(field):
                check(level)

    return test


class BackendContract:
    """Tests of a backend; to use them, derive a class whose name begins with ``Test`` and set ``backend`` or ``name``.

    ``backend`` is the object that the entry point names, ``name`` the entry point's name. ``config`` should
    be small: a few dozen steps of a few milliseconds each, enough to learn something from 6 images of 24 x 24
    pixels. By default, the default config is used with fewer steps.
    """

    backend: ClassVar[Any] = None
    name: ClassVar[str | None] = None
    config: ClassVar[Any] = None

    # The object that the entry point names.

    def test_backend_says_what_it_is(self) -> None:
        summary, who = self._backend().summary, type(self._backend()).__name__
        require(f"{who}.summary", (is_one_line(summary), f"is {summary!r}, expected one line of text"))

    def test_config_survives_json(self) -> None:
        for config in (self._backend().config_type(), self._config()):
            found = self._reread(config)
            require(
                type(config).__name__,
                (found == config, f"comes back from JSON as {found}, expected {config}"),
            )

    def test_build_gives_a_field(self) -> None:
        field = self._build()
        require(
            f"{type(self._backend()).__name__}.build",
            (
                isinstance(field, nn.Module),
                f"returned a {type(field).__name__}, expected an nn.Module, whose state_dict is what is saved",
            ),
            (
                isinstance(field, RadianceField),
                f"returned a {type(field).__name__} without query or sampler, expected both",
            ),
        )

    def test_build_is_reproducible(self) -> None:
        with torch.random.fork_rng(devices=[]):
            first, second = (self._build().state_dict() for _ in range(2))
        expected = "expected all randomness to come from a seed in the config"
        for name, value in first.items():
            require(
                f"{type(self._backend()).__name__}.build",
                (
                    torch.equal(value, second[name]),
                    f"{name!r} differs between two builds of one config, {expected}",
                ),
            )

    # The field's values, at each of its levels.

    test_query_takes_any_shape = _on_levels(field_checks.check_shapes)

    test_query_is_finite_and_in_range = _on_levels(field_checks.check_ranges)

    test_query_is_differentiable_by_position = _on_levels(
        lambda field: field_checks.check_position_derivatives(*precise(field))
    )

    test_query_is_differentiable_by_direction = _on_levels(
        lambda field: field_checks.check_direction_derivatives(*precise(field))
    )

    test_jacobian_is_the_derivative_of_query = _on_levels(lambda field: field_checks.check_jacobian(*precise(field)))

    def test_query_follows_the_dtype(self) -> None:
        for field in self._fields():
            with calling(f"{type(field).__name__}.double()"):
                doubled = copy.deepcopy(field).double()
            for level, moved in zip(levels(field), levels(cast(RadianceField, doubled)), strict=True):
                field_checks.check_precision(level, moved)

    def test_field_moves_to_a_device(self) -> None:
        if not torch.cuda.is_available():
            return
        rays = Rays.joined(awkward_rays().values())
        field = self._trained()
        with calling(f"{type(field).__name__} on CUDA"):
            moved = copy.deepcopy(field).to("cuda")
            found = field_checks.render_channels(
                cast(RadianceField, moved), move_to(rays, "cuda"), "rays on CUDA"
            ).cpu()
        require(
            type(field).__name__,
            (
                field_checks.close(found, field_checks.render_channels(field, rays, "rays"), 2e-2),
                "renders otherwise on CUDA than on the CPU",
            ),
        )

    test_query_serves_several_threads = _on_levels(field_checks.check_threads)

    # Sampling and rendering.

    test_samples_are_sorted_disjoint_and_on_the_ray = _on_levels(field_checks.check_intervals)

    test_samples_are_repeatable = _on_levels(field_checks.check_repeatable)

    test_rays_do_not_depend_on_each_other = _on_levels(field_checks.check_rays_alone)

    test_rays_that_miss_see_the_background = _on_levels(field_checks.check_background)

    test_hits_agree_with_the_density = _on_levels(field_checks.check_hits)

    def test_levels_are_fields_coarsest_first(self) -> None:
        for field in self._fields():
            field_checks.check_levels(field)

    def test_rendering_carries_gradients_to_the_pose(self) -> None:
        for level in levels(self._trained()):
            field_checks.check_pose_gradient(*precise(level))

    # Storage.

    def test_saved_field_renders_the_same(self) -> None:
        trained, fresh = self._trained(), self._build(self._reread(self._config()))
        with calling(f"{type(fresh).__name__}.load_state_dict of a saved state_dict"):
            fresh.load_state_dict(recipes.round_trip(dict(trained.state_dict())))
        loaded = frozen(fresh)
        rays = Rays.joined(awkward_rays().values())
        same = torch.equal(_answers(loaded), _answers(trained)) and all(
            torch.equal(field_checks.render_channels(a, rays, "rays"), field_checks.render_channels(b, rays, "rays"))
            for a, b in zip(levels(loaded), levels(trained), strict=True)
        )
        require(
            f"{type(fresh).__name__}, saved, rebuilt and loaded",
            (
                same,
                "it renders differently than before, expected the same bits; is some state not in state_dict (a plain"
                " attribute, a buffer with persistent=False)?",
            ),
        )

    # Training.

    def test_training_learns_from_rgbd(self) -> None:
        recipes.check_learning(self._backend(), self._build, self._config(), rgbd_views(coverage=False), "RGB-D")

    def test_training_learns_from_rgb(self) -> None:
        recipes.check_learning(self._backend(), self._build, self._config(), rgb_views(), "RGB")

    def test_training_learns_the_exposure_of_images(self) -> None:
        recipes.check_exposure(self._backend(), self._config())

    def test_training_reports_and_saves(self) -> None:
        _, _, after, report = self._training()
        recipes.check_reports(self._backend(), self._config().steps, report, after)

    def test_training_stops_and_resumes(self) -> None:
        _, before, after, _ = self._training()
        recipes.check_resuming(self._backend(), self._build, self._config(), before, after)

    # The fields that the tests build and train follow.

    def _backend(self) -> Any:
        """Return the backend. What it lacks fails every test, since each of them would fail for it in another way."""
        if self.name is not None:
            return load_backend(self.name)
        require(type(self).__name__, (self.backend is not None, "has neither backend nor name, expected one of them"))
        for defect in backend_defects(self.backend):
            require(type(self.backend).__name__, (False, defect))
        return self.backend

    def _config(self) -> Any:
        if self.config is not None:
            return self.config
        return dataclasses.replace(self._backend().config_type(), steps=40)

    def _reread(self, config: Any) -> Any:
        """Return the config as it would be read back from a map on disk."""
        with calling(f"{type(config).__name__} to JSON and back"):
            text = json.dumps(to_plain(config, "config"), allow_nan=False)
            return from_plain(self._backend().config_type, json.loads(text), "config")

    def _build(self, config: Any = None) -> Any:
        """Build the untrained field. Values of wrong shapes fail every test that needs the field, as a missing member does."""
        with calling(f"{type(self._backend()).__name__}.build"):
            field = self._backend().build(self._config() if config is None else config, SCENE_BOUNDS)
        if isinstance(field, RadianceField):
            query(field, *points(2), "2 points")
        return field

    def _training(self) -> tuple[Any, dict[str, Tensor], dict[str, Tensor], recipes.Recorder]:
        """Train on RGB-D views, once per test class. Return the field, frozen as in a loaded map, its states and the report."""

        def train() -> tuple[Any, dict[str, Tensor], dict[str, Tensor], recipes.Recorder]:
            field, total = self._build(), self._config().steps
            before = recipes.copy_state(field)
            report = recipes.Recorder(due={1, total // 2, total})
            with calling(f"{type(self._backend()).__name__}.train"):
                self._backend().train(field, rgbd_views(), self._config(), report)
            return frozen(field), before, recipes.copy_state(field), report

        return once(self, train)

    def _trained(self) -> Any:
        return self._training()[0]

    def _fields(self) -> Iterator[Any]:
        yield frozen(self._build())
        yield self._trained()


def frozen(field: Any) -> Any:
    return field.requires_grad_(False).eval() if isinstance(field, nn.Module) else field


def precise(field: RadianceField) -> tuple[RadianceField, torch.dtype]:
    """Return a float64 copy of the field if it supports that dtype, else the field itself, and the dtype to use."""
    with contextlib.suppress(Exception):  # ``test_query_follows_the_dtype`` reports it
        doubled: Any = copy.deepcopy(field)
        # A level need not be a module itself; then the modules that it holds are converted.
        for part in [doubled] if isinstance(doubled, nn.Module) else vars(doubled).values():
            if isinstance(part, nn.Module):
                part.double()
        positions, directions = (x.double() for x in points(2))
        if query(doubled, positions, directions, "points").density.dtype == torch.float64:
            return doubled, torch.float64
    return field, torch.float32


def _answers(field: RadianceField) -> Tensor:
    return field_checks.to_channels(query(field, *points(256), "points"))
