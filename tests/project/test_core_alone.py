"""The core trains and localizes by itself: what stands around it, ``bidnerf``, may be absent."""

from __future__ import annotations

import subprocess
import sys

import pytest

PROGRAM = """
import math
import sys
from importlib.abc import MetaPathFinder


class Absent(MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] == "bidnerf":
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)


sys.meta_path.insert(0, Absent())

import torch
from torch.nn.functional import interpolate

from bidnerf_core.backend import BACKENDS
from bidnerf_core.camera import Intrinsics
from bidnerf_core.frames import Frame, View
from bidnerf_core.geometry import look_at
from bidnerf_core.maps import Localizer
from bidnerf_core.maps import train

CAMERA = Intrinsics(130.0, 130.0, 64.0, 48.0, 128, 96)
generator = torch.Generator().manual_seed(0)
texture = sum(
    interpolate(torch.rand(1, 3, n, n, generator=generator), 256, mode="bilinear") / 3 for n in (12, 40, 120)
)


def seen(azimuth, elevation, name):
    '''An image of a textured square of 3 m at z = 0, with its depth, from 1.8 m away.'''
    flat = 1.8 * math.cos(elevation)
    eye = (flat * math.cos(azimuth), flat * math.sin(azimuth), 1.8 * math.sin(elevation))
    T = look_at(eye, (0.0, 0.0, 0.0))
    rows, columns = torch.meshgrid(torch.arange(96.0), torch.arange(128.0), indexing="ij")
    z = torch.ones(96, 128)
    rays = torch.stack([(columns + 0.5 - 64) / 130, (rows + 0.5 - 48) / 130, z], dim=-1).double()
    world = rays @ T.rotation.T
    depth = -T.translation[2] / world[..., 2]
    points = T.translation + depth[..., None] * world
    grid = (points[None, ..., :2] / 1.5).float()
    rgb = torch.nn.functional.grid_sample(texture, grid, align_corners=False, padding_mode="reflection")
    return View(Frame.from_numpy(rgb[0].permute(1, 2, 0), CAMERA, depth=depth.float(), name=name), T)


views = [seen(0.6 * n, 0.9 + 0.05 * (n % 5), f"{n:02d}") for n in range(12)]
assert {"vanilla", "hashgrid"} <= set(BACKENDS)
steps = {"steps": 40, "samples_per_step": 4096, "rays_at_most": 512}
scene = train(views, "hashgrid", config=steps, bake=True)
unseen = seen(0.3, 1.0, "unseen")
found = Localizer(scene)(unseen.frame)
assert found.converged, found.reason
off = float((found.T_world_camera.translation - unseen.T_ref_camera.translation).norm())
assert off < 0.02, off
assert not [name for name in sys.modules if name.partition(".")[0] == "bidnerf"]
print("localized")
"""


@pytest.mark.slow
def test_the_core_trains_and_localizes_without_the_product() -> None:
    done = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (0, "localized\n"), done.stderr[-2000:]
