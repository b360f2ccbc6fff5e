"""Measured points with the map's exposure: gains, clipped colours, and exposures that are not to be believed."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

import baked
from bidnerf_core.localization.costs.surface import PointCloud, PointScales, SurfaceCost
from bidnerf_core.localization.point_exposure import STRONGEST, cloud_with_exposure_of_map
from bidnerf_core.se3 import SE3

T = SE3.identity(dtype=torch.float64)
RGB = baked.toy().surfels.rgb


def brought(rgb: torch.Tensor) -> PointCloud:
    """Return every surfel, measured with colours ``rgb`` from the origin, with the map's exposure."""
    cloud = baked.points(baked.toy().surfels.positions, rgb)
    return cloud_with_exposure_of_map(SurfaceCost(baked.toy(), cloud, PointScales(0.1)), T)


@pytest.mark.parametrize("gain", [0.5, 1.0, 1.4])
def test_the_exposure_is_taken_back(gain: float) -> None:
    measured = (gain * RGB).clamp(max=1)
    found = brought(measured)
    kept = found.coloured
    assert float(kept.double().mean()) > 0.5
    assert float((found.rgb - RGB)[kept].abs().mean()) < 0.02
    assert (gain == 1) or float((measured - RGB).abs().mean()) > 0.05


def test_points_that_were_clipped_have_no_colour() -> None:
    measured = 1.4 * RGB
    clipped = (measured > 1).any(-1)
    assert bool(clipped.any())
    assert not bool(brought(measured.clamp(max=1)).coloured[clipped].any())
    assert bool(brought(RGB).coloured.all()), "white things are not clipped without a gain"


def test_a_gain_of_more_than_two_stops_is_not_believed() -> None:
    dark = RGB / (2 * STRONGEST) + 0.02
    torch.testing.assert_close(brought(dark).rgb, dark.to(brought(dark).rgb))


def test_colours_of_another_place_are_not_explained() -> None:
    """An exposure has six numbers: it cannot turn the colours of one place into those of another."""
    turned = RGB.roll(len(RGB) // 2, 0)
    found = brought(turned)
    before, after = (float((rgb - RGB).abs().mean()) for rgb in (turned, found.rgb))
    assert after > 0.7 * before


def test_points_without_colour_stay_as_they_are() -> None:
    cloud = baked.points(baked.toy().surfels.positions, RGB)
    cloud = replace(cloud, coloured=torch.zeros(len(cloud), dtype=torch.bool))
    found = cloud_with_exposure_of_map(SurfaceCost(baked.toy(), cloud, PointScales(0.1)), T)
    torch.testing.assert_close(found.rgb, cloud.rgb)
    assert not bool(found.coloured.any())
