"""Models of depth sensors: their numbers agree with their sources, and everything that uses them does."""

from __future__ import annotations

import math
import re
from dataclasses import replace

import pytest
import torch
from torch import Generator

import baked
from bidnerf import Intrinsics, Localizer
from bidnerf_core.depth import (
    DEPTH_SENSORS,
    UNKNOWN,
    DepthNoise,
    describe_depth_noise,
    find_depth_sensor,
)
from bidnerf_core.errors import InputError
from bidnerf_core.localization import AutoConfig, settings_of
from optional import require
from problems import FieldMap


def test_the_kinects_noise_is_that_of_half_a_pixel_of_disparity() -> None:
    disparities_a_pixel, focal, baseline = 8, 580.0, 0.075  # of the infrared camera: pixels, metres
    half_a_step = 0.5 / (disparities_a_pixel * focal * baseline)
    assert DEPTH_SENSORS["kinect"].noise.deviation(1.0) == pytest.approx(half_a_step, rel=0.02)
    assert DEPTH_SENSORS["kinect"].noise.deviation(5.0) == pytest.approx(
        0.04, rel=0.15
    )  # "about 4 cm at the maximum range"


def test_the_realsenses_noise_is_about_that_of_intels_formula() -> None:
    focal = 848 / 2 / math.tan(math.radians(90) / 2)
    for z in (1.0, 2.0, 3.0):
        assert DEPTH_SENSORS["realsense"].noise.deviation(z) == pytest.approx(0.08 * z**2 / (focal * 0.050), rel=0.6)


@pytest.mark.parametrize("name", DEPTH_SENSORS)
def test_noise_grows_with_the_distance_and_is_the_same_for_numbers_and_tensors(name: str) -> None:
    noise, depth = DEPTH_SENSORS[name].noise, torch.linspace(0.3, 8.0, 20, dtype=torch.float64)
    deviations = noise.deviation(depth)
    assert bool((deviations > 0).all())
    assert bool((deviations.diff() > 0).all())
    assert deviations.tolist() == pytest.approx([noise.deviation(z) for z in depth.tolist()])


@pytest.mark.parametrize("value", [-0.01, math.nan, math.inf])
def test_deviations_that_are_negative_or_not_finite_are_refused(value: float) -> None:
    for usual, parts in ((DepthNoise(), ("constant", "linear", "quadratic")), (UNKNOWN, ("scale", "offset"))):
        for part in parts:
            with pytest.raises(InputError, match=f"{part} is {value}, expected .*a number from 0 up"):
                replace(usual, **{part: value})


def test_another_name_is_an_error_that_lists_the_names() -> None:
    for use in (find_depth_sensor, lambda name: AutoConfig(depth_sensor=name)):
        with pytest.raises(InputError, match="unknown, kinect, realsense, lidar, rendered"):
            use("sonar")
    with pytest.raises(InputError, match="did you mean 'kinect'"):
        find_depth_sensor("kinekt")


def test_localize_compares_a_named_sensor_with_the_image(generator: Generator) -> None:
    camera = Intrinsics.from_focal(100.0, 120, 90)
    plane, noise = torch.linspace(1.0, 1.3, 120).expand(90, 120), torch.randn((90, 120), generator=generator)
    depth = plane * (1 + 0.02 * noise)
    sentence = require(describe_depth_noise(depth, camera, "kinect"))
    assert re.search(r"by about (1\.[6-9]|2\.[0-4])\d% of the distance .* a 'kinect' usually by 0\.\d+%", sentence)
    assert describe_depth_noise(plane * (1 + 0.002 * noise), camera, "kinect") is None, "it agrees"
    assert describe_depth_noise(torch.zeros_like(depth), camera, "kinect") is None


def test_the_covariance_of_a_pose_by_depth_grows_with_the_scale_of_the_sensor() -> None:
    scene, view = FieldMap(baked.FIELD, baked.BOUNDS, baked.toy()), baked.unseen()[0]
    by_sensor = {}
    for name in ("rendered", "unknown", "kinect"):
        config = settings_of("auto", {"depth_sensor": name, "hypotheses": 32, "rounds": 1, "refine_steps": 0})
        by_sensor[name] = Localizer(scene, config=config, warm_up=False)(view.frame)
    sizes = {}
    for name, found in by_sensor.items():
        sizes[name] = float(require(found.covariance)[:3, :3].trace())
    # The pose is the same, so the covariances differ by the squared scales alone.
    ratio = (sizes["kinect"] - sizes["rendered"]) / (sizes["unknown"] - sizes["rendered"])
    assert ratio == pytest.approx((DEPTH_SENSORS["kinect"].scale / UNKNOWN.scale) ** 2, rel=1e-3)
    assert DEPTH_SENSORS["rendered"].scale == 0
