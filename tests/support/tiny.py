"""What tests of the command line, of storage and of training share: a scene, a dataset on disk, a map, all tiny."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from bidnerf.scenes import demo_object, orbit
from bidnerf.scenes import views as seen_from
from bidnerf_core.camera import Intrinsics
from bidnerf_core.fields import Observations, Rays
from bidnerf_core.frames import View, all_pixels, observe
from bidnerf_core.io import to_plain
from bidnerf_core.maps import Anchor
from bidnerf_core.training import TrainingBatch
from bidnerf_hashgrid import HashGridConfig
from bidnerf_hashgrid.encoding import HashEncodingConfig
from optional import require
from scan_layouts import millimetres, opengl, write_image

SIZE = 24
BACKGROUND = demo_object().bounds.background
CAMERA = Intrinsics(32.0, 32.0, SIZE / 2, SIZE / 2, SIZE, SIZE)
ENCODING = HashEncodingConfig(levels=3, log2_table_size=9, base_resolution=4, finest_resolution=16)
STEPS = 12


def config(steps: int = STEPS, **changes: Any) -> HashGridConfig:
    """A field that trains in milliseconds a step; pruning begins within the few steps that tests take."""
    settings: dict[str, Any] = {
        "encoding": ENCODING,
        "width": 16,
        "geometry_features": 3,
        "grid_resolution": 16,
        "coarse_levels": 1,
        "steps": steps,
        "samples_per_step": 2048,
        "rays_at_most": 256,
        "prune_from": 4,
        "prune_every": 4,
    }
    return HashGridConfig(**(settings | changes))


def options(steps: int = STEPS) -> list[str]:
    """Return the options of the command line that make such a field."""
    plain = {f: getattr(ENCODING, f) for f in ("levels", "log2_table_size", "base_resolution", "finest_resolution")}
    chosen = config(steps)
    names = ("width", "geometry_features", "grid_resolution", "coarse_levels", "steps", "samples_per_step")
    plain |= {name: getattr(chosen, name) for name in (*names, "rays_at_most", "prune_from", "prune_every")}
    words = [word for name, value in plain.items() for word in (f"--{name.replace('_', '-')}", str(value))]
    return [*words, "--no-bake"]


def views(count: int = 6, seed: int = 0) -> list[View]:
    return seen_from(demo_object(), CAMERA, orbit(3.5, count, seed=seed))


def black_batch(rays: Rays, distance: torch.Tensor) -> TrainingBatch:
    """Black pixels with measured distances (r; metres, 0 for none), before black."""
    coloured = torch.ones(len(distance), dtype=torch.bool)
    black = torch.zeros_like(rays.origins)
    observed = Observations(rays.origins, rays.directions, black, distance, coloured)
    return TrainingBatch(rays, observed, black, torch.zeros(len(black), dtype=torch.long), torch.zeros_like(distance))


def write_anchor(folder: Path, anchor: Anchor) -> None:
    """Write the anchor of the map in a folder into a file of its own, as users do."""
    (folder / "anchor.json").write_text(json.dumps(to_plain(anchor)))


def write_dataset(folder: Path, train: int = 6, test: int = 3, depth: bool = True) -> Path:
    """Views of the closed-form scene as nerfstudio's dialect has them; test frames are called t_0000 ..."""
    seen = [("train", "r", view) for view in views(train)] + [("test", "t", view) for view in views(test, seed=1)]
    frames, listed = [], {"train_filenames": [], "test_filenames": []}
    for split, letter, view in seen:
        name = f"images/{letter}_{view.frame.name}.png"
        frame: dict[str, Any] = {"file_path": name, "transform_matrix": opengl(view).tolist()}
        cover = require(view.frame.alpha)[..., None]
        colour = (view.frame.rgb - (1 - cover) * torch.tensor(BACKGROUND)) / cover.clamp(min=1e-3)
        rgba = torch.cat([colour.clamp(0, 1), cover], dim=-1)
        write_image(folder / name, (rgba * 255).round().to(torch.uint8).numpy())
        if depth:
            frame["depth_file_path"] = f"depth/{letter}_{view.frame.name}.png"
            write_image(folder / frame["depth_file_path"], millimetres(view))
        frames.append(frame)
        listed[f"{split}_filenames"].append(name)
    camera = {"fl_x": CAMERA.fx, "fl_y": CAMERA.fy, "cx": CAMERA.cx, "cy": CAMERA.cy, "w": SIZE, "h": SIZE}
    (folder / "transforms.json").write_text(json.dumps(camera | {"frames": frames} | listed))
    return folder


def depth_rays_of(views: Sequence[View]) -> Observations:
    """Return all pixels with measured depth as rays without colour, in the views' reference frame; float64."""
    parts = [observe(view, all_pixels(view.frame), torch.float64, "cpu") for view in views]
    every = Observations.joined(parts)
    measured = every[every.measured]
    return Observations.of_depth(measured.origins, measured.directions, measured.distance)
