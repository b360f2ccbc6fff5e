"""One field over a building beside fields by cell with fewer weights: what each shows of new photos, and the CPU time of its training.

    python benchmarks/fields_by_cell.py

Eight rooms in a row, of the building of ``_building.py``, are photographed with depth. A hash grid over all, and hash grids by cell with
smaller tables and batches but more steps, are trained on the photos, on one thread, for about the same CPU time. The borders of the cells lie between rooms, which
is the best place for them. Photos from elsewhere, which closed form gives, are compared with what the fields show: the error of the
colours (PSNR), and of the distances along the rays.
"""

from __future__ import annotations

import json
import time
from dataclasses import replace
from functools import partial
from typing import Any

import torch
from _building import CAMERA, PHOTOS, bounds_of, photo, poses_in, room_scene
from _lab import RESULTS, Row, RowStore, one_thread, parser, record

from bidnerf_core.backend import SceneBounds, View, load_backend, render
from bidnerf_core.frames import all_pixels, observe
from bidnerf_core.settings import from_flat
from bidnerf_core.training import Silent, TrainingStep

ROOMS = range(8)
NEW_PHOTOS, PIXELS = 4, 4_000
"""Number of photos of a room that are compared, and of pixels of each."""
NEAR = 0.05
"""Error of a distance that counts as small, metres."""
SMALL = ["log2_table_size=15", "samples_per_step=2048"]
"""Settings of the fields of cells."""
FIELDS: dict[str, tuple[str, dict[str, Any]]] = {
    "one field": ("hashgrid", {"log2_table_size": 19, "steps": 1_800}),
    "8 cells, borders between rooms": ("cells", {"cells": 8, "inner_settings": SMALL, "steps": 5_400}),
}


class LossOnly(Silent):
    def step(self, progress: TrainingStep) -> None:
        self.last = progress


def photos(count: int, seed: int) -> list[View]:
    """Return photos of all rooms with depth, those of each ``seed`` from elsewhere."""
    found = []
    for room in ROOMS:
        for number, T in enumerate(poses_in(room, count, seed)):
            view = photo(room, T, f"{seed}-{room}-{number}")
            rays, length = CAMERA.rays(CAMERA.pixel_centres())
            distance, _ = room_scene(room).intersect(T.translation.float(), T.to(rays).rotate(rays))
            found.append(replace(view, frame=view.frame.replace(depth=distance / length)))
    return found


def building() -> SceneBounds:
    """Return the bounds of all rooms."""
    rooms = [bounds_of(room) for room in ROOMS]
    x, y, z = (min(room.lower[axis] for room in rooms) for axis in range(3))
    upper = [max(room.upper[axis] for room in rooms) for axis in range(3)]
    footprint = 2.0 / CAMERA.fx  # metres: a pixel at half the length of a room
    return SceneBounds((x, y, z), (upper[0], upper[1], upper[2]), 0.05, 10.0, footprint=footprint)


def train_and_compare(name: str, settings: dict[str, Any]) -> Row:
    """Train a field, and return its size, the CPU time of its training and the errors of what it shows."""
    backend, bounds = load_backend(name), building()
    config = from_flat(backend.config_type, settings, name)
    field: Any = backend.build(config, bounds)
    views = photos(PHOTOS, 0)
    began = time.process_time()
    backend.train(field, views, config, LossOnly())
    trained = time.process_time()
    field.requires_grad_(False).eval()
    squared, away, generator = list[torch.Tensor](), list[torch.Tensor](), torch.Generator().manual_seed(0)
    for view in photos(NEW_PHOTOS, 1):
        pixels = all_pixels(view.frame)
        seen = observe(view, pixels[torch.randperm(len(pixels), generator=generator)[:PIXELS]])
        shown = render(field, bounds.rays(seen.origins, seen.directions), bounds.background)
        squared.append((shown.rgb - seen.rgb).square().mean(-1))
        away.append((shown.distance / shown.opacity.clamp(min=0.5) - seen.distance).abs())
    error, distance = torch.cat(squared), torch.cat(away)
    return {
        "weights": sum(part.numel() for part in field.parameters()),
        "cpu_seconds": trained - began,
        "seconds_of_rendering": time.process_time() - trained,
        "psnr": float(-10 * error.mean().log10()),
        "median_distance_error": float(distance.median()),
        "within_5_cm": float((distance < NEAR).float().mean()),
    }


def main() -> None:
    options = parser(__doc__, "fields_by_cell").parse_args()
    one_thread()
    results: dict[str, Any] = {"rooms": len(ROOMS), "photos": len(ROOMS) * PHOTOS}
    with RowStore(RESULTS / f"{options.name}.rows.jsonl") as store:
        for title, (name, settings) in FIELDS.items():
            results[title] = store.get([title, settings], partial(train_and_compare, name, settings)) | settings
            print(title, json.dumps(results[title]), flush=True)
    record(options.name, results)


if __name__ == "__main__":
    main()
