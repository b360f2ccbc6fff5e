"""The tracker on a closed-form scene: accuracy, loss and recovery, times, state, threads."""

from __future__ import annotations

import functools
import json
import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from bidnerf import Localizer, Outcome, Tracker
from bidnerf.results import normalized_error_squared, pose_error
from bidnerf.testing import GROUND_CAMERA as CAMERA
from bidnerf.testing import textured_map
from bidnerf.testing import textured_view as view
from bidnerf_core.frames import Frame
from bidnerf_core.geometry import SE3
from bidnerf_core.io import read_tensors_and_metadata
from bidnerf_core.localization import AutoConfig, Posterior
from bidnerf_core.localization.tracking.motion import Clock

# Inside: flow, and the parts of a state that only rare sequences fill
from bidnerf_core.localization.tracking.points import correlate
from bidnerf_core.localization.tracking.state import TrackerState, invert_correction
from bidnerf_core.mapping import Landmarks, Normal, States, prior
from bidnerf_core.maps import TrackerConfig
from conditions import ground_landmarks, with_landmarks
from flights import (
    FRAMES,
    INTERVAL,
    assert_honest,
    assert_right,
    covered,
    flight,
    flight_pose,
    localizer,
    tracked,
    without_depth,
)
from localizations import CHI2_99, assert_covered
from optional import require
from refusals import refused

Flight = list[tuple[float, Frame, SE3]]


@pytest.mark.parametrize("depth", [True, False], ids=["rgb-d", "rgb"])
def test_a_sequence_is_tracked_with_honest_covariances(depth: bool) -> None:
    frames = [(t, frame if depth else without_depth(frame), T) for t, frame, T in flight()]
    answers = tracked(frames)
    assert_right(answers, frames)
    assert {answer.method for answer in answers} == {"track"}
    squared = [
        float(normalized_error_squared(a.T_world_camera, T, a.covariance))
        for a, (_, _, T) in zip(answers, frames, strict=True)
        if a.covariance is not None
    ]
    assert len(squared) == FRAMES
    assert sum(value < CHI2_99 for value in squared) >= FRAMES - 1


CHANGED: dict[str, Callable[[Flight], Flight]] = {
    "times that decrease": lambda frames: frames[::-1],
    "neighbours exchanged": lambda frames: [frames[n] for n in (0, 1, 2, 4, 3, 5, 7, 6, 8, 9)],
    "depth that stops midway": lambda frames: [
        (t, f if n < 6 else without_depth(f), T) for n, (t, f, T) in enumerate(frames)
    ],
}


@pytest.mark.parametrize("changed", CHANGED)
def test_a_sequence_is_tracked_in_any_order_and_with_depth_or_without(changed: str) -> None:
    frames = CHANGED[changed](flight())
    assert_right(tracked(frames), frames)


@pytest.mark.parametrize("depth", [True, False], ids=["rgb-d", "rgb"])
def test_a_covered_camera_is_reported_at_once_and_the_way_is_found_again(depth: bool) -> None:
    frames = [(t, frame if depth else without_depth(frame), T) for t, frame, T in flight()]
    frames = [(t, covered(f) if 2 <= i < 6 else f, T) for i, (t, f, T) in enumerate(frames)]
    tracker = Tracker(localizer())
    answers = tracked(frames[:6], tracker)
    assert [answer.converged for answer in answers] == [True] * 2 + [False] * 4
    assert tracker.lost_frames == 4
    assert "lost for 4 frames" in answers[-1].reason
    sizes = [float(answer.covariance.diagonal().sum()) for answer in answers[1:] if answer.covariance is not None]
    assert sizes == sorted(sizes)
    assert len(sizes) == 5
    assert_right(tracked(frames[6:], tracker)[2:], frames[8:])
    assert tracker.tracking


@pytest.mark.parametrize("count", [4, 5])
def test_frames_that_show_nothing_do_not_delay_the_search(count: int) -> None:
    tracker = Tracker(localizer())
    frames = [(t, covered(f) if 3 <= i < 3 + count else f, T) for i, (t, f, T) in enumerate(flight())]
    answers = tracked(frames[: 4 + count], tracker)
    assert [answer.converged for answer in answers[3:]] == [False] * count + [True]


def test_frames_that_come_slowly_are_all_searched() -> None:
    """Lost by images of another place."""
    count = 5
    generator = torch.Generator().manual_seed(0)
    tracker, frames = Tracker(localizer()), flight()
    slow = [(0.5 * i, f, T) for i, (_, f, T) in enumerate(frames)]
    elsewhere = [
        (t, replace(without_depth(f), rgb=torch.rand(f.rgb.shape, generator=generator)), T)
        for t, f, T in slow[2 : 2 + count]
    ]
    answers = tracked([*slow[:2], *elsewhere, *slow[2 + count : 3 + count]], tracker)
    assert [answer.converged for answer in answers[2:]] == [False] * count + [True]


def test_a_camera_that_is_carried_elsewhere_is_lost_and_found() -> None:
    """The motion cannot be foreseen, so no answer may follow the prediction."""
    elsewhere = [
        (t, view(flight_pose(n + 30), f"far {n}").frame, flight_pose(n + 30))
        for n, (t, _, _) in enumerate(flight()[3:6], 3)
    ]
    frames = [*flight()[:3], *elsewhere]
    answers = tracked(frames)
    assert_honest(answers, frames)
    assert_right(answers[5:], frames[5:])
    counts = [answer.reason.count("landmark inliers") for answer in answers]
    assert (counts[0], max(counts)) == (1, 1)  # those of the pose, and not of the tracker's own measurement as well


def test_in_a_foreign_scene_no_pose_is_accepted_and_odometry_continues() -> None:
    """Over ground that the map does not show, the motion between frames is still measured."""
    tracker = Tracker(localizer())
    assert_right(tracked(flight()[:3], tracker), flight()[:3])
    foreign = [tracker(view(flight_pose(n), f"{n}", seed=9).frame, INTERVAL * n) for n in range(3, 8)]
    assert not any(answer.converged for answer in foreign)
    for n in range(1, 5):
        moved = foreign[n - 1].T_world_camera.inverse() @ foreign[n].T_world_camera
        error = pose_error(moved, flight_pose(n + 2).inverse() @ flight_pose(n + 3))
        assert "bridged by odometry" in foreign[n].reason
        assert float(error.translation) < 0.02
        assert float(error.rotation_deg) < 0.8
    sizes = [float(a.covariance.diagonal().sum()) for a in foreign if a.covariance is not None]
    assert sizes == sorted(sizes)


def test_depth_of_another_unit_is_left_out() -> None:
    """Feet read as metres after the first frame: each frame is tracked by its colours, and says so."""
    frames = Flight(flight()[:1])
    for t, frame, T in flight()[1:4]:
        frames.append((t, replace(frame, depth=3.28 * require(frame.depth)), T))
    answers = tracked(frames)
    assert_right(answers, frames)
    assert all("without depth: it is 3.2" in answer.reason for answer in answers[1:])


def test_repeated_frames_do_not_make_it_more_certain() -> None:
    """The errors of the map are the same in each of them."""
    tracker = Tracker(localizer())
    tracked(flight()[:3], tracker)
    time, frame, truth = flight()[3]
    answers = [tracker(frame, time) for _ in range(10)]
    assert_right(answers, [(time, frame, truth)] * 10)
    first, last = (answers[i].covariance for i in (0, -1))
    assert float(require(last).diagonal()[:3].sum()) > 0.5 * float(require(first).diagonal()[:3].sum())


@pytest.mark.parametrize("known", [0, 3], ids=["none", "every third"])
def test_time_stamps_may_be_missing(known: int) -> None:
    tracker = Tracker(localizer(), TrackerConfig(frame_seconds=0.1))
    frames = flight()
    answers = [tracker(f, t if known and i % known == 0 else None) for i, (t, f, _) in enumerate(frames)]
    assert_right(answers, frames)


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("given", ["photo.jpg", [[0.0]], None])
def test_anything_but_a_frame_is_refused(given: Any) -> None:
    with refused(found=f"frame is a {type(given).__name__}"):
        Tracker(localizer())(given, 0.0)


@pytest.mark.usefixtures("unchecked")
def test_a_time_that_is_no_number_is_refused_and_changes_nothing() -> None:
    tracker = Tracker(localizer())
    tracked(flight()[:2], tracker)
    wrong: list[Any] = [math.nan, math.inf, "5", 10**400, True, [1.0]]
    for time in wrong:
        with refused(found=f"time of the frame is '{str(time)[:40]}'", expected="seconds or None"):
            tracker(flight()[2][1], time)
    assert_right(tracked(flight()[2:4], tracker), flight()[2:4])


def test_a_changed_image_size_is_no_obstacle() -> None:
    frames = flight()[:6]
    small = frames[3][1]
    camera = small.intrinsics.scaled(0.75)
    rgb = torch.nn.functional.interpolate(small.rgb.permute(2, 0, 1)[None], (camera.height, camera.width), mode="area")[
        0
    ].permute(1, 2, 0)
    frames[3] = (frames[3][0], replace(small, rgb=rgb, depth=None, intrinsics=camera), frames[3][2])
    answers = tracked(frames)
    assert_honest(answers, frames)
    assert_right(answers[:3] + answers[5:], frames[:3] + frames[5:])


@pytest.mark.parametrize("lost", [False, True])
def test_a_saved_state_continues_bit_for_bit(tmp_path: Path, lost: bool) -> None:
    tracker, other = Tracker(localizer()), Tracker(localizer())
    tracked(flight()[:3], tracker)
    if lost:
        tracker(covered(flight()[3][1]), 3 * INTERVAL)
    tracker.save(tmp_path / "state")
    other.save(tmp_path / "fresh")
    other.restore(tmp_path / "state")
    assert other.lost_frames == lost
    one, two = tracked(flight()[4:6], tracker), tracked(flight()[4:6], other)
    for a, b in zip(one, two, strict=True):
        assert torch.equal(a.T_world_camera.matrix(), b.T_world_camera.matrix())
        assert torch.equal(require(a.covariance), require(b.covariance))
    other.restore(tmp_path / "fresh")
    assert not other.tracking
    assert other.lost_frames == 0


def test_files_that_hold_no_state_are_refused(tmp_path: Path) -> None:
    tracker = Tracker(localizer())
    (tmp_path / "text").write_bytes(b"no state")
    (tmp_path / "empty").touch()
    for name, found in (("text", "not readable"), ("empty", "not readable"), ("missing", "no such file")):
        with refused(where=tmp_path / name, found=found, expected="a file written by Tracker.save"):
            tracker.restore(tmp_path / name)


def test_a_state_with_damaged_numbers_or_tensors_is_refused_and_changes_nothing(tmp_path: Path) -> None:
    tracker = Tracker(localizer())
    tracked(flight()[:3], tracker)
    path = tmp_path / "state"
    tracker.save(path)
    tensors, metadata = read_tensors_and_metadata(path, "a state")
    content = json.loads(metadata["bidnerf"])
    rotation, noise = "motion.T_world_camera.rotation", "motion.noise"
    impossible = "the numbers are impossible"
    numbers: list[tuple[str, Any, str, str]] = [
        ("frames", "three", ": frames", "found 'three'"),
        ("age", -1, "", impossible),
        ("interval", 0, "", "no field 'interval'"),
        ("clock.interval", 0.0, "", impossible),
        ("motion.reach", 0.0, "", impossible),
        ("motion.reach", None, ": motion: reach", "found None"),
        ("motion.noise", 1.0, ": motion: noise", "found 1.0"),
    ]
    changed: list[tuple[dict[str, torch.Tensor], str, str]] = [
        ({noise: tensors[noise].float()}, "", "motion.noise is torch.float32"),
        ({noise: -tensors[noise]}, "", impossible),
        ({noise: tensors[noise] * torch.nan}, "", "motion.noise holds NaN"),
        ({rotation: 2 * tensors[rotation]}, "", impossible),
        ({"points.landmark": tensors["points.landmark"][1:].clone()}, "", "points.landmark is torch.int64"),
        ({"points.deviations": -tensors["points.deviations"]}, "", "points.deviations is -"),
    ]
    for name, part in tensors.items():
        if name.startswith(("points.", "motion.")) and "T_world" not in name:
            place = ": ".join(["", *name.split(".")])
            changed.append(
                (
                    {name: part[None].contiguous()},
                    place,
                    f"found {part.dtype} {[1, *part.shape]}",
                )
            )

    def refuses(tensors: dict[str, torch.Tensor], state: Any, field: str, found: str) -> None:
        save_file(tensors, path, {"bidnerf": json.dumps(content | {"state": state})})
        with refused(where=f"{path}{field}", found=found):
            tracker.restore(path)
        assert tracker.tracking

    for place, value, field, found in numbers:
        state = json.loads(json.dumps(content["state"]))
        *parents, last = place.split(".")
        functools.reduce(dict.__getitem__, parents, state)[last] = value
        refuses(tensors, state, field, found)
    for parts, field, found in changed:
        refuses(tensors | parts, content["state"], field, found)
    without = {name: tensor for name, tensor in tensors.items() if name != "points.pixels"}
    refuses(without, content["state"], "", "no tensor 'points.pixels'")


def test_trackers_in_threads_share_a_localizer() -> None:
    """Each gives what it gives alone."""
    ways = [flight()[:3], flight()[::-1][:3]]
    alone = [tracked(frames) for frames in ways]
    with ThreadPoolExecutor(2) as pool:
        together = list(pool.map(tracked, ways))
    for a, b in zip(alone, together, strict=True):
        for one, two in zip(a, b, strict=True):
            assert torch.equal(one.T_world_camera.matrix(), two.T_world_camera.matrix())


def test_a_map_without_landmarks_is_tracked_by_depth() -> None:
    frames = flight()
    answers = tracked(frames, Tracker(localizer(landmarks=False)))
    assert_honest(answers, frames)
    assert sum(answer.converged for answer in answers) >= FRAMES - 2
    assert (
        max(
            float(pose_error(a.T_world_camera, T).translation)
            for a, (_, _, T) in zip(answers, frames, strict=True)
            if a.converged
        )
        < 0.03
    )


def test_the_right_shape_with_other_colours_is_not_accepted() -> None:
    tracker = Tracker(localizer(landmarks=False), start=flight_pose(0))
    (time, right, _), (later, other, _) = flight()[:2]
    assert tracker(right, time).converged
    assert tracker(replace(other, rgb=1 - other.rgb), later).outcome is Outcome.COLOUR_MISMATCH


def depth_only(frame: Frame) -> Frame:
    return replace(frame, rgb=torch.zeros_like(frame.rgb), has_colour=False)


def test_an_image_without_depth_is_tracked_by_colour_in_a_map_without_landmarks() -> None:
    bare = replace(textured_map(), landmarks=None)
    off = torch.tensor([0.01, -0.01, 0.01, 0.01, 0.01, -0.02], dtype=torch.float64)
    frames = [(t, without_depth(frame), T) for t, frame, T in flight()[:1]]
    tracker = Tracker(Localizer(bare, config=AutoConfig(landmarks=False)), start=flight_pose(0).retract(off))
    answers = tracked(frames, tracker)
    assert_right(answers, frames)
    assert float(pose_error(answers[0].T_world_camera, flight_pose(0)).translation) < 0.01


def test_a_wrong_start_is_replaced_by_a_search() -> None:
    frames = flight()[:3]
    answers = tracked(frames, Tracker(localizer(), start=flight_pose(60)))
    assert_right(answers, frames)


def test_frames_without_colours_are_tracked_between_photos() -> None:
    """The ground determines the height and the tilts; where the rest is known well enough, a pose is accepted."""
    frames = [(t, depth_only(f) if n % 3 else f, T) for n, (t, f, T) in enumerate(flight())]
    answers = tracked(frames, Tracker(localizer()))
    assert_right(answers[slice(0, None, 3)], frames[slice(0, None, 3)])
    assert_honest(answers, frames)
    between = [(answers[n], frames[n][2]) for n in range(10) if n % 3]
    assert sum(answer.converged for answer, _ in between) >= 2
    for answer, truth in between:
        assert "measured points lie on the surface" in answer.reason
        assert answer.outcome in (Outcome.CONVERGED, Outcome.IMPRECISE)
        assert_covered(answer.T_world_camera, truth, answer.covariance)


def test_a_shape_without_a_time_is_not_accepted() -> None:
    tracker = Tracker(localizer())
    tracked(flight()[:4], tracker)
    answer = tracker(depth_only(flight()[4][1]))
    assert answer.outcome is Outcome.IMPRECISE
    assert "without a time stamp" in answer.reason


def test_shape_alone_neither_begins_a_sequence_nor_corrects_a_vague_prediction() -> None:
    """A wall would fit any other wall."""
    tracker = Tracker(localizer())
    answers = tracked([(t, depth_only(f), T) for t, f, T in flight()[:2]], tracker)
    assert [answer.outcome for answer in answers] == [Outcome.TOO_FEW_MATCHES] * 2
    assert not answers[1].T_world_camera.is_finite  # rather than the identity, which is a pose
    assert_right(tracked(flight()[2:3], tracker), flight()[2:3])
    late = tracker(depth_only(flight()[3][1]), flight()[3][0] + 5.0)
    assert late.outcome is Outcome.UNDETERMINED
    assert "too uncertain" in late.reason
    assert torch.equal(late.poses.translation[0], late.poses.translation[1])


def test_a_frame_without_colours_and_depth_is_reported() -> None:
    tracker = Tracker(localizer())
    tracked(flight()[:2], tracker)
    answer = tracker(without_depth(depth_only(flight()[2][1])), flight()[2][0])
    assert answer.outcome is Outcome.TOO_FEW_MATCHES
    assert_right(tracked(flight()[3:5], tracker), flight()[3:5])


def test_flow_of_mere_noise_is_recognised() -> None:
    generator = np.random.default_rng(0)
    noise = [(150 + 5 * generator.standard_normal((96, 128))).astype(np.uint8) for _ in range(2)]
    place = torch.tensor([[30.5, 40.5], [60.5, 20.5], [3.5, 2.5]])
    assert not bool(correlate(noise[0], noise[1], place, place).any())
    moved = np.roll(noise[0], (2, 3), (0, 1))
    assert correlate(noise[0], moved, place, place + torch.tensor([3.0, 2.0])).tolist()[:2] == [True, True]


@pytest.mark.parametrize("k1", [0.0, -0.28])
def test_a_corrected_camera_is_corrected_alike_at_another_focus_and_size(k1: float) -> None:
    stated = replace(CAMERA, fx=140.0, cx=60.0, distortion=(k1, 0.0, 0.0, 0.0))
    true = replace(CAMERA, fx=133.0, cy=50.0, distortion=(k1 + 0.02, 0.0, 0.0, 0.0))
    state = TrackerState(Clock(None, 0.1), camera=invert_correction(stated, true))
    frame = replace(flight()[0][1], intrinsics=stated)
    found = state.correct(frame).intrinsics
    assert (found.fx, found.fy, found.cx, found.cy) == pytest.approx((true.fx, true.fy, true.cx, true.cy))
    assert found.distortion == pytest.approx(true.distortion)
    refocused = state.correct(replace(frame, intrinsics=replace(stated, fx=154.0))).intrinsics
    assert refocused.fx == pytest.approx(154 * 133 / 140)
    small = state.correct(replace(frame, rgb=torch.zeros((48, 64, 3)), depth=None, intrinsics=stated.scaled(0.5)))
    assert small.intrinsics.cx == pytest.approx(true.scaled(0.5).cx)
    other = replace(frame, focal_is_approximate=True)  # of another source
    assert state.correct(other) is other


@pytest.mark.parametrize(("least", "outcome"), [(0.9, Outcome.CONVERGED), (1.0, Outcome.UNCERTAIN)])
def test_a_stated_risk_applies_to_the_confidence_of_tracked_poses(
    monkeypatch: pytest.MonkeyPatch, least: float, outcome: Outcome
) -> None:
    monkeypatch.setattr(import_module("bidnerf_core.localization.auto"), "least_confidence", lambda risk: least)
    careful = Localizer(textured_map(surface=True), config=AutoConfig(risk=0.05))
    answers = tracked(flight()[:3], Tracker(careful, start=flight_pose(0)))
    assert [answer.outcome for answer in answers] == [outcome] * 3
    assert all(0.4 < require(answer.confidence) < 1 for answer in answers)


def nothing(_: Landmarks, states: States) -> Normal:
    none = prior(states)
    return none - none


@pytest.mark.parametrize(
    ("owner", "name", "replaced"),
    [
        (Posterior, "mixture", lambda _: torch.full((6, 6), torch.inf, dtype=torch.float64)),
        (Landmarks, "__call__", nothing),
    ],
    ids=["infinite covariance", "no information"],
)
def test_landmarks_that_do_not_determine_the_pose_are_no_error(
    monkeypatch: pytest.MonkeyPatch, owner: type, name: str, replaced: Callable[..., Any]
) -> None:
    monkeypatch.setattr(owner, name, replaced)
    (answer,) = tracked(flight()[:1], Tracker(Localizer(textured_map()), start=flight_pose(0)))
    assert not answer.converged


def test_a_beginning_that_nobody_recognises_is_reported() -> None:
    tracker = Tracker(localizer())
    answer = tracker(covered(without_depth(flight()[0][1])), 0.0)
    assert (answer.T_world_camera.is_finite, answer.covariance) == (False, None)
    assert not answer.converged
    assert_right(tracked(flight()[1:3], tracker), flight()[1:3])


def test_the_state_does_not_grow(tmp_path: Path) -> None:
    """However long the sequence."""
    tracker, sizes = Tracker(localizer()), []
    to_and_fro = [flight()[n] for n in (0, 1, 2, 3, 2, 1)]
    for lap in range(3):
        for place, (_, frame, _) in enumerate(to_and_fro):
            tracker(frame, INTERVAL * (lap * len(to_and_fro) + place))
        tracker.save(tmp_path / "state")
        sizes.append((tmp_path / "state").stat().st_size)
    assert max(sizes) < 1.25 * min(sizes)


@pytest.mark.parametrize(
    ("given", "found", "expected"),
    [
        (textured_map(), "got a MapWithLandmarks", "a Localizer; Localizer(map)"),
        (3, "got a int", "a Localizer"),
    ],
)
def test_a_tracker_takes_a_localizer(given: Any, found: str, expected: str) -> None:
    with refused(where="Tracker", found=found, expected=expected):
        Tracker(given)


@pytest.mark.parametrize(
    ("approximate", "depth"),
    [(False, True), (False, False), (True, False)],
    ids=["RGB-D", "RGB", "approximate"],
)
def test_a_misstated_camera_of_the_map_is_corrected_in_all_frames_and_a_right_one_is_kept(
    approximate: bool, depth: bool
) -> None:
    localizer = Localizer(with_landmarks(ground_landmarks(scatter=0.002)))
    stated = replace(CAMERA, fx=0.97 * CAMERA.fx, fy=0.97 * CAMERA.fy, cx=CAMERA.cx + 1.5 * (not approximate))
    changes = {"intrinsics": stated, "focal_is_approximate": approximate}
    wrong = [(t, replace(f, depth=f.depth if depth else None, **changes), T) for t, f, T in flight()[:4]]
    tracker, right = Tracker(localizer), flight()[4:6]
    answers = tracked(wrong, tracker)
    assert_right(answers, wrong)
    assert [answer.focal_factor for answer in answers] == pytest.approx([1 / 0.97] * 4, rel=1e-4)
    if approximate:  # a stated one is taken for the same camera that has refocused
        answers = tracked(right, tracker)
        assert_right(answers, right)
        assert [answer.focal_factor for answer in answers] == [1, 1]
        assert [answer.intrinsics for answer in answers] == [None, None]
