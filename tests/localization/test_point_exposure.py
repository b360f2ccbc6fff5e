"""Measured points with the map's exposure: gains, clipped colours, and exposures too far from the map's."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

import baked
from bidnerf_core.geometry import SE3
from bidnerf_core.localization import PointCloud, PointScales, SurfaceCost
from bidnerf_core.localization.by_depth import STRONGEST, cloud_with_exposure_of_map

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
    clipped = (measured > 1.1).any(-1)
    assert bool(clipped.any())
    assert not bool(brought(measured.clamp(max=1)).coloured[clipped].any())
    assert bool(brought(RGB).coloured.all()), "white things are not clipped without a gain"


def test_a_gain_of_more_than_two_stops_is_left_alone() -> None:
    dark = RGB / (2 * STRONGEST) + 0.02
    torch.testing.assert_close(brought(dark).rgb, dark.to(brought(dark).rgb))


@pytest.mark.parametrize("channels", [slice(0, 3), slice(0, 1)], ids=["white", "red"])
def test_something_white_in_front_is_not_taken_for_clipped(channels: slice) -> None:
    """Half of the points show something white, or red, that the map does not have: their colours still contradict it."""
    measured = 1.15 * RGB - 0.03
    measured[::2, channels] = 1
    found = brought(measured.clamp(0, 1))
    wrong = (RGB[::2, channels] < 0.7).all(-1)
    assert float(wrong.double().mean()) > 0.2
    assert bool(found.coloured[::2][wrong].all())
    assert float((found.rgb - RGB)[::2][wrong].abs().amax(-1).min()) > 0.1


def test_a_channel_that_is_clipped_everywhere_is_not_explained() -> None:
    measured = 0.6 * RGB
    measured[:, 0] = 1
    torch.testing.assert_close(brought(measured).rgb, measured)


def test_low_contrast_alone_is_not_taken_for_an_exposure() -> None:
    """Blur pulls colours towards their mean; to stretch them again would only enlarge what it changed."""
    blurred = 0.95 * RGB + 0.05 * RGB.mean(0)
    torch.testing.assert_close(brought(blurred).rgb, blurred)


def test_an_image_that_is_white_everywhere_stays_so() -> None:
    white = torch.ones_like(RGB)
    torch.testing.assert_close(brought(white).rgb, white)


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
