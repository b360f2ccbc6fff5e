"""Checks of ``Backend.train``: it learns, reports, saves and stops on request, and resumes with an identical result."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Float
from safetensors.torch import load as tensors_from_bytes
from safetensors.torch import save as tensors_to_bytes
from torch import Tensor, nn

from bidnerf.testing.faults import calling, require
from bidnerf.testing.scene import DIMMED_BOUNDS, SCENE_BOUNDS, camera_rays, exposed_views, rgbd_views
from bidnerf_core.backend import Backend
from bidnerf_core.fields import RadianceField, SceneBounds, render
from bidnerf_core.frames import View
from bidnerf_core.io import pack_tensors
from bidnerf_core.training import TrainingState, TrainingStep, TrainingStopped

EXPOSURE = 0.06
"""Natural logarithm of the factor by which the images of ``check_exposure`` are made brighter or darker."""


class Recorder:
    """A ``Report`` that records progress and saved states, and stops at the step ``stop``.

    The states pass through safetensors, as in a map on disk.
    """

    def __init__(self, due: Collection[int] = (), stop: int | None = None, state: TrainingState | None = None) -> None:
        self.steps: list[TrainingStep] = []
        self.saved: list[TrainingState] = []
        self._due, self._stop, self._state = due, stop, state

    def resume(self) -> TrainingState | None:
        return self._state

    def step(self, progress: TrainingStep) -> None:
        self.steps.append(progress)

    def due(self, step: int) -> bool:
        return step in self._due

    def save(self, state: TrainingState) -> None:
        self.saved.append(TrainingState(state.step, round_trip(state.field), round_trip(state.optimizer)))

    @property
    def stopping(self) -> bool:
        return self._stop is not None and bool(self.steps) and self.steps[-1].step >= self._stop


def round_trip(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    """Return the tensors after a round trip through the safetensors format."""
    with calling("writing the tensors of a state to safetensors"):
        return tensors_from_bytes(tensors_to_bytes(pack_tensors(tensors)))


def copy_state(field: Any) -> dict[str, Tensor]:
    """Return a copy of a field's state, or an empty one if the field is not a module; another test reports this."""
    state = field.state_dict() if isinstance(field, nn.Module) else {}
    return {name: value.detach().clone() for name, value in state.items()}


def check_learning(backend: Backend, make: Callable[[], Any], config: Any, views: Sequence[View], kind: str) -> None:
    """Check that ``config.steps`` steps bring the rendered views closer to the given ones."""
    field = make()
    before = colour_error(field)
    most = 0.8 * before  # the squared error must fall by a fifth
    _train(backend, field, views, config, Recorder(), f"on {kind} views")
    after = colour_error(field)
    require(
        f"{type(backend).__name__}.train on {kind} views",
        (
            after <= most,
            f"{config.steps} steps took the squared error of colour from {before:.4g} to {after:.4g}, expected {most:.4g} or"
            " less; does the recipe change the field that it is given? does the test's config suffice?",
        ),
    )


def check_exposure(backend: Backend, config: Any) -> None:
    """Check that images that are brighter or darker than the others do not make the field brighter or darker.

    A field is trained with alternately brighter and darker images, and another one with the exposures
    exchanged. If the two fields differ as the images do, exposure ended up in the field. A field that
    learns slowly shows little difference.
    """
    # The exposures of the images can be learned within 100 steps. The share of them that ends up in the field is above
    # 0.1 for recipes that ignore exposure, and 0.01 for recipes that learn it.
    config, most = replace(config, steps=max(config.steps, 100)), 0.06
    fields = []
    for log_gain in (EXPOSURE, -EXPOSURE):
        with calling(f"{type(backend).__name__}.build"):
            fields.append(backend.build(config, DIMMED_BOUNDS))
        _train(backend, fields[-1], exposed_views(log_gain), config, Recorder(), "on RGB views of different exposure")
    found = []
    for number, view in enumerate(exposed_views(0.0)):
        bright, dark = (render_training_view(field, view, DIMMED_BOUNDS) for field in fields)
        ratio = (bright * dark).sum() / dark.square().sum().clamp(min=1e-12)
        found.append((-1) ** number * math.log(max(float(ratio), 1e-6)) / (2 * EXPOSURE))
    share = sum(found) / len(found)
    require(
        f"{type(backend).__name__}.train",
        (
            share <= most,
            f"{share:.0%} of the images' exposures went into the colours of the field, expected {most:.0%} or less; train with"
            " bidnerf_core.training.Supervision, which learns the exposure of each image beside the field (its fit, step and"
            " loss do)",
        ),
    )


def check_reports(backend: Backend, total: int, report: Recorder, after: dict[str, Tensor]) -> None:
    """Check that all ``total`` steps were reported in order and states saved exactly when due, the last with the trained field.

    ``report`` requested states after the first, middle and last step; ``after`` is the state of the trained field.
    """
    due, who = sorted({1, total // 2, total}), f"{type(backend).__name__}.train"
    steps = [(progress.step, progress.total) for progress in report.steps]
    odd = [p for p in report.steps if not (math.isfinite(p.loss) and math.isfinite(p.psnr))]
    saved = [state.step for state in report.saved]
    require(
        who,
        (
            steps == [(i + 1, total) for i in range(total)],
            f"report.step was called with {_shortly(steps)}, expected (1, {total}) to ({total}, {total}), once per step",
        ),
        (not odd, f"reported a loss or PSNR that is not finite: {odd[:1]}"),
        (
            saved == due,
            f"saved after steps {saved}, expected {due}: exactly when report.due(step) is True",
        ),
    )
    _require_same(
        report.saved[-1].field,
        after,
        who,
        "the state saved after the last step is not that of the trained field",
    )


def check_resuming(
    backend: Backend, make: Callable[[], Any], config: Any, before: dict[str, Tensor], after: dict[str, Tensor]
) -> None:
    """Check that training stopped midway, by ``TrainingStopped``, and then resumed gives a bitwise identical result.

    ``before`` and ``after`` are the states of a field around an uninterrupted training.
    """
    who, middle = f"{type(backend).__name__}.train", config.steps // 2
    second, third = make(), make()
    for field in (second, third):  # another test checks whether builds differ
        field.load_state_dict(before)
    report = Recorder(stop=middle)
    stop = f"report.stopping was set after step {middle}"
    try:
        _train(backend, second, rgbd_views(), config, report, "")
    except TrainingStopped as stopped:
        require(who, (stopped.step == middle, f"TrainingStopped says step {stopped.step}, but {stop}"))
    else:
        require(who, (False, f"did not stop when {stop}, expected TrainingStopped"))
    saved = [state.step for state in report.saved]
    require(
        who,
        (saved == [middle], f"stopped after step {middle}, saved after steps {saved}, expected [{middle}]"),
    )
    rest = Recorder(state=report.saved[0])
    _train(backend, third, rgbd_views(), config, rest, "resumed")
    steps = [progress.step for progress in rest.steps]
    require(
        who,
        (
            steps == list(range(middle + 1, config.steps + 1)),
            f"resumed after step {middle}, it reported steps {_shortly(steps)}, expected {middle + 1} to {config.steps}",
        ),
    )
    _require_same(
        third.state_dict(),
        after,
        who,
        "a resumed training arrives elsewhere than an uninterrupted one, expected the same bits; is all state in"
        " state_dict, and all randomness from the saved generator?",
    )


def colour_error(field: RadianceField) -> float:
    """Return the mean squared colour error over all pixels of the training views."""
    found = [render_training_view(field, view, SCENE_BOUNDS) for view in rgbd_views()]
    seen = torch.cat([view.frame.rgb.reshape(-1, 3) for view in rgbd_views()])
    return float((torch.cat(found) - seen).square().mean())


def render_training_view(field: RadianceField, view: View, bounds: SceneBounds) -> Float[Tensor, "r 3"]:
    """Return the field's colours at all pixels of a view."""
    with torch.no_grad(), calling(f"render by {type(field).__name__}"):
        return render(field, camera_rays(view.T_ref_camera.to(torch.float32)), bounds.background).rgb


def _train(
    backend: Backend, field: RadianceField, views: Sequence[View], config: Any, report: Recorder, how: str
) -> None:
    with calling(f"{type(backend).__name__}.train {how}".rstrip(), passing=TrainingStopped):
        backend.train(field, views, config, report)


def _require_same(found: dict[str, Tensor], expected: dict[str, Tensor], who: str, fault: str) -> None:
    require(
        who,
        (
            found.keys() == expected.keys(),
            f"{fault}: the tensors are {sorted(found)}, expected {sorted(expected)}",
        ),
        *(
            (
                name in found and torch.equal(found[name].cpu(), value.cpu()),
                f"{fault} (tensor {name!r} differs)",
            )
            for name, value in expected.items()
        ),
    )


def _shortly(items: list[Any]) -> str:
    return str(items) if len(items) <= 4 else f"[{items[0]}, {items[1]}, ... {items[-1]}] ({len(items)} in all)"
