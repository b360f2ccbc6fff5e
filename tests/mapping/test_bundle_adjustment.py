"""Bundle adjustment: derivatives, laws, and known errors of poses that it must take back."""

from __future__ import annotations

from dataclasses import dataclass, replace

import pytest
import torch
from torch import Tensor

from bidnerf import SE3
from bidnerf_core.camera import STILL, MotionPrior, poses_of_rows
from bidnerf_core.mapping import Adjustment, PosePrior, Sightings, adjust_bundle

# Inside: the linear system and its elimination are compared with numerical derivatives
from bidnerf_core.mapping.geometry.bundle_adjustment import SMALL_DECREASE, linearize
from landmark_scene import looking_in

VIEWS, POINTS, FOCAL = 12, 150, 300.0
MILLIMETRES, RADIANS = 0.008, 0.004
AT_REST_ALL = torch.zeros(VIEWS, 6, dtype=torch.float64)


@dataclass(frozen=True)
class Capture:
    """Cameras on a ring that see all points of a box, each with an error."""

    noise: float = 0.0  # pixels
    outliers: float = 0.0  # share of the sightings that are anywhere
    moving: bool = False  # whether the cameras move while rows are exposed, by ``motions``

    @property
    def poses(self) -> SE3:
        return SE3.stack([looking_in(0.2 * i, 0.4 * (i % 3), 3.0) for i in range(VIEWS)])

    @property
    def points(self) -> Tensor:
        return 2 * torch.rand(POINTS, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1)) - 1

    def seen(self, given: SE3) -> Sightings:
        """What the true cameras saw, under the ``given`` poses."""
        generator = torch.Generator().manual_seed(2)
        image = torch.arange(VIEWS).repeat_interleave(POINTS)
        point = torch.arange(POINTS).repeat(VIEWS)
        times = (0.6180339887 * torch.arange(len(image), dtype=torch.float64)) % 1 - 0.5
        T = self.poses[image] @ poses_of_rows(times, self.moving * motions()[image])
        local = T.inverse().apply(self.points[point])
        noise = torch.randn(len(image), 3, dtype=torch.float64, generator=generator)
        flat = local[:, :2] / local[:, 2:] + self.noise / FOCAL * noise[:, :2]
        wrong = torch.rand(len(image), generator=generator) < self.outliers
        flat = torch.where(wrong[:, None], 0.3 * noise[:, [1, 2]], flat)
        focal = torch.full((len(image),), FOCAL, dtype=torch.float64)
        T = given[image]
        return Sightings(point, image, T.rotation.mT, T.translation, flat, focal, times)

    def adjust_bundle(self, given: SE3, prior: PosePrior, tolerance: float = SMALL_DECREASE) -> Adjustment:
        """What an adjustment finds, from the ``given`` poses and the true points."""
        return adjust_bundle(self.seen(given), at_rest(given, self.points), prior, self.accuracy, tolerance=tolerance)

    @property
    def accuracy(self) -> float:
        return max(0.1, self.noise)

    def shifts(self, motion: Tensor) -> Tensor:
        """Where each camera sees each point in its last row, pixels; what image motions differ in, if translation and
        rotation make up for each other.
        """
        local = (self.poses @ SE3.exp(0.5 * motion))[:, None].inverse().apply(self.points)
        return FOCAL * local[..., :2] / local[..., 2:]


def at_rest(T: SE3, points: Tensor) -> Adjustment:
    return Adjustment(T, points, AT_REST_ALL)


def errors(seed: int = 3) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    size = torch.tensor([MILLIMETRES] * 3 + [RADIANS] * 3, dtype=torch.float64)
    return size * torch.randn(VIEWS, 6, dtype=torch.float64, generator=generator)


def motions() -> Tensor:
    """Motions from the first row of each image to the last: about four pixels."""
    return errors(seed=5)


def inaccurate(noise: float = 0.0, outliers: float = 0.0, moving: bool = False) -> tuple[Capture, SE3]:
    """Return a capture, and its poses with errors."""
    capture = Capture(noise, outliers, moving)
    return capture, capture.poses.retract(errors())


def prior(given: SE3, motion: MotionPrior = STILL) -> PosePrior:
    return PosePrior(given, MILLIMETRES, RADIANS, motion)


def relative(T: SE3) -> SE3:
    """The poses relative to the first camera's, which no prior has a part in."""
    return T[:1].inverse() @ T


def off(found: SE3, true: SE3) -> tuple[float, float]:
    """The largest error of translation (metres) and rotation (radians)."""
    parts = (true.inverse() @ found).log().split(3, dim=-1)
    translation, rotation = (float(part.norm(dim=-1).max()) for part in parts)
    return translation, rotation


@pytest.mark.parametrize("motion", [STILL, MotionPrior(MILLIMETRES, RADIANS)])
def test_the_gradient_is_the_numerical_one(motion: MotionPrior) -> None:
    capture, given = inaccurate(noise=1.0, outliers=0.1, moving=motion != STILL)
    seen, held = capture.seen(given), prior(given, motion)
    points = capture.points + 0.01
    size = 6 if motion == STILL else 12
    of_poses = VIEWS * size

    def cost(change: Tensor) -> float:
        of_images, of_points = change[:of_poses].view(VIEWS, size), change[of_poses:].view(POINTS, 3)
        T = capture.poses.retract(of_images[:, :6])
        moved = Adjustment(T, points + of_points, AT_REST_ALL if motion == STILL else of_images[:, 6:])
        return linearize(seen, moved, held, 1.0, 3.0).cost

    system = linearize(seen, at_rest(capture.poses, points), held, 1.0, 3.0)
    gradient, step = torch.cat([system.image_gradient.ravel(), system.point_gradient.ravel()]), 1e-6
    for number in (
        *range(4 * size, 5 * size),
        *range(of_poses + 21, of_poses + 24),
    ):  # the fifth image, the eighth point
        change = torch.zeros_like(gradient)
        change[number] = step
        slope = (cost(change) - cost(-change)) / (2 * step)
        assert slope == pytest.approx(float(gradient[number]), rel=1e-5, abs=1e-3)


@pytest.mark.parametrize(("motion", "size"), [(STILL, 6), (MotionPrior(MILLIMETRES, RADIANS), 12)])
def test_the_schur_complement_gives_the_step_of_the_whole_equations(motion: MotionPrior, size: int) -> None:
    capture, given = inaccurate(noise=1.0)
    system = linearize(capture.seen(given), at_rest(given, capture.points), prior(given, motion), 1.0)
    rows, columns = size * VIEWS, 3 * POINTS
    whole = torch.zeros(rows + columns, rows + columns, dtype=torch.float64)
    for i, block in enumerate(system.image_blocks):
        whole[size * i : size * i + size, size * i : size * i + size] = block
    for i, block in enumerate(system.point_blocks):
        at = rows + 3 * i
        whole[at : at + 3, at : at + 3] = block
    for block, image, point in zip(system.mixed_blocks, system.image, system.point, strict=True):
        i, at = size * int(image), rows + 3 * int(point)
        whole[i : i + size, at : at + 3] = block
        whole[at : at + 3, i : i + size] = block.mT
    damping = 0.01
    whole += damping * torch.diag(whole.diagonal())
    right = -torch.cat([system.image_gradient.ravel(), system.point_gradient.ravel()])
    of_images, of_points = system.step(damping)
    found = torch.cat([of_images.ravel(), of_points.ravel()])
    torch.testing.assert_close(found, torch.linalg.solve(whole, right), rtol=1e-5, atol=1e-9)


@pytest.mark.parametrize("motion", [STILL, MotionPrior(MILLIMETRES, RADIANS)])
def test_exact_poses_do_not_move(motion: MotionPrior) -> None:
    capture = Capture()
    found = capture.adjust_bundle(capture.poses, prior(capture.poses, motion))
    assert float(found.motion.abs().max()) < 1e-9
    assert max(off(found.T_world_camera, capture.poses)) < 1e-9
    torch.testing.assert_close(found.points, capture.points, rtol=0, atol=1e-9)


def test_exact_sightings_take_errors_of_poses_back() -> None:
    """What is left is what no image shows: a motion and a scale of everything, about which the prior has an opinion."""
    capture, given = inaccurate()
    found = capture.adjust_bundle(given, prior(given), tolerance=1e-12).T_world_camera
    translation, rotation = off(relative(found), relative(capture.poses))
    before = off(relative(given), relative(capture.poses))
    assert translation < 0.15 * before[0]  # the scale
    assert rotation < 0.01 * before[1]


def test_motions_are_found_with_the_poses() -> None:
    capture, given = inaccurate(noise=0.3, moving=True)
    still = capture.adjust_bundle(given, prior(given))
    moving = capture.adjust_bundle(given, prior(given, MotionPrior(MILLIMETRES, RADIANS)))
    assert bool((still.motion == 0).all())
    assert moving.cost < 0.7 * still.cost
    true, found, none = (capture.shifts(m) for m in (motions(), moving.motion, AT_REST_ALL))
    assert float((found - true).norm(dim=-1).median()) < 0.2 * float((true - none).norm(dim=-1).median())
    of_moving, of_still = (off(relative(found.T_world_camera), relative(capture.poses)) for found in (moving, still))
    assert of_moving[1] < 0.5 * of_still[1]


def test_the_mean_motion_is_zero() -> None:
    capture, given = inaccurate(noise=0.3)
    found = capture.adjust_bundle(given, replace(prior(given), translation=1.0, rotation=0.5))
    mean = (found.T_world_camera.translation - given.translation).mean(0)
    typical = (found.T_world_camera.translation - given.translation).norm(dim=-1).median()
    assert float(mean.norm()) < 1e-2 * float(typical)


def test_a_moved_world_has_moved_poses() -> None:
    capture, given = inaccurate(noise=0.5)
    T = SE3.exp(torch.tensor([3.0, -1.0, 2.0, 0.5, 1.0, -0.3], dtype=torch.float64))
    here = capture.adjust_bundle(given, prior(given))
    moved = T @ given
    start = at_rest(moved, T.apply(capture.points))
    there = adjust_bundle(capture.seen(moved), start, prior(moved), capture.accuracy)
    assert max(off(there.T_world_camera, T @ here.T_world_camera)) < 1e-6
    assert there.cost == pytest.approx(here.cost, rel=1e-6)


def test_outliers_and_a_wrong_pose_do_not_pull_the_others_away() -> None:
    capture = Capture(noise=0.3, outliers=0.1)
    wrong = errors()
    wrong[5] = torch.tensor([0.2, 0, 0.1, 0, 0.05, 0], dtype=torch.float64)
    given = capture.poses.retract(wrong)
    found = capture.adjust_bundle(given, prior(given)).T_world_camera
    translation, rotation = off(found, capture.poses)
    assert translation < 1.5 * MILLIMETRES  # the common motion remains
    assert rotation < RADIANS


def test_an_image_without_sightings_stays() -> None:
    capture, given = inaccurate(noise=0.3)
    seen = capture.seen(given)
    start = at_rest(given, capture.points)
    found = adjust_bundle(seen[seen.view != 3], start, prior(given), capture.accuracy).T_world_camera
    assert max(off(found[3], given[3])) < 1e-12
    assert max(off(found[4], given[4])) > 1e-3


def test_points_without_parallax_do_no_harm() -> None:
    """Cameras that only turn about their centre show nothing of distances."""
    capture = Capture(noise=0.3)
    turned = SE3.stack(
        [looking_in(0.0, 0.3, 3.0).retract(torch.tensor([0, 0, 0, 0, 0.01 * i, 0]).double()) for i in range(VIEWS)]
    )
    image = torch.arange(VIEWS).repeat_interleave(POINTS)
    local = turned[image].inverse().apply(capture.points.repeat(VIEWS, 1))
    seen = replace(capture.seen(turned), image=local[:, :2] / local[:, 2:])
    given = turned.retract(errors())
    found = adjust_bundle(seen, at_rest(given, capture.points), prior(given), capture.accuracy).T_world_camera
    assert bool(found.is_rigid().all())
    assert off(relative(found), relative(turned))[1] < 0.5 * off(relative(given), relative(turned))[1]
