"""The fit of a camera to stretched and cropped images, from matches that the pose of the stated camera leaves out."""

from __future__ import annotations

import pytest
import torch
from torch import Generator

from bidnerf_core.camera import Intrinsics
from bidnerf_core.geometry import SE3

# Inside: the fit of a camera from matches that barely agree, before any answer is accepted
from bidnerf_core.localization.landmarks.consensus import Candidate
from bidnerf_core.localization.landmarks.far_cameras import camera_fit
from bidnerf_core.mapping import GIVEN, ObservedPoints
from bidnerf_core.results import pose_error

FOCAL = 500.0
LIMIT = 2.0
TRUTH = SE3.exp(torch.tensor([0.3, -0.2, 0.1, 0.1, 0.2, -0.1], dtype=torch.float64))


def matches(
    generator: Generator,
    across: float = 1.0,
    shift: tuple[float, float] = (0.0, 0.0),
    count: int = 200,
    wrong: int = 40,
) -> ObservedPoints:
    """Return points before the camera, seen in an image stretched ``across`` and moved by a ``shift``, some matched wrongly."""
    local = torch.rand((count, 3), generator=generator, dtype=torch.float64) * 2 - 1
    local[:, 2] += 4
    image = local[:, :2] / local[:, 2:] * torch.tensor([across, 1.0]) + torch.tensor(shift)
    image = image + 0.3 / FOCAL * torch.randn((count, 2), generator=generator, dtype=torch.float64)
    image[:wrong] = torch.rand((wrong, 2), generator=generator, dtype=torch.float64) * 0.5 - 0.25
    each = torch.ones(count, dtype=torch.float64)
    eye = torch.eye(3, dtype=torch.float64).expand(count, 3, 3)
    sight = torch.nn.functional.normalize(TRUTH.rotate(local), dim=-1)
    return ObservedPoints(
        TRUTH.apply(local), 1e-3 * torch.ones((count, 2), dtype=torch.float64), sight, image, FOCAL * each,
        0 * each, eye, torch.zeros((count, 3), dtype=torch.float64), 0 * each,
    )  # fmt: skip


def agreeing(data: ObservedPoints, T: SE3) -> int:
    return int((torch.linalg.vector_norm(data.residuals(T), dim=-1) <= LIMIT).sum())


def fitted(data: ObservedPoints, start: SE3 = TRUTH) -> Candidate:
    found = camera_fit(data, start, GIVEN, LIMIT)
    assert found is not None
    return found


@pytest.mark.parametrize("across", [0.6, 0.9, 1.1, 1.5])
def test_a_stretch_is_estimated_from_a_pose_that_few_matches_agree_with(
    across: float, generator: Generator
) -> None:
    """The focal length down is as given, so that all of the change is across."""
    found = fitted(matches(generator, across))
    wide, high = found.calibration.across_and_down.tolist()
    assert wide / high == pytest.approx(across, rel=0.01)
    assert high == pytest.approx(1, abs=0.03)
    assert pose_error(found.T_world_rig, TRUTH).translation < 0.1


@pytest.mark.parametrize("shift", [(-0.15, 0.0), (0.1, 0.08), (0.0, -0.2)])
def test_a_part_of_an_image_is_told_from_its_principal_point(
    shift: tuple[float, float], generator: Generator
) -> None:
    """The start is turned by as much as the principal point is off, as a pose is that takes the middle of the part for it."""
    turn = torch.tensor([0.0, 0.0, 0.0, shift[1], -shift[0], 0.0], dtype=torch.float64)
    data, start = matches(generator, shift=shift), TRUTH.retract(turn)
    assert pose_error(start, TRUTH).rotation_deg > 5
    found = fitted(data, start)
    assert not found.calibration.is_stretched
    assert (found.calibration.shift_u, found.calibration.shift_v) == pytest.approx(shift, abs=0.03)
    assert pose_error(found.T_world_rig, TRUTH).rotation_deg < 2
    given = Intrinsics(FOCAL, FOCAL, 320.0, 240.0, 640, 480)
    camera = found.calibration.applied(given)
    assert (camera.cx - 320, camera.cy - 240) == pytest.approx((FOCAL * shift[0], FOCAL * shift[1]), abs=15)
