"""Acceptance of poses in a scene that repeats itself.

    python benchmarks/repeated_scene.py MAP:DATA [MAP:DATA ...] [--frames 40]

Each map is doubled: its field and its landmarks are repeated far away, turned by 0, 90 or 180 degrees about an axis of the
world. Each copy's descriptors get noise of their own, as if each had been built from its own photos. The test frames show
nothing that distinguishes the copies, so that no pose should be accepted, from images alone or with measured depth. With a
start near the true pose (a tenth of the copies' distance away; only where the copy is not turned), the pose in the right copy
should be accepted. The doubled maps have no surface.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import asdict, replace
from typing import Any

import torch
from _lab import Scene, answer, one_thread, parser, record, within, without_depth
from torch import Generator, Tensor, nn

from bidnerf import Localizer, Map
from bidnerf.results import success_rate
from bidnerf_core.errors import InputError
from bidnerf_core.fields import FieldValues, RadianceField, Rays, RaySamples, SceneBounds
from bidnerf_core.frames import View
from bidnerf_core.geometry import SE3
from bidnerf_core.mapping import LandmarkMap

TURNS = (0.0, 90.0, 180.0)
DESCRIPTOR_NOISE = 5.0
"""Standard deviation of the noise in each channel of a descriptor, whose values range from 0 to 255."""


class DoubledField(nn.Module):
    """A field and its copy; points and rays belong to the nearer one."""

    def __init__(self, field: RadianceField, bounds: SceneBounds, T_world_copy: SE3) -> None:
        super().__init__()
        self.field, self._bounds, self._T = field, bounds, T_world_copy.to("cpu", torch.float32)

    @property
    def sampler(self) -> DoubledField:
        return self

    def forward(self, rays: Rays, jitter: Generator | None = None) -> RaySamples:
        origins, directions = self._home(rays.origins, rays.directions)
        return self.field.sampler(self._bounds.rays(origins, directions), jitter)

    def query(self, positions: Tensor, directions: Tensor) -> FieldValues:
        return self.field.query(*self._home(positions, directions.expand_as(positions)))

    def _home(self, positions: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        """Return positions and directions in the frame of the copy to which they belong."""
        centre = positions.new_tensor(self._bounds.centre)
        there = (positions - self._T.apply(centre)).norm(dim=-1) < (positions - centre).norm(dim=-1)
        back = self._T.inverse()
        return (
            torch.where(there[..., None], back.apply(positions), positions),
            torch.where(there[..., None], back.rotate(directions), directions),
        )


def double(map: Map, T_world_copy: SE3) -> Map:
    """Return a map with its field and landmarks doubled, without its surface."""
    if map.landmarks is None:
        raise InputError("a map without landmarks, expected one that was baked")
    bounds = map.bounds
    copy = T_world_copy.translation
    lower, upper = torch.tensor(bounds.lower), torch.tensor(bounds.upper)
    reach = (upper - lower).norm()
    wide = replace(
        bounds,
        lower=tuple((torch.minimum(lower, lower + copy) - reach).tolist()),
        upper=tuple((torch.maximum(upper, upper + copy) + reach).tolist()),
    )
    field = DoubledField(map.field, bounds, T_world_copy).eval()
    info = replace(map.info, bounds=wide)
    return replace(map, info=info, field=field, surface=None, landmarks=twice(map.landmarks, T_world_copy))


def twice(landmarks: LandmarkMap, T_world_copy: SE3, share: float = 1.0) -> LandmarkMap:
    """Return landmarks of which a random share is repeated elsewhere; the descriptors of all get noise."""
    T, generator = T_world_copy.to("cpu", torch.float32), Generator().manual_seed(0)
    chosen = torch.rand(len(landmarks), generator=Generator().manual_seed(1)) < share

    def with_chosen(here: Tensor, there: Tensor | None = None) -> Tensor:
        return torch.cat([here, (here if there is None else there)[chosen]])

    descriptors = with_chosen(landmarks.descriptors)
    noise = DESCRIPTOR_NOISE * torch.randn(descriptors.shape, generator=generator)
    return replace(
        landmarks,
        positions=with_chosen(landmarks.positions, T.apply(landmarks.positions)),
        directions=with_chosen(landmarks.directions, T.rotate(landmarks.directions)),
        descriptors=(descriptors + noise).round().clamp(0, 255).to(descriptors.dtype),
        deviations=with_chosen(landmarks.deviations),
        cones=with_chosen(landmarks.cones),
        sizes=with_chosen(landmarks.sizes),
        views=with_chosen(landmarks.views),
    )


def copies(bounds: SceneBounds) -> list[SE3]:
    """Return poses for the copy of a map, so far away that neither is within the space that the other models."""
    away = torch.tensor([4 * max(bounds.far, bounds.side), 0.0, 0.0], dtype=torch.float64)
    found = []
    for turn in TURNS:
        c, s = math.cos(math.radians(turn)), math.sin(math.radians(turn))
        rotation = torch.tensor([[c, -s, 0], [s, c, 0], [0, 0, 1]], dtype=torch.float64)
        found.append(SE3(rotation, away))
    return found


def judge_answer(localizer: Localizer, view: View, near: SE3 | None) -> tuple[bool, bool, str]:
    """Return whether the answer is accepted, whether it is right, and its outcome."""
    try:
        row = answer(lambda: localizer(view.frame, near, seed=0), view)
    except InputError:
        return False, False, "no landmarks recognised"
    return row["converged"], within(row), row["outcome"]


def measure(scene: Map, views: list[View]) -> dict[str, Any]:
    """Return counts over all frames and copies, of images alone and with depth, without and with a start."""
    counts: dict[str, Counter[str]] = {}
    for number, T_world_copy in enumerate(copies(scene.bounds)):
        localizer = Localizer(double(scene, T_world_copy))
        off = torch.zeros(6, dtype=torch.float64)
        off[0] = 0.1 * float(T_world_copy.translation.norm())
        for view in views:
            colour = without_depth(view)
            modes: list[tuple[str, View, SE3 | None]] = [("RGB", colour, None)]
            modes += [("RGB, start", colour, view.T_ref_camera.retract(off))] if number == 0 else []
            modes += [("RGB-D", view, None)] if view.frame.has_depth else []
            for name, given, near in modes:
                accepted, right, outcome = judge_answer(localizer, given, near)
                both = {"believed": accepted, "right": right, "believed and right": accepted and right}
                counts.setdefault(name, Counter()).update({"n": 1, outcome: 1} | both)
    return {name: dict(count) for name, count in counts.items()}


def main() -> None:
    given = parser(__doc__, "repeated_scene", scenes=True).parse_args()
    one_thread()
    scenes: dict[str, Any] = {}
    total: dict[str, Counter[str]] = {}
    for scene in map(Scene.open, given.scenes):
        found = scenes[scene.folder.name] = measure(scene.map, scene.views(given.tuning_frames, given.frames))
        print(scene.folder.name, found, flush=True)
        for name, count in found.items():
            total.setdefault(name, Counter()).update(count)
    believed = {name: asdict(success_rate(count["believed"], count["n"])) for name, count in total.items()}
    record(given.name, {"scenes": scenes, "all": {n: dict(c) for n, c in total.items()}, "believed": believed})


if __name__ == "__main__":
    main()
