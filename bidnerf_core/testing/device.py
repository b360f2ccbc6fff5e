"""Check that the steps of a localization can stay on the field's device."""

from __future__ import annotations

import copy
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, cast

import torch
from torch import Tensor

from bidnerf_core.devices import moved, without_waiting
from bidnerf_core.fields import RadianceField, levels
from bidnerf_core.localization import (
    AdamSettings,
    AdamSteps,
    BidConfig,
    ColourSettings,
    DepthLossSettings,
    DepthSettings,
    DescentSettings,
    Problem,
    RayTerms,
    SampledLoss,
    objective_of,
    pivot,
    rig,
    states_at,
)
from bidnerf_core.mapping import descend
from bidnerf_core.testing.faults import calling, require_that
from bidnerf_core.testing.scene import SCENE_BOUNDS, rgbd_views
from bidnerf_core.testing.simulated_device import DEVICE, DeviceFault, Elsewhere
from bidnerf_core.testing.textured_field import MapWithLandmarks
from bidnerf_core.testing.values import close

CHECKED_RAYS = 48


def check_steps(field: RadianceField) -> None:
    """Check that steps at each level stay on the device and reach the same pose as on the CPU.

    They must neither copy between devices nor wait for one. The device is simulated, see ``simulated_device``.
    Fields without parameters and buffers have no device and pass.
    """
    for number in range(len(levels(field))):
        expected = _first_order(_problem(field), number, None)
        with Elsewhere() as mode:
            with calling(f"{type(field).__name__}.to(device)"):
                there: Any = cast(Any, copy.deepcopy(field)).to(DEVICE)
            problem = _problem(there)
            if problem.device != DEVICE:
                return
            who = f"{type(field).__name__}, level {number}"
            with _naming(f"{who}: a step of Adam"):
                found = _first_order(problem, number, mode)
            with _naming(f"{who}: a step of Levenberg-Marquardt"):
                _second_order(problem, number, mode)
        same = close(found, expected, 1e-3)
        require_that(
            same,
            f"{who}: steps on another device lead to a different pose than on the CPU; is some state not moved?",
        )


@contextmanager
def _naming(what: str) -> Iterator[None]:
    """Turn a ``DeviceFault`` into a contract failure that names the place where it happened."""
    try:
        yield
    except DeviceFault as fault:
        require_that(
            False, f"{what}: {fault}; expected all of it on the field's device, in shapes that are known"
        )


def _problem(field: RadianceField) -> Problem:
    view = rgbd_views(coverage=False)[0]
    # Steps begin at this tangent vector (metres, radians) from the true pose.
    off = torch.tensor((0.05, -0.03, 0.04, 0.01, -0.02, 0.01), dtype=torch.float64)
    start = view.T_ref_camera.to("cpu", torch.float64).retract(off)
    return rig(MapWithLandmarks(field, SCENE_BOUNDS, None), [view], start)


def _first_order(problem: Problem, level: int, mode: Elsewhere | None) -> Tensor:
    """Return the pose (4 4) after two steps; the first fills caches, the second must not leave the device."""
    device, start = problem.device, problem.start_for("bid")
    objective = objective_of(ColourSettings(), DepthSettings(depth_scale=0.1))
    settings = DescentSettings(CHECKED_RAYS, level=level)
    generator = torch.Generator(device).manual_seed(0)
    loss = SampledLoss(problem.on_device(), objective, 0, settings, BidConfig().reach, generator)
    steps = AdamSteps(loss, pivot("scene", problem), AdamSettings(), start.to(device))
    with without_waiting():
        steps()
        if mode is None:
            steps()
        else:
            with mode.strict():
                steps()
    return steps.T.to("cpu").matrix()


def _second_order(problem: Problem, level: int, mode: Elsewhere) -> None:
    terms = RayTerms(ColourSettings(), DepthLossSettings())
    rays = terms.term(problem, CHECKED_RAYS, 0, level)
    start = moved(states_at(problem.start_for("bid-lm")[None]), DEVICE)
    with without_waiting():
        descend(start, [rays], 1)
        with mode.strict():
            descend(start, [rays], 2)
