"""Answers of ``auto`` by landmarks to images with every fault of the camera and of the image, on exact scenes.

    python tests/localization/pinned_landmarks.py record tests/localization/pinned/landmarks.json
    (change the code)
    python tests/localization/pinned_landmarks.py compare tests/localization/pinned/landmarks.json

A row has the errors against the true pose, and what the answer says of the image: its outcome, whose camera took it, and whether
the camera moved while its rows were exposed. ``"debatable"`` marks an answer that is not the one to wish for, such as a right pose
that is rejected: it may become any other but an accepted and wrong one. ``"wrong"`` marks one that is accepted and wrong.
"""

from __future__ import annotations

import argparse
import functools
import json
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from bidnerf_core import SE3, Intrinsics, Localization, View
from bidnerf_core.evaluation import faulty
from bidnerf_core.localization import AutoConfig, LandmarkMatcher, Problem, rig, settings_of
from bidnerf_core.mapping import Features, LandmarkMap, build_landmarks
from bidnerf_core.results import pose_error
from bidnerf_core.testing import textured_field
from landmark_scene import PINHOLE, Points, looking_in, ring
from problems import localize

POSES = (looking_in(0.43, 0.45, 3.6), looking_in(0.2, 0.6, 4.0), looking_in(0.8, -0.2, 4.4))
COPY = SE3.exp(torch.tensor([30.0, 5.0, -20.0, 0.2, -0.9, 0.4], dtype=torch.float64))
QUICK = settings_of(
    "auto",
    {"points": 500, "hypotheses": 32, "rounds": 1, "refine_steps": 0, "fused_rays": 128}
    | {"coarse_steps": 1, "coarse_rays": 64, "fine_steps": 1, "fine_rays": 64},
)
NOT_RENDERED = replace(QUICK, fused_rays=0)
ACCEPTED = "converged"
COLOUR_NOISE = 0.02
RIGHT = 0.05, 2.0
"""Largest error of a pose that counts as right: metres and degrees, at distances of 1.7 to 4.4 m."""


@dataclass(frozen=True, eq=False)
class Case:
    """An image, or a rig, to localize, and what it is."""

    name: str  # scene/fault/frame
    problem: Problem
    truth: SE3
    config: AutoConfig = QUICK
    own: str = "given"  # whose camera took the image: the "given" one, the "map"'s, or "another"
    moved: bool = False  # whether the camera moved while the rows of the image were exposed
    accepted: bool = True  # whether there is a right answer

    def row(self) -> dict[str, Any]:
        found = localize(self.problem, "auto", self.config)
        error = pose_error(found.T_world_camera, self.truth)
        row = {
            "outcome": str(found.outcome),
            "camera": self.camera_of(found),
            "motion": bool(getattr(found.diagnostics, "rolling_shutter", False)),
            "metres": round(float(error.translation), 5),
            "degrees": round(float(error.rotation_deg), 4),
        }
        if found.converged and found.covariance is not None:
            row["chi2"] = round(squared_distance(found, self.truth), 2)
        return row

    def camera_of(self, found: Localization) -> str:
        """Return whose intrinsics the answer has: the "given" ones, the "map"'s, or "estimated" ones."""
        if found.intrinsics is None:
            return "given"
        matcher = self.problem.matcher
        is_map = matcher is not None and found.intrinsics in matcher.landmarks.cameras
        return "map" if is_map else "estimated"

    def is_expected(self, row: dict[str, Any]) -> bool:
        """Return whether a row is as a perfect answer would be."""
        if not self.accepted:
            return row["outcome"] != ACCEPTED
        camera = {"another": "estimated"}.get(self.own, self.own)
        says = row["outcome"], row.get("camera"), row.get("motion")
        return says == (ACCEPTED, camera, self.moved)


def is_wrong(row: dict[str, Any]) -> bool:
    """Return whether a wrong pose was accepted."""
    return row["outcome"] == ACCEPTED and (row["metres"] > RIGHT[0] or row["degrees"] > RIGHT[1])


def squared_distance(found: Localization, truth: SE3) -> float:
    """Return the squared Mahalanobis distance of the true pose."""
    assert found.covariance is not None
    xi = (found.T_world_camera.inverse() @ truth).log()
    return float(xi @ torch.linalg.solve(found.covariance, xi))


# Points without an image: keypoints are exact but for their noise.


@dataclass(eq=False)
class PointMatcher(LandmarkMatcher):
    """A matcher whose detector sees the points of a scene."""

    def __init__(self, landmarks: LandmarkMap, points: Points) -> None:
        super().__init__(landmarks)
        self.points = points

    @property
    def features(self) -> Features:
        return self.points


@functools.cache
def point_landmarks() -> LandmarkMap:
    points = Points(noise=0.3)
    scatter = torch.full((4,), 3e-3, dtype=torch.float64)
    built = build_landmarks(ring(points), points)
    return replace(built, cameras=(PINHOLE,), correlation=4.0, calibration_scatter=scatter)


def scaled(factor: float, camera: Intrinsics = PINHOLE) -> Intrinsics:
    return replace(camera, fx=factor * camera.fx, fy=factor * camera.fy)


def shifted(right: float, down: float) -> Intrinsics:
    return replace(PINHOLE, cx=PINHOLE.cx + right, cy=PINHOLE.cy + down)


def part(columns: int, rows: int, left: bool, top: bool) -> tuple[Intrinsics, Intrinsics]:
    """Return the camera of an image without some columns and rows at a corner, and the one with its principal point in the middle."""
    width, height = PINHOLE.width - columns, PINHOLE.height - rows
    cx, cy = PINHOLE.cx - columns * left, PINHOLE.cy - rows * top
    true = replace(PINHOLE, width=width, height=height, cx=cx, cy=cy)
    return true, replace(true, cx=width / 2, cy=height / 2)


def middle(share: float) -> Intrinsics:
    """Return the camera of the middle of the image."""
    width, height = round(PINHOLE.width * (1 - share)), round(PINHOLE.height * (1 - share))
    return replace(PINHOLE, width=width, height=height, cx=width / 2, cy=height / 2)


MOVING = torch.tensor(
    [0.0, 0.01, 0.0, 0.0, 0.02, 0.015], dtype=torch.float64
)  # from the first row to the last


def points_case(
    fault: str,
    number: int = 0,
    *,
    true: Intrinsics = PINHOLE,
    stated: Intrinsics | None = None,
    approximate: bool = False,
    cameras: tuple[Intrinsics, ...] = (PINHOLE,),
    motion: Tensor | None = None,
    wrong: float = 0.0,
    most: int | None = None,
    left: float = 1.0,
    start: SE3 | None = None,
    twice: bool = False,
    others: Sequence[SE3] = (),
    **expected: Any,
) -> Case:
    """Return an image of the points by a ``true`` camera.

    ``wrong``: share of keypoints that show something else. ``most``: how many keypoints there are. ``left``: share of the image
    that nothing hides. ``others``: poses of further cameras of the rig.
    """
    points, truth = Points(noise=0.3), POSES[number]
    points.outliers = wrong
    views = []
    for seed, T in enumerate([*others, truth]):
        view = points.view(T, true, motion=motion, seed=100 * number + seed)
        seen = points.seen[-1]
        points.seen[-1] = seen[seen.pixels[:, 0] <= left * true.width]
        if most is not None:
            points.seen[-1] = points.seen[-1][torch.arange(most)]
        frame = replace(view.frame, intrinsics=stated or true, focal_is_approximate=approximate)
        views.append(replace(view, frame=frame))
    landmarks = replace(point_landmarks(), cameras=cameras)
    if twice:
        landmarks = doubled(landmarks)
    # Where landmarks do not convince, the ground is searched for what is not there.
    problem = rig(
        textured_field.textured_map(surface=True), views, start, matcher=PointMatcher(landmarks, points)
    )
    return Case(f"points/{fault}/{number}", problem, truth, NOT_RENDERED, **expected)


def doubled(landmarks: LandmarkMap) -> LandmarkMap:
    """Return the landmarks twice: here and in another room."""
    noise = 20 * torch.randn((2 * len(landmarks), 64), generator=torch.Generator().manual_seed(0))
    both = landmarks[torch.arange(len(landmarks)).repeat(2)]
    there = len(landmarks)
    T = COPY.to(dtype=torch.float32)
    both.positions[there:] = T.apply(both.positions[there:])
    both.directions[there:] = T.rotate(both.directions[there:])
    return replace(both, descriptors=(both.descriptors + noise).round().clamp(0, 255).byte())


def mirrored(case: Case) -> Case:
    view = faulty(case.problem.views[-1], "mirror", 0)
    problem = replace(case.problem, views=(view,))
    return replace(case, problem=problem, accepted=False)


def point_cases() -> Iterator[Case]:
    for number in range(3):
        yield points_case("none", number)
    for factor in (0.9, 0.95, 1.05, 1.2):
        for number in range(2):
            yield points_case(f"focal {factor}", number, stated=scaled(factor), own="map")
    for right, down in ((8, 0), (12, -12)):
        for number in range(2):
            stated = shifted(right, down)
            yield points_case(f"principal point {right} {down}", number, stated=stated, own="map")
    for number, (left, top) in enumerate([(True, False), (False, True)]):
        true, stated = part(100, 75, left, top)
        yield points_case("corner", number, true=true, stated=stated, own="another")
    for number in range(2):
        yield points_case("middle", number, true=middle(0.3))
    for across, number in ((0.75, 0), (0.95, 1), (1.05, 0), (1.33, 1)):
        stated = replace(PINHOLE, fx=PINHOLE.fx / across)
        yield points_case(f"resized {across}", number, stated=stated, own="map")
    for factor in (0.9, 1.05, 1.2):
        yield points_case(f"other camera {factor}", 1, true=scaled(factor))
    for factor in (0.9, 1.02, 1.2):
        name = f"focal {factor}, unknown cameras"
        yield points_case(name, 0, stated=scaled(factor), cameras=(), own="another")
    for factor in (0.7, 1.0, 1.4):
        name = f"approximate {factor}, unknown cameras"
        stated = scaled(factor)
        yield points_case(name, 1, stated=stated, approximate=True, cameras=(), own="another")
    for factor in (0.9, 1.15):
        yield points_case(f"approximate {factor}", 0, stated=scaled(factor), approximate=True, own="map")
    yield points_case("approximate, other camera 1.2", 1, true=scaled(1.2), stated=PINHOLE, approximate=True,
                      own="another")  # fmt: skip
    for number in range(2):
        yield points_case("moving rows", number, motion=MOVING, moved=True)
    for factor, number in ((0.95, 0), (1.05, 1)):
        name = f"moving rows, focal {factor}"
        yield points_case(name, number, motion=MOVING, stated=scaled(factor), own="map", moved=True)
    yield mirrored(points_case("mirrored"))
    yield points_case("two rooms", 0, twice=True, accepted=False)
    yield points_case("two rooms, start", 1, twice=True, start=near(POSES[1]))
    yield points_case("two thirds of the keypoints wrong", 0, wrong=0.67)
    yield points_case("hidden but for the left third", 1, left=0.33)
    yield points_case("12 keypoints", 0, most=12, accepted=False)
    yield points_case("30 keypoints", 1, most=30)
    yield points_case("30 keypoints, focal 0.95", 1, most=30, stated=scaled(0.95), own="map")
    yield points_case("only wrong keypoints", 0, wrong=1.0, accepted=False)
    yield points_case("rig", 0, others=POSES[1:2])
    yield points_case("rig, focal 0.95", 1, others=POSES[:1], stated=scaled(0.95), own="map")


def near(T: SE3) -> SE3:
    return T.retract(torch.tensor([1.0, 0.5, 0.0, 0.1, 0.0, 0.0], dtype=torch.float64))


# The textured ground, which is rendered: keypoints are those of an image, and rays and depth are fused with them.


def ground_case(
    fault: str, number: int = 1, *, depth: bool = False, seed: int = 0, rig_of: Sequence[int] = (),
    strange: bool = False, **expected: Any,
) -> Case:  # fmt: skip
    """Return an image of the ground, or of ``strange`` ground, with a fault of the catalogue."""
    scene = textured_field.textured_map(surface=True)
    assert scene.landmarks is not None
    scatter = torch.full((4,), 0.01, dtype=torch.float64)
    landmarks = replace(
        scene.landmarks, calibration_scatter=scatter, correlation=1.0, cameras=(textured_field.CAMERA,)
    )
    views = []
    for which in [*rig_of, number]:
        view = ground_view(which, 5 if strange else 0)
        view = faulty(view, fault, seed)
        views.append(view if depth else replace(view, frame=replace(view.frame, depth=None)))
    problem = rig(scene, views, None, matcher=LandmarkMatcher(landmarks))
    name = f"ground, {'RGB-D' if depth else 'RGB'}/{'strange' if strange else fault}/{number}"
    return Case(name + ("r" if rig_of else ""), problem, views[-1].T_ref_camera, **expected)


@functools.cache
def ground_view(number: int, seed: int) -> View:
    """Return an image of the ground with noise."""
    view = textured_field.view(textured_field.POSES[number], f"{number}", seed)
    noise = torch.randn(view.frame.rgb.shape, generator=torch.Generator().manual_seed(number))
    return replace(view, frame=replace(view.frame, rgb=(view.frame.rgb + COLOUR_NOISE * noise).clamp(0, 1)))


def ground_cases() -> Iterator[Case]:
    for depth in (False, True):
        yield ground_case("none", 1, depth=depth)
        yield ground_case("focal:0.95", 1, depth=depth, own="map")
        yield ground_case("occluder:0.25", 1, depth=depth)
    yield ground_case("focal:1.2", 0, own="map")
    yield ground_case("principal-point:5", 2, own="map")
    yield ground_case("crop:0.25", 1, own="another")
    yield ground_case("stretch:1.33", 1, own="map")
    yield ground_case("nominal+focal:1.1", 1, own="map")
    yield ground_case("rolling-shutter:2", 1, moved=True)
    yield ground_case("rolling-shutter:2+focal:1.05", 1, depth=True, own="map", moved=True)
    yield ground_case("mirror", 1, accepted=False)
    yield ground_case("blur:1", 1)
    yield ground_case("blur:2", 1)
    yield ground_case("none", 1, strange=True, accepted=False)
    yield ground_case("none", 1, rig_of=(0,))
    yield ground_case("depth-scale:1.05", 1, depth=True)


def cases() -> Iterator[Case]:
    yield from point_cases()
    yield from ground_cases()


def record(out: Path) -> None:
    rows: dict[str, dict[str, Any]] = {}
    for case in cases():
        began = time.process_time()
        assert case.name not in rows, case.name
        row = case.row()
        marks = {"debatable": not case.is_expected(row), "wrong": is_wrong(row)}
        row |= {name: True for name, value in marks.items() if value}
        rows[case.name] = row
        print(f"{case.name}: {time.process_time() - began:.2f} s", row, flush=True)
    lines = (f"{json.dumps(name)}: {json.dumps(row)}" for name, row in rows.items())
    out.write_text("{\n" + ",\n".join(lines) + "\n}\n")


def compare(known: Path) -> int:
    """Print how the answers differ from those of a record, and return how many say something else."""
    rows, differ = json.loads(known.read_text()), 0
    for case in cases():
        before, after = rows[case.name], case.row()
        says = [[row.get(key) for key in ("outcome", "camera", "motion")] for row in (before, after)]
        differ += says[0] != says[1]
        moved = f"{before.get('metres')} -> {after.get('metres')} m"
        print(
            f"{case.name}: {says[0]} -> {says[1]}, {moved}" if says[0] != says[1] else f"{case.name}: {moved}"
        )
    print(f"{differ} say something else")
    return differ


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", choices=["record", "compare"])
    parser.add_argument("file", type=Path)
    given = parser.parse_args()
    torch.set_num_threads(1)
    if given.what == "compare":
        return int(compare(given.file) > 0)
    record(given.file)
    return 0


if __name__ == "__main__":
    sys.exit(main())
