"""A building of look-alike rooms in closed form, whose photos are rendered when they are needed.

All rooms have the same size, wallpaper, floor and furniture, at the same places. They differ in the pictures on their walls, two on each,
and in the cloth on the table. Photos are taken all over a room, in all directions.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import overload

import torch
from torch import Generator, Tensor

import bidnerf.scenes
import bidnerf_core.mapping
from bidnerf.scenes import ClosedFormScene, Faces, Primitive, Texture, blotches, box, look_around
from bidnerf_core.camera import Intrinsics
from bidnerf_core.fields import SceneBounds
from bidnerf_core.frames import Frame, View
from bidnerf_core.geometry import SE3
from bidnerf_core.mapping import SIFT, Keypoints, detect_keypoints

PHOTOS = 20
"""Number of photos of each room."""
SIZE, PITCH = (4.0, 3.2, 2.6), (4.4, 3.6, 3.0)
"""Size of a room, and distances between rooms, metres."""
COLUMNS, ROWS = 10, 8
"""Number of rooms of a floor along each axis."""
CAMERA = Intrinsics.from_hfov(75.0, 280, 210)
NOISE = 0.01
"""Standard deviation of the noise of each colour."""
FURNITURE = (  # centre relative to that of the room, and half of the size, metres
    ((-1.55, 0.3, -0.8), (0.4, 0.7, 0.5)),
    ((1.4, -1.1, -0.9), (0.55, 0.4, 0.4)),
    ((0.2, 1.25, -1.0), (0.8, 0.3, 0.3)),
    ((0.3, -0.1, -0.95), (0.5, 0.35, 0.35)),
)


def at(*place: float) -> SE3:
    return SE3(torch.eye(3, dtype=torch.float64), torch.tensor(place, dtype=torch.float64))


def paint(seed: int, period: float) -> Texture:
    """Return spots in two colours that depend on ``seed``."""
    first, second = torch.rand((2, 3), generator=Generator().manual_seed(seed)).tolist()
    dark, light = ([0.45 * c for c in first], [0.5 + 0.5 * c for c in second])
    return blotches((dark[0], dark[1], dark[2]), (light[0], light[1], light[2]), period, seed)


def corner_of(room: int) -> tuple[float, float, float]:
    """Return the lower corner of a room, metres."""
    column, row, floor = room % COLUMNS, room // COLUMNS % ROWS, room // (COLUMNS * ROWS)
    return column * PITCH[0], row * PITCH[1], floor * PITCH[2]


def bounds_of(room: int) -> SceneBounds:
    lower = corner_of(room)
    x, y, z = (low + side for low, side in zip(lower, SIZE, strict=True))
    return SceneBounds(lower, (x, y, z), 0.05, 10.0)


@lru_cache(maxsize=2)
def room_scene(room: int) -> ClosedFormScene:
    """Return a room: its walls, its furniture, and what only this room has."""
    bounds = bounds_of(room)
    x, y, z = ((low + high) / 2 for low, high in zip(bounds.lower, bounds.upper, strict=True))
    half = [side / 2 for side in SIZE]
    walls = [paint(seed, 0.5) for seed in range(6)]
    solids = [Primitive(box((half[0], half[1], half[2])), at(x, y, z), Faces((*walls,)))]
    solids += [
        Primitive(box(size), at(x + dx, y + dy, z + dz), paint(10 + number, 0.3))
        for number, ((dx, dy, dz), size) in enumerate(FURNITURE)
    ]
    generator = Generator().manual_seed(room)
    for wall in range(4):
        axis, side = wall // 2, 1 - 2 * (wall % 2)
        for number in range(2):
            along, up, width, height = torch.rand(4, generator=generator).tolist()
            extent = [0.4 + 0.2 * width, 0.3 + 0.2 * height]
            middle = [(number - 0.5 + 0.3 * (along - 0.5)) * half[1 - axis], 0.2 + 0.3 * up]
            size = (0.015, extent[0], extent[1]) if axis == 0 else (extent[0], 0.015, extent[1])
            place = (side * half[0], middle[0]) if axis == 0 else (middle[0], side * half[1])
            own = paint(1_000 + 16 * room + 2 * wall + number, 0.14)
            solids.append(Primitive(box(size), at(x + place[0], y + place[1], z + middle[1]), own))
    top = FURNITURE[-1][0][2] + FURNITURE[-1][1][2]
    cloth = Primitive(box((0.3, 0.25, 0.01)), at(x + 0.3, y - 0.1, z + top), paint(1_000 + 16 * room + 8, 0.14))
    return ClosedFormScene([*solids, cloth], bounds, f"room {room}")


def poses_in(room: int, count: int = PHOTOS, seed: int = 0) -> list[SE3]:
    """Return poses of photos all over a room; those of other seeds are elsewhere."""
    return look_around(bounds_of(room), count, 1_000 * seed + room)


@lru_cache(maxsize=32)
def photo(room: int, T_world_camera: SE3, name: str) -> View:
    """Return a photo of a room, with noise."""
    flat = CAMERA.unproject(CAMERA.pixel_centres())
    rays = T_world_camera.to(flat).rotate(torch.nn.functional.normalize(flat, dim=-1))
    _, rgb = room_scene(room).intersect(T_world_camera.translation.float(), rays)
    seed = int.from_bytes(hashlib.blake2b(name.encode(), digest_size=4).digest())
    rgb = rgb + NOISE * torch.randn(rgb.shape, generator=Generator().manual_seed(seed))
    return View(Frame(name, rgb.clamp(0, 1).mul(255).round().byte(), CAMERA), T_world_camera)


class Photos(Sequence[View]):
    """The first photos of the building, room by room, each rendered when it is asked for."""

    def __init__(self, count: int) -> None:
        self.poses = [T for room in range(-(-count // PHOTOS)) for T in poses_in(room)][:count]

    def __len__(self) -> int:
        return len(self.poses)

    @overload
    def __getitem__(self, number: int) -> View: ...
    @overload
    def __getitem__(self, number: slice) -> list[View]: ...
    def __getitem__(self, number: int | slice) -> View | list[View]:
        if isinstance(number, slice):
            return [self[each] for each in range(*number.indices(len(self)))]
        return photo(number // PHOTOS, self.poses[range(len(self))[number]], f"{number:04d}")


def folder_of_keypoints(cache: Path) -> Path:
    """Return the folder of the building's keypoints, which depends on the code that renders and detects."""
    hashed = hashlib.blake2b(Path(__file__).read_bytes(), digest_size=6)
    for package, part in ((bidnerf.scenes, "*.py"), (bidnerf_core.mapping, "landmarks/features.py")):
        for file in sorted(Path(str(package.__file__)).parent.glob(part)):
            hashed.update(file.read_bytes())
    return cache / f"building-{hashed.hexdigest()}"


def keypoints_of(count: int, folder: Path) -> list[Keypoints]:
    """Return the keypoints of the first photos, which ``folder`` keeps: a file of each room."""
    folder.mkdir(parents=True, exist_ok=True)
    views, found = Photos(count), list[Keypoints]()
    for room in range(count // PHOTOS):
        file = folder / f"{room}.pt"
        if not file.exists():
            own = [views[number] for number in range(room * PHOTOS, (room + 1) * PHOTOS)]
            detections = [image.keypoints for image in detect_keypoints(own, SIFT)]
            torch.save([(k.pixels, k.sizes, k.descriptors) for k in detections], file.with_suffix(".part"))
            file.with_suffix(".part").rename(file)
        found += [Keypoints(*parts) for parts in torch.load(file)]
    return found


class StoredKeypoints:
    """A detector of images that show their number, see ``numbered``."""

    takes_bytes = True

    def __init__(self, keypoints: Sequence[Keypoints]) -> None:
        self.keypoints = keypoints

    def __call__(self, rgb: Tensor) -> Keypoints:
        high, middle, low = rgb[0, 0].tolist()
        return self.keypoints[65_536 * high + 256 * middle + low]


def numbered(photos: Photos) -> list[View]:
    """Return views with the poses of photos, each of whose pixels is the number of the photo."""
    found = []
    for number, T in enumerate(photos.poses):
        pixel = torch.tensor([number // 65_536, number // 256 % 256, number % 256], dtype=torch.uint8)
        found.append(View(Frame(f"{number:04d}", pixel.expand(CAMERA.height, CAMERA.width, 3), CAMERA), T))
    return found
