"""What a tracked pose has to fulfil beyond the thresholds of a single image, and the points that it is measured by."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from bidnerf_core.localization import Outcome, Verdict
from bidnerf_core.localization.tracking.measuring import (
    as_certain_as_usual,
    not_by_chance,
    precise_enough,
    shape_verdict,
    unconfirmed,
)
from bidnerf_core.localization.tracking.surface import measured_cloud
from flights import flight_frame, without_depth

ACCEPTED = Verdict(Outcome.CONVERGED, "30 landmark inliers")


def covariance(translation: float) -> torch.Tensor:
    """Return a covariance whose position is uncertain along one oblique direction."""
    along = torch.tensor([1.0, 2.0, -2.0], dtype=torch.float64) / 3
    found = 1e-8 * torch.eye(6, dtype=torch.float64)
    found[:3, :3] += translation**2 * torch.outer(along, along)
    return found


def test_landmarks_spread_evenly_over_the_threshold_agree_by_chance() -> None:
    """The standard deviation of such residuals, by which a fit is recognised that is none."""
    angle, radius = torch.rand(2, 200_000, generator=torch.Generator().manual_seed(0))
    place = 4.0 * radius.sqrt() * (2 * torch.pi * angle).cos()
    assert float(place.std()) == pytest.approx(4.0 / 2, rel=0.01)
    assert not_by_chance(ACCEPTED, 1.9, 4.0) is ACCEPTED
    refused = not_by_chance(ACCEPTED, 2.1, 4.0)
    assert refused.outcome is Outcome.AMBIGUOUS
    assert refused.reason.startswith(ACCEPTED.reason)


@pytest.mark.parametrize("judge", [precise_enough, as_certain_as_usual])
def test_an_uncertain_position_is_imprecise_and_other_rejections_stay(judge: object) -> None:
    limit = {precise_enough: 0.03, as_certain_as_usual: 4.5}[judge]  # type: ignore[index]
    assert judge(ACCEPTED, covariance(0.99 * limit), 1.0) is ACCEPTED  # type: ignore[operator]
    assert judge(ACCEPTED, covariance(1.01 * limit), 1.0).outcome is Outcome.IMPRECISE  # type: ignore[operator]
    other = Verdict(Outcome.OFF_SURFACE, "")
    assert judge(other, covariance(10.0), 1.0) is other  # type: ignore[operator]


def test_nothing_is_unusual_where_the_usual_error_is_not_known() -> None:
    assert as_certain_as_usual(ACCEPTED, covariance(10.0), 0.0) is ACCEPTED


def test_measured_points_are_those_of_drawn_pixels() -> None:
    frame = flight_frame(0)
    assert frame.depth is not None
    cloud = measured_cloud(frame, 200, 1.1, torch.Generator().manual_seed(0))
    assert len(cloud) == 200
    pixels = frame.intrinsics.project(cloud.points.double()).floor().long()
    measured = frame.depth[pixels[:, 1], pixels[:, 0]]
    torch.testing.assert_close(cloud.points[:, 2], 1.1 * measured)
    torch.testing.assert_close(cloud.rgb, frame.rgb[pixels[:, 1], pixels[:, 0]])
    assert len(pixels.unique(dim=0)) > 150
    spread = pixels.double() / torch.tensor([frame.intrinsics.width, frame.intrinsics.height])
    torch.testing.assert_close(spread.mean(0), torch.full((2,), 0.5).double(), atol=0.08, rtol=0)


def test_sparse_depth_is_used_whole() -> None:
    frame = without_depth(flight_frame(0))
    depth = torch.zeros(frame.rgb.shape[:2])
    depth[3, 5:25] = 1.5
    cloud = measured_cloud(replace(frame, depth=depth), 200, 1.0, torch.Generator().manual_seed(0))
    assert len(cloud) == 20
    torch.testing.assert_close(cloud.points[:, 2], torch.full((20,), 1.5))


def test_a_shape_without_a_time_is_not_accepted() -> None:
    small = covariance(1e-3)
    assert shape_verdict(ACCEPTED, small, 1.0, 0.01, stamped=True) is ACCEPTED
    assert "time stamp" in shape_verdict(ACCEPTED, small, 1.0, 0.01, stamped=False).reason
    assert shape_verdict(ACCEPTED, covariance(0.05), 1.0, 1.0, stamped=True).outcome is Outcome.IMPRECISE
    assert shape_verdict(ACCEPTED, covariance(0.02), 1.0, 0.004, stamped=True).outcome is Outcome.IMPRECISE


def test_few_followed_landmarks_need_confirmation() -> None:
    assert unconfirmed(ACCEPTED).outcome is Outcome.TOO_FEW_MATCHES
    other = Verdict(Outcome.UNDETERMINED, "")
    assert unconfirmed(other) is other
