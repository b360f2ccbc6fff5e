"""Right answers are believed, wrong ones doubted; how sure an answer is follows the residuals."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from bidnerf_core.localization.alignment import Cloud
from bidnerf_core.localization.hypotheses import hypotheses
from bidnerf_core.localization.verdict import Bars, Evidence, covariance, crossed, evidence
from torch import Generator, Tensor

import baked
from bidnerf_core.localization.search import Found, search
from bidnerf_core.scenes.demo import demo_room
from bidnerf_core.se3 import SE3


def answer(T: SE3, lead: float = math.inf) -> Found:
    return Found(T, 0.0, lead, T[None])


def doubt(T: SE3, cloud: Cloud, lead: float = math.inf) -> str | None:
    return evidence(baked.toy(), cloud, answer(T, lead)).doubt(Bars())


def searched(cloud: Cloud, generator: Generator) -> str | None:
    """What is said of the best pose that there is for ``cloud``."""
    found = search(baked.toy(), cloud, hypotheses(baked.toy(), cloud, None, 128, generator))
    return evidence(baked.toy(), cloud, found).doubt(Bars())


def test_right_poses_are_believed() -> None:
    for view in baked.unseen():
        assert doubt(view.T_ref_camera, baked.cloud(view)) is None


def test_wrong_poses_are_doubted(generator: Generator) -> None:
    view = baked.unseen()[0]
    cloud = baked.cloud(view)
    for shift in (torch.tensor([0.0, 0, 0, 0, 0, math.pi / 2]), torch.tensor([0.4, 0, 0, 0, 0, 0])):
        assert doubt(cloud.pivot.moved(view.T_ref_camera, shift.double()), cloud) is not None
    assert "another pose" in str(doubt(view.T_ref_camera, cloud, lead=0.01))


def test_what_the_field_does_not_show_is_doubted() -> None:
    sound = Evidence(on_surface=1.0, alike=1.0, crossed=0.0, lead=1.0)
    assert sound.doubt(Bars()) is None
    for share in (0.5, math.nan):
        assert "rays that the field renders" in str(replace(sound, shown=share).doubt(Bars()))


def test_other_colours_are_doubted() -> None:
    view = baked.unseen()[0]
    cloud = baked.cloud(view)
    inverted = Cloud(cloud.points, 1 - cloud.rgb, cloud.origins)
    assert "colour" in str(doubt(view.T_ref_camera, inverted))


def test_a_mirrored_object_is_doubted(generator: Generator) -> None:
    cloud = baked.cloud(baked.unseen()[0])
    mirror = torch.tensor([-1.0, 1.0, 1.0])
    assert searched(Cloud(cloud.points * mirror, cloud.rgb, cloud.origins), generator) is not None


def test_an_image_of_something_else_is_doubted(generator: Generator) -> None:
    room = baked.images(replace(demo_room(), bounds=baked.BOUNDS), 1, seed=0)[0]
    assert searched(baked.cloud(room), generator) is not None


def test_lines_of_sight_run_through_the_surface_from_behind() -> None:
    view = baked.unseen()[0]
    cloud, truth = baked.cloud(view), view.T_ref_camera
    assert crossed(baked.toy(), cloud, truth) < 0.15
    # The same points as if seen from the other side.
    through = Cloud(cloud.points, cloud.rgb, cloud.origins + 2 * cloud.middle)
    assert crossed(baked.toy(), through, truth) > 0.5


def seen_patch(noise: float, tilt: bool = True) -> tuple[Cloud, Tensor]:
    generator = torch.Generator().manual_seed(0)
    surface = baked.patch()
    points = surface.surfels.positions + noise * torch.randn((100, 3), generator=generator)
    return Cloud(points, surface.surfels.rgb, torch.zeros((100, 3))), points


@pytest.mark.parametrize("number", range(3))
def test_covariance_is_symmetric_and_positive_definite(number: int) -> None:
    view = baked.unseen()[number]
    found = covariance(baked.toy(), baked.cloud(view), view.T_ref_camera)
    assert torch.equal(found, found.mT)
    assert torch.linalg.eigvalsh(found).min() > 0
    assert found.diagonal()[:3].sum().sqrt() < 0.2
    rigged = covariance(baked.toy(), baked.cloud(view), view.T_ref_camera, views=4)
    assert torch.allclose(rigged, found / 4, rtol=0.05, atol=1e-7)


def test_covariance_grows_with_the_square_of_noise() -> None:
    surface = baked.patch()
    little, more = (
        covariance(surface, seen_patch(noise)[0], SE3.identity())[2, 2] for noise in (0.002, 0.004)
    )
    assert float(more / little) == pytest.approx(4, rel=0.1)


def test_what_a_wall_does_not_tell_is_not_known() -> None:
    """Of a wall of one colour: its distance and two turns are known, the way along it is not."""
    surface = baked.patch()
    grey = baked.of_points(surface.surfels.positions, torch.full((100, 3), 0.5), (0.0, 0.0, 1.0))
    middle = (grey.surfels.positions[:, :2].abs() < 0.3).all(-1)
    cloud = Cloud(
        grey.surfels.positions[middle], grey.surfels.rgb[middle], torch.zeros((int(middle.sum()), 3))
    )
    deviation = covariance(grey, cloud, SE3.identity()).diagonal().sqrt()
    assert deviation[2] < 0.01
    assert (deviation[:2] > 0.5 * grey.extent).all()
    assert (deviation[3:5] < 0.1).all()
    assert deviation[5] > 1
