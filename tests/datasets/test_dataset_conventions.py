"""Whether conventions of pixels and axes are right: what one recorded view measures must be where another one sees it.

Each pixel of a view with depth is put into the world and into a view nearby. Where nothing hides it, both must agree in
depth and in colour; and they must agree less if pixel centres were half a pixel off or axes were other than they are.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import pytest
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from bidnerf_core.datasets import open_dataset
from bidnerf_core.frames import View
from bidnerf_core.geometry import SE3
from optional import require

pytestmark = pytest.mark.data
PAIRS = 10
SAME_SURFACE = 0.03  # of the depth
Mistake = Callable[[View], View]


@dataclass(frozen=True)
class Agreement:
    """Means over pairs of views."""

    surface: float  # the part of the points not hidden that lie on the surface which the other view measured
    depth: float  # median difference, relative
    colour: float  # mean difference


def agreement(pairs: Sequence[tuple[View, View]], first: Mistake, second: Mistake) -> Agreement:
    """A mistake in the views that measure is noticed, and so is one in those that are compared with them."""
    results = torch.tensor([compared(first(a), second(b)) for a, b in pairs])
    return Agreement(*results.mean(dim=0).tolist())


def compared(source: View, other: View) -> tuple[float, float, float]:
    points, colours = measured(source)
    seen = other.T_ref_camera.inverse().apply(points)
    pixels = other.frame.intrinsics.project(seen).nan_to_num(-1.0, -1.0, -1.0)
    size = torch.tensor([other.frame.intrinsics.width, other.frame.intrinsics.height])
    inside = ((pixels > 2) & (pixels < size - 2)).all(dim=-1)
    seen, pixels, colours = seen[inside], pixels[inside], colours[inside]
    depth = require(other.frame.depth)
    there = depth[pixels[:, 1].long(), pixels[:, 0].long()].double()
    off = torch.where(there > 0, seen[:, 2] / there - 1, torch.inf)
    same = off.abs() < SAME_SURFACE
    smooth = (interpolated(depth[..., None], pixels[same])[:, 0] / seen[same, 2] - 1).abs().median()
    colour = (interpolated(other.frame.rgb, pixels[same]) - colours[same]).abs().mean()
    return (same.sum() / (off < SAME_SURFACE).sum().clamp(min=1)).item(), smooth.item(), colour.item()


def measured(view: View) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"]]:
    """Points (world) and colours of all pixels with depth."""
    depth = require(view.frame.depth)
    known = depth > 0
    ray = view.frame.intrinsics.unproject(view.frame.intrinsics.pixel_centres(torch.float64))
    return view.T_ref_camera.apply(ray[known] * depth[known][:, None].double()), view.frame.rgb[known]


def interpolated(image: Float[Tensor, "h w c"], pixels: Float[Tensor, "n 2"]) -> Float[Tensor, "n c"]:
    height, width, channels = image.shape
    places = (pixels / torch.tensor([width, height]) * 2 - 1).float().reshape(1, 1, -1, 2)
    return functional.grid_sample(image.permute(2, 0, 1)[None], places, align_corners=False).reshape(channels, -1).T


@cache
def pairs_of(folder: Path) -> list[tuple[View, View]]:
    """Views with depth, each with the one that is nearest in place and direction."""
    dataset = open_dataset(folder)
    views = [view for split in dataset.splits for view in dataset.views(split) if view.frame.has_depth]
    poses = SE3.stack([view.T_ref_camera for view in views])
    forward = poses.rotation[:, :, 2]
    apart = torch.cdist(poses.translation, poses.translation)
    apart = apart / apart.amax() + 2 * (1 - forward @ forward.T) + 9 * torch.eye(len(views))
    chosen = torch.linspace(0, len(views) - 1, PAIRS).long().tolist()
    return [(views[i], views[int(apart[i].argmin())]) for i in chosen]


def right(view: View) -> View:
    return view


@cache
def of_right(folder: Path) -> Agreement:
    return agreement(pairs_of(folder), right, right)


def shifted(pixels: float) -> Mistake:
    def shift(view: View) -> View:
        camera = view.frame.intrinsics
        camera = replace(camera, cx=camera.cx + pixels, cy=camera.cy + pixels)
        return replace(view, frame=replace(view.frame, intrinsics=camera))

    return shift


def flipped(*signs: float) -> Mistake:
    def flip(view: View) -> View:
        pose = view.T_ref_camera
        return replace(view, T_ref_camera=SE3(pose.rotation * torch.tensor(signs).double(), pose.translation))

    return flip


SCENES = {  # least surface, most depth, most colour; 8-bit depth, a real sensor with holes, and exact depth
    "blender_lego": (0.97, 0.005, 0.045),
    "tum_fr1_xyz": (0.87, 0.012, 0.06),
    "room_living": (0.985, 0.0005, 0.025),
}


@pytest.mark.parametrize("scene", SCENES)
def test_views_agree_and_less_so_with_other_conventions(data_dir: Path, scene: str) -> None:
    """Other axes are worse, and so are pixel centres at whole numbers in one view and at halves in another."""
    good, pairs = of_right(data_dir / scene), pairs_of(data_dir / scene)
    surface, depth, colour = SCENES[scene]
    assert good.surface > surface
    assert good.depth < depth
    assert good.colour < colour
    for mistake in (
        flipped(1, -1, -1),
        flipped(1, -1, 1),
        lambda view: replace(view, T_ref_camera=view.T_ref_camera.inverse()),
    ):
        assert agreement(pairs, mistake, mistake).surface < good.surface - 0.15
    assert agreement(pairs, shifted(0.5), right).colour > 1.02 * good.colour


@pytest.mark.parametrize("shift", [shifted(0.5), shifted(-0.5)], ids=["right", "left"])
def test_half_a_pixel_in_all_views_is_worse(data_dir: Path, shift: Mistake) -> None:
    """Intrinsics meant for other pixel centres: much of that cancels, and only exact depth tells."""
    room = data_dir / "room_living"
    assert agreement(pairs_of(room), shift, shift).depth > 2 * of_right(room).depth
