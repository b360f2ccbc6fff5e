"""Poses by landmarks that lie nearly in one plane, which two poses may explain.

    python benchmarks/planar_scenes.py [--queries 20] [--only poster]

Ten textured scenes in closed form (a facade, a poster on a bare wall, a floor; near and far; some with something off the
plane) are mapped from images of known pose, and queried from elsewhere, by images alone and without rendering. A plane that
takes up a small part of an image is explained about as well by a second pose, tilted to the other side of the line of sight
(Schweighofer and Pinz 2006, "Robust pose estimation from a planar target"). Wrong means farther off than 2 % of the distance
of what is seen, or than 2 degrees.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import torch
from _lab import answer, one_thread, parser, record
from jaxtyping import Float
from torch import Generator, Tensor
from torch.nn.functional import avg_pool2d, grid_sample

from bidnerf import Localizer
from bidnerf.evaluation import texture
from bidnerf.results import success_rate
from bidnerf.scenes import GaussianBlobs
from bidnerf_core.camera import Intrinsics
from bidnerf_core.errors import InputError
from bidnerf_core.fields import SceneBounds
from bidnerf_core.frames import Frame, View
from bidnerf_core.geometry import SE3, look_at
from bidnerf_core.localization import AutoConfig
from bidnerf_core.mapping import LandmarkMap, build_landmarks

CAMERA = Intrinsics(400.0, 400.0, 240.0, 180.0, 480, 360)
SUPERSAMPLED = 2
NOISE = 0.01
"""Standard deviation of the noise of each colour."""
GREY = 0.75
"""Brightness where there is nothing."""
POSITION, ANGLE = 0.02, 2.0
"""Largest errors of a right answer: share of the distance, degrees."""


@dataclass(frozen=True, eq=False)
class Rectangle:
    """A textured rectangle that faces +z before it is turned and moved."""

    T_world_own: SE3
    size: tuple[float, float]  # metres
    image: Float[Tensor, "1 3 h w"]

    def seen(self, origin: Tensor, directions: Float[Tensor, "r 3"]) -> tuple[Tensor, Tensor]:
        """Return the distance at which each ray meets it, infinite where it misses, and the colour there."""
        back = self.T_world_own.inverse().to(directions)
        o, d = back.apply(origin), back.rotate(directions)
        along = -o[2] / torch.where(d[:, 2].abs() > 1e-9, d[:, 2], 1e-9)
        half = torch.tensor(self.size) / 2
        at = (o + along[:, None] * d)[:, :2] / half
        rgb = grid_sample(self.image, at[None, None], padding_mode="border", align_corners=False)[0, :, 0].T
        return torch.where((at.abs() < 1).all(-1) & (along > 0), along, torch.inf), rgb


@dataclass(frozen=True, eq=False)
class PlanarScene:
    """Textured rectangles before grey, and where cameras stand: at a distance (metres) before a target."""

    name: str
    rectangles: Sequence[Rectangle]
    distance: float
    up: tuple[float, float, float] = (0.0, -1.0, 0.0)
    spread: float = 40.0  # degrees to either side of the plane's normal

    def view(self, T: SE3, name: str, generator: Generator) -> View:
        """Return an image from a pose."""
        fine = CAMERA.scaled(SUPERSAMPLED)
        flat = fine.unproject(fine.pixel_centres()).reshape(-1, 3).float()
        directions = T.to(torch.float32).rotate(torch.nn.functional.normalize(flat, dim=-1))
        nearest = torch.full((len(flat),), torch.inf)
        rgb = torch.full((len(flat), 3), GREY)
        for rectangle in self.rectangles:
            along, colour = rectangle.seen(T.translation.float(), directions)
            closer = along < nearest
            nearest, rgb = torch.where(closer, along, nearest), torch.where(closer[:, None], colour, rgb)
        image = avg_pool2d(rgb.view(fine.height, fine.width, 3).permute(2, 0, 1)[None], SUPERSAMPLED)[0]
        image = image.permute(1, 2, 0)
        image = image + NOISE * torch.randn(image.shape, generator=generator)
        return View(Frame(name, image.clamp(0, 1).contiguous(), CAMERA), T)

    def poses(self, count: int, generator: Generator) -> list[SE3]:
        """Return poses within the spread that look about at the middle."""
        found = []
        for _ in range(count):
            a, b, turn, near, *off = (2 * torch.rand(7, generator=generator) - 1).tolist()
            a, b = math.radians(self.spread) * a, math.radians(self.spread) * b
            out = torch.tensor([math.sin(a) * math.cos(b), math.sin(b), math.cos(a) * math.cos(b)])
            target = 0.08 * self.distance * torch.tensor(off)
            T = look_at(self.distance * (1 + 0.2 * near) * out, target, self.up)
            roll = torch.tensor([0.0, 0.0, 0.0, 0.0, 0.0, 0.2 * turn], dtype=torch.float64)
            found.append(T.retract(roll))
        return found


@dataclass(frozen=True, eq=False)
class PlanarMap:
    """A map of landmarks alone; nothing is rendered in its field."""

    landmarks: LandmarkMap
    field: GaussianBlobs
    bounds: SceneBounds
    surface: None = None
    colour_noise: float | None = 1.0
    has_distances: bool = True


def rectangle(width: float, height: float, seed: int, pixels: int, at: Sequence[float] = (0, 0, 0)) -> Rectangle:
    """Return a rectangle that faces +z, whose texture has ``pixels`` on its longer side."""
    rows, columns = (max(16, round(pixels * side / max(width, height))) for side in (height, width))
    image = texture(rows, columns, Generator().manual_seed(seed)).permute(2, 0, 1)[None]
    T = SE3(torch.eye(3, dtype=torch.float64), torch.tensor(at, dtype=torch.float64))
    return Rectangle(T, (width, height), image)


def scenes() -> list[PlanarScene]:
    """Return the ten scenes."""
    facade = rectangle(14, 9, 1, 900)
    balcony, sign = (
        rectangle(2.5, 1.0, 2, 160, (1.5, 0.5, 1.2)),
        rectangle(1.2, 1.2, 3, 120, (-2.5, -1.0, 0.8)),
    )
    poster, small = rectangle(0.8, 0.6, 4, 200), rectangle(0.5, 0.4, 5, 90)
    lamp = rectangle(0.15, 0.15, 6, 60, (0.55, 0.1, 0.25))
    floor, tall = rectangle(6, 6, 7, 700), rectangle(0.8, 0.8, 8, 120, (0.8, 0.6, 0.7))
    return [
        PlanarScene("facade near", [facade], 7.0),
        PlanarScene("facade far", [facade], 40.0),
        PlanarScene("facade far, balcony", [facade, balcony, sign], 40.0),
        PlanarScene("poster near", [poster], 1.2),
        PlanarScene("poster far", [poster], 4.5),
        PlanarScene("small poster far", [small], 4.5),
        PlanarScene("poster far, lamp", [poster, lamp], 4.5),
        PlanarScene("floor near", [floor], 3.0, spread=55.0),
        PlanarScene("floor far", [floor], 22.0, spread=55.0),
        PlanarScene("floor far, table", [floor, tall], 22.0, spread=55.0),
    ]


def make_map(scene: PlanarScene, generator: Generator) -> tuple[PlanarMap, Localizer]:
    """Return a map of a scene from images of known pose, and what localizes in it without rendering."""
    training = [scene.view(T, f"{i:04d}", generator) for i, T in enumerate(scene.poses(16, generator))]
    side = 2 * scene.distance
    bounds = SceneBounds((-side,) * 3, (side,) * 3, 0.01 * side, 2 * side)
    landmarks = build_landmarks(training)
    if landmarks is None:
        raise InputError(f"{scene.name}: no landmarks")
    found = PlanarMap(landmarks, GaussianBlobs.random(samples=2), bounds)
    return found, Localizer(found, config=AutoConfig(fused_rays=0))


def measure(scene: PlanarScene, queries: int, seed: int) -> list[dict[str, Any]]:
    """Map a scene and localize images in it."""
    generator = Generator().manual_seed(seed)
    planar, localizer = make_map(scene, generator)
    rows = []
    for i, T in enumerate(scene.poses(queries, generator)):
        view = scene.view(T, f"query {i}", generator)
        try:
            row = answer(lambda view=view: localizer(view.frame, seed=0), view)  # type: ignore[misc]
        except InputError:
            row = {"translation": None, "rotation_deg": 180.0, "normalized_error_squared": None}
            row |= {"converged": False, "outcome": "no landmarks recognised", "cpu_seconds": 0.0}
        off = row["translation"]
        right = off is not None and off < POSITION * scene.distance and row["rotation_deg"] < ANGLE
        rows.append(row | {"right": right, "scene": scene.name, "landmarks": len(planar.landmarks)})
    return rows


def summary(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return counts of answers."""
    wrong = [row for row in rows if row["converged"] and not row["right"]]
    right = sum(row["right"] for row in rows)
    missed = sum(row["right"] and not row["converged"] for row in rows)
    return {
        "n": len(rows),
        "right": right,
        "accepted": sum(row["converged"] for row in rows),
        "silent": len(wrong),
        "right_not_believed": missed,
        "share_not_believed": asdict(success_rate(missed, max(right, 1))),
        "outcomes": {o: sum(r["outcome"] == o for r in rows) for o in sorted({r["outcome"] for r in rows})},
        "silent_errors": [(row["translation"], row["rotation_deg"], row["normalized_error_squared"]) for row in wrong],
    }


def main() -> None:
    arguments = parser(__doc__, "planar_scenes")
    arguments.add_argument("--queries", type=int, default=20, help="of each scene (default: %(default)s)")
    arguments.add_argument("--only", default="", help="part of the names of the scenes to take")
    given = arguments.parse_args()
    one_thread()
    found: dict[str, Any] = {}
    every: list[dict[str, Any]] = []
    for number, scene in enumerate(scenes()):
        if given.only in scene.name:
            rows = measure(scene, given.queries, number)
            every += rows
            found[scene.name] = summary(rows) | {"landmarks": rows[0]["landmarks"]}
            print(scene.name, found[scene.name], flush=True)
    print("all", summary(every))
    record(given.name, {"scenes": found, "all": summary(every)})


if __name__ == "__main__":
    main()
