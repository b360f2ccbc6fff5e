"""Bundled methods, detectors and faults fulfil the contracts, and the contracts refuse what breaks them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from jaxtyping import Float
from torch import Generator, Tensor

from bidnerf.evaluation import FAULTS
from bidnerf.testing import (
    BOUNDS,
    FaultContract,
    FeaturesContract,
    MethodContract,
    PoserContract,
    ReaderContract,
    training_views,
)
from bidnerf_core.datasets import (
    READERS,
    Capture,
    DatasetOptions,
    Reader,
    capture_of,
    photos_below,
    write_transforms,
)
from bidnerf_core.frames import Frame, View
from bidnerf_core.geometry import SE3
from bidnerf_core.localization import AutoConfig, Localization, Outcome, Problem, find_method, settings_of
from bidnerf_core.mapping import SIFT, Keypoints
from bidnerf_core.registry import registered
from optional import require

QUICK = AutoConfig(points=1000, hypotheses=64, rounds=1, refine_steps=0, fused_rays=128)
FEW = {"rays": 256, "max_steps": 60, "learning_rate": 0.08, "decay": 0.5, "decay_steps": 20, "depth_weight": 0.3}


class TestSift(FeaturesContract):
    name = "sift"


class TestAuto(MethodContract):
    name, config = "auto", QUICK


class TestBid(MethodContract):
    name, config = "bid", settings_of("bid", FEW)
    largest_error = 0.05


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a ``transforms.json``."""
    folder = tmp_path_factory.mktemp("capture")
    write_transforms(folder, {"train": list(training_views())}, BOUNDS.background)
    return folder


@pytest.mark.parametrize("name", FAULTS)
def test_every_bundled_fault_fulfils_the_contract(name: str) -> None:
    assert_fulfilled(FaultContract, name=name)


def assert_fulfilled(contract: type, **attributes: Any) -> None:
    subject = type("Subject", (contract,), attributes)()
    for name in (name for name in dir(contract) if name.startswith("test_")):
        getattr(subject, name)()


def fault_of(contract: type, test: str, **attributes: Any) -> str:
    """Return the sentence with which a test of a contract fails."""
    with pytest.raises(AssertionError) as caught:
        getattr(type("Subject", (contract,), attributes)(), test)()
    return str(caught.value)


class Converting(Reader):
    """The reader of ``transforms.json`` with a mistake in its conversions."""

    expected = "transforms.json"

    def __init__(self, mistake: Any) -> None:
        self.mistake = mistake

    def recognises(self, path: Path) -> bool:
        return READERS["transforms"].recognises(path)

    def read(self, path: Path, options: DatasetOptions) -> Capture:
        capture = options.open(path, [READERS["transforms"]])
        mistaken = capture_of([self.mistake(view) for view in capture.views("train")], path, ("train",))
        return replace(mistaken, background=capture.background)


OPENGL = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))


def turned(view: View, turn: Tensor) -> View:
    return replace(view, T_ref_camera=SE3(view.T_ref_camera.rotation @ turn, view.T_ref_camera.translation))


class Deaf(Converting):
    """A reader that ignores its options."""

    def read(self, path: Path, options: DatasetOptions) -> Capture:
        return super().read(path, DatasetOptions())


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda T: SE3(T.rotation, 3 * T.translation), None),  # the unit is arbitrary
        (lambda T: T.inverse(), "is off by"),
        (lambda T: SE3(T.rotation @ OPENGL, T.translation), "x right, y down and z forward"),
    ],
)
def test_posers_are_held_to_the_true_poses(
    monkeypatch: pytest.MonkeyPatch, change: Callable[[SE3], SE3], says: str | None
) -> None:
    def find_poses(
        photos: Any, out: Any, camera: Any = None, overwrite: bool = False, *, reuse: bool = False
    ) -> SimpleNamespace:
        """Write the true poses, changed."""
        files = photos_below(Path(photos))
        posed = zip(files, PoserContract.poses, strict=True)
        views = [View(Frame.open(file, camera=camera), change(T)) for file, T in posed]
        write_transforms(Path(out), {"train": views})
        return SimpleNamespace(placed=len(files))

    monkeypatch.setitem(registered, ("posers", "known"), find_poses)
    test = "test_dataset_has_the_poses_of_the_photos"
    if says is None:
        assert_fulfilled(PoserContract, name="known")
    else:
        assert says in fault_of(PoserContract, test, name="known")


def shifted(rgb: Float[Tensor, "h w 3"]) -> Keypoints:
    """Keypoints at places that do not depend on what the image shows."""
    found = SIFT(rgb)
    return replace(found, pixels=found.pixels[torch.randperm(len(found))])


def credulous(problem: Problem, config: AutoConfig, seed: int) -> Localization:
    """Accept one pose for every image."""
    pose = SE3.identity()
    return Localization(pose, Outcome.CONVERGED, "seen", 0, 0.0, 0.0, "mistaken", SE3.stack([pose]), torch.zeros(1))


def in_place(frame: Frame, size: float, generator: Generator) -> Frame:
    require(frame.depth).mul_(size)
    return frame


def solved_by(solve: Any) -> Any:
    return replace(find_method("auto"), solve=solve)


def changed_by(change: Any) -> Any:
    return replace(FAULTS.load("exposure"), change=change)


@pytest.mark.parametrize(
    ("group", "contract", "mistaken", "test", "says"),
    [
        (
            "readers",
            ReaderContract,
            Converting(lambda view: turned(view, OPENGL)),
            "axes_are_those_of_opencv",
            "x right, y down and z",
        ),
        (
            "readers",
            ReaderContract,
            Converting(lambda view: replace(view, frame=replace(view.frame, depth=1000 * require(view.frame.depth)))),
            "depth_has_the_unit_of_the_poses",
            "times the depth that",
        ),
        (
            "readers",
            ReaderContract,
            Converting(lambda view: turned(view, 1.1 * torch.eye(3, dtype=torch.float64))),
            "poses_are_rigid",
            "not a rigid transform",
        ),
        (
            "readers",
            ReaderContract,
            Deaf(lambda view: view),
            "background_is_the_one_that_is_asked_for",
            "background is",
        ),
        ("features", FeaturesContract, shifted, "keypoints_move_with_the_image", "expected"),
        ("features", FeaturesContract, shifted, "same_image_gives_the_same_keypoints", "expected"),
        (
            "features",
            FeaturesContract,
            lambda rgb: Keypoints(torch.rand(20, 2), torch.ones(20), torch.zeros((20, 8), dtype=torch.uint8)),
            "blank_image_has_no_keypoints",
            "expected",
        ),
        ("methods", MethodContract, solved_by(credulous), "image_of_another_scene_is_rejected", "scene is accepted"),
        ("methods", MethodContract, solved_by(credulous), "pose_is_found", "is off by"),
        (
            "methods",
            MethodContract,
            solved_by(
                lambda *given: replace(
                    credulous(*given), T_world_camera=SE3.identity().retract(1e-3 * torch.randn(6).double())
                )
            ),
            "same_seed_gives_the_same_pose",
            "different poses",
        ),
        ("faults", FaultContract, changed_by(in_place), "given_image_is_left_alone", "expected"),
        (
            "faults",
            FaultContract,
            changed_by(lambda frame, size, _: replace(frame, rgb=(frame.rgb + (size - 1) * torch.rand(1)).clamp(0, 1))),
            "same_seed_gives_the_same_image",
            "expected",
        ),
    ],
)
def test_a_mistake_of_a_plugin_is_named(
    capture: Path, monkeypatch: pytest.MonkeyPatch, group: str, contract: type, mistaken: Any, test: str, says: str
) -> None:
    monkeypatch.setitem(registered, (group, "mistaken"), mistaken)
    assert says in fault_of(contract, f"test_{test}", name="mistaken", folder=capture, config=QUICK)
