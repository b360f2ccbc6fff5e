"""The two demo scenes, in closed form: a toy lorry and a furnished room. Metres; the world's z axis points up.

No rotation or reflection maps either onto itself, so poses are never ambiguous.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch

from bidnerf_core.fields import SceneBounds
from bidnerf_core.geometry import SE3
from bidnerf_core.scenes.closed_form import ClosedFormScene, Hits, views
from bidnerf_core.scenes.fields import GaussianBlobs, HomogeneousBall
from bidnerf_core.scenes.primitives import Box, Cylinder, Primitive, Shape, Sphere
from bidnerf_core.scenes.textures import Colour, Faces, Texture, blotches, checker, stripes
from bidnerf_core.scenes.trajectories import look_around, orbit

__all__ = [
    "ClosedFormScene",
    "GaussianBlobs",
    "Hits",
    "HomogeneousBall",
    "demo_object",
    "demo_room",
    "look_around",
    "orbit",
    "views",
]

NAVY: Colour = (0.15, 0.27, 0.42)
TEAL: Colour = (0.16, 0.62, 0.56)
SAND: Colour = (0.93, 0.78, 0.45)
ORANGE: Colour = (0.96, 0.60, 0.30)
RED: Colour = (0.88, 0.36, 0.28)
CREAM: Colour = (0.96, 0.94, 0.87)
SKY: Colour = (0.55, 0.78, 0.88)
BLUE: Colour = (0.25, 0.48, 0.66)
PLUM: Colour = (0.45, 0.30, 0.48)
ROSE: Colour = (0.86, 0.55, 0.62)
MOSS: Colour = (0.42, 0.56, 0.28)
LEAF: Colour = (0.64, 0.76, 0.38)
WOOD: Colour = (0.72, 0.51, 0.33)
OAK: Colour = (0.55, 0.37, 0.24)
SLATE: Colour = (0.30, 0.32, 0.36)
WHITE: Colour = (0.99, 0.98, 0.95)


def demo_object() -> ClosedFormScene:
    """Return a toy lorry, nose towards +x, within the cube from -1 to 1, in front of a white background."""
    bounds = SceneBounds((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0), 0.1, 12.0, (1.0, 1.0, 1.0))
    return ClosedFormScene([*_lorry(), *_wheels(), *_load()], bounds, "demo_object")


def demo_room() -> ClosedFormScene:
    """Return a living room of 4 x 3 x 2.5 m around the z axis with its floor at z = 0, to be seen from inside."""
    bounds = SceneBounds((-2.05, -1.55, -0.05), (2.05, 1.55, 2.55), 0.05, 6.0)
    parts = [*_walls(), *_table(), *_sofa(), *_shelf(), *_decoration()]
    return ClosedFormScene(parts, bounds, "demo_room", light=(0.45, -0.3, 0.85), contrast=0.4)


def _lorry() -> list[Primitive]:
    return [
        _solid(Box((0.9, 0.36, 0.09)), (0, 0, -0.36), stripes(NAVY, BLUE, (1, 0.6, 0), 0.3)),
        _solid(Box((0.24, 0.38, 0.38)), (0.44, 0, 0.1), blotches(RED, ORANGE, 0.5, 1)),
        _solid(Box((0.2, 0.39, 0.13)), (0.46, 0, 0.24), stripes(SKY, WHITE, (1, 0, 1), 0.32)),
        _solid(Box((0.16, 0.33, 0.19)), (0.79, 0, -0.09), checker(RED, SAND, (0.4, 0.3, 0.4))),
        _solid(Cylinder(0.07, 0.3), (0.76, 0.24, 0.3), stripes(SLATE, CREAM, (0, 0, 1), 0.2)),
        _solid(Sphere(0.085), (0.91, -0.19, -0.02), blotches(SAND, WHITE, 0.2, 2)),
        _solid(Sphere(0.085), (0.91, 0.19, -0.02), blotches(SAND, ORANGE, 0.2, 3)),
    ]


def _wheels() -> list[Primitive]:
    tyres = [
        ((0.58, -0.36), 0.25, SAND),
        ((0.58, 0.36), 0.25, TEAL),
        ((-0.5, -0.36), 0.3, ROSE),
        ((-0.5, 0.36), 0.3, SKY),
    ]
    wheels = []
    for (x, y), radius, hub in tyres:
        place = (x, y, radius - 0.85)
        outward = math.copysign(0.1, y)
        wheels.append(_solid(Cylinder(radius, 0.1), place, checker(SLATE, NAVY, 0.24, phase=x), roll=90))
        cap = (x, y + outward, radius - 0.85)
        wheels.append(
            _solid(Cylinder(0.6 * radius, 0.03), cap, blotches(hub, RED, 0.25, round(9 * x * y)), roll=90)
        )
    return wheels


def _load() -> list[Primitive]:
    return [
        _solid(Box((0.52, 0.03, 0.14)), (-0.37, 0.34, -0.14), checker(WOOD, OAK, (0.35, 0.3, 0.3))),
        _solid(Box((0.52, 0.03, 0.14)), (-0.37, -0.34, -0.14), checker(SAND, MOSS, (0.35, 0.3, 0.3))),
        _solid(Sphere(0.31), (-0.1, 0.03, 0.04), checker(TEAL, CREAM, 0.36)),
        _solid(Box((0.2, 0.18, 0.2)), (-0.6, -0.1, -0.05), blotches(LEAF, MOSS, 0.3, 4), yaw=25),
        _solid(Cylinder(0.13, 0.2), (-0.63, -0.08, 0.35), stripes(PLUM, ROSE, (1, 0, 2), 0.22)),
        _solid(
            Cylinder(0.1, 0.27), (-0.5, 0.22, -0.16), stripes(ORANGE, CREAM, (0, 1, 1), 0.2), roll=90, yaw=80
        ),
    ]


def _walls() -> list[Primitive]:
    paint = Faces(
        (
            stripes(SKY, CREAM, (0, 1, 0.25), 0.6),
            blotches(TEAL, SAND, 0.9, 11),
            checker(CREAM, ROSE, (0.8, 0.8, 0.6)),
            stripes(LEAF, CREAM, (1, 0, 0), 0.5),
            blotches(WHITE, CREAM, 1.2, 12),
            checker(WOOD, OAK, (0.9, 0.4, 9.0)),
        )
    )
    return [
        _solid(Box((2.0, 1.5, 1.25)), (0, 0, 1.25), paint),
        _solid(Cylinder(0.75, 0.012), (0.25, -0.1, 0.0), blotches(RED, NAVY, 0.5, 13)),
    ]


def _table() -> list[Primitive]:
    legs = [
        _solid(Cylinder(0.035, 0.34), (x, y, 0.34), stripes(OAK, SAND, (0, 0, 1), 0.3, phase=x))
        for x in (0.65, 1.35)
        for y in (-0.85, -0.35)
    ]
    return [
        *legs,
        _solid(Box((0.48, 0.36, 0.03)), (1.0, -0.6, 0.7), stripes(WOOD, SAND, (0.2, 1, 0), 0.28)),
        _solid(Sphere(0.13), (1.2, -0.5, 0.86), checker(ORANGE, CREAM, 0.2)),
        _solid(Box((0.12, 0.09, 0.07)), (0.8, -0.7, 0.8), blotches(PLUM, SKY, 0.2, 14), yaw=30),
        _solid(Box((0.22, 0.22, 0.22)), (0.3, -0.75, 0.22), checker(BLUE, CREAM, 0.3), yaw=20),
    ]


def _sofa() -> list[Primitive]:
    return [
        _solid(Box((0.8, 0.36, 0.2)), (-0.7, 1.12, 0.2), blotches(BLUE, NAVY, 0.4, 15)),
        _solid(Box((0.8, 0.1, 0.42)), (-0.7, 1.38, 0.42), blotches(BLUE, TEAL, 0.4, 16)),
        _solid(Box((0.1, 0.38, 0.3)), (-1.5, 1.1, 0.3), blotches(BLUE, NAVY, 0.35, 17)),
        _solid(Box((0.1, 0.38, 0.3)), (0.1, 1.1, 0.3), blotches(BLUE, PLUM, 0.35, 18)),
        _solid(Box((0.19, 0.07, 0.19)), (-1.15, 1.15, 0.58), checker(SAND, RED, 0.22), roll=-20, yaw=12),
        _solid(
            Box((0.19, 0.07, 0.19)),
            (-0.3, 1.15, 0.58),
            stripes(ROSE, CREAM, (1, 0, 1), 0.16),
            roll=-20,
            yaw=-15,
        ),
    ]


def _shelf() -> list[Primitive]:
    """Return the shelf, which stands against the wall at -x, with its books."""
    boards = [
        _solid(Box((0.16, 0.6, 0.02)), (-1.84, -0.6, z), stripes(WOOD, OAK, (0, 1, 0), 0.4))
        for z in (0.4, 0.85, 1.3)
    ]
    books = []
    paints = [
        (RED, CREAM),
        (TEAL, SAND),
        (NAVY, SKY),
        (ORANGE, PLUM),
        (LEAF, MOSS),
        (ROSE, CREAM),
        (BLUE, SAND),
    ]
    for i, (first, second) in enumerate(paints):
        tall, board, place = 0.13 + 0.015 * (3 * i % 5), (0.4, 0.85, 1.3)[i % 3], -1.05 + 0.14 * i
        paint = stripes(first, second, (0, 0.3, 1), 0.22, phase=float(i))
        books.append(_solid(Box((0.12, 0.07, tall)), (-1.85, place, board + 0.02 + tall), paint))
    return [*boards, *books, _solid(Sphere(0.12), (-1.84, -0.25, 1.44), checker(SKY, LEAF, 0.2))]


def _decoration() -> list[Primitive]:
    return [
        _solid(Box((0.02, 0.45, 0.35)), (1.99, 0.35, 1.5), blotches(SKY, WHITE, 0.45, 19)),
        _solid(Box((0.01, 0.51, 0.41)), (1.99, 0.35, 1.5), stripes(OAK, WOOD, (0, 1, 1), 0.4)),
        _solid(Box((0.4, 0.02, 0.28)), (-0.6, 1.49, 1.55), blotches(ORANGE, PLUM, 0.35, 20)),
        _solid(Box((0.22, 0.02, 0.3)), (0.55, 1.49, 1.45), checker(NAVY, SAND, 0.3)),
        _solid(Box((0.3, 0.02, 0.3)), (-0.7, -1.49, 1.5), blotches(RED, CREAM, 0.3, 21), pitch=45),
        _solid(Box((0.5, 0.02, 0.25)), (0.9, -1.49, 1.6), stripes(TEAL, NAVY, (1, 0, 2), 0.3)),
        _solid(Cylinder(0.16, 0.17), (1.65, 1.1, 0.17), stripes(ORANGE, RED, (1, 1, 1), 0.25)),
        _solid(Sphere(0.3), (1.62, 1.1, 0.62), blotches(MOSS, LEAF, 0.22, 22)),
        _solid(Sphere(0.2), (1.5, 0.95, 0.95), blotches(LEAF, MOSS, 0.2, 23)),
        _solid(Cylinder(0.02, 0.75), (0.75, 1.25, 0.75), stripes(SLATE, CREAM, (0, 0, 1), 0.3)),
        _solid(Cylinder(0.2, 0.16), (0.75, 1.25, 1.55), stripes(SAND, CREAM, (1, 0, 1), 0.2)),
        _solid(Sphere(0.17), (0.2, 0.3, 2.2), checker(CREAM, ORANGE, 0.24)),
    ]


def _solid(
    shape: Shape, place: Sequence[float], texture: Texture, yaw: float = 0, pitch: float = 0, roll: float = 0
) -> Primitive:
    """Return a shape rotated about x (roll), then y (pitch), then z (yaw), in degrees, and moved to ``place`` (metres)."""
    rotation = torch.eye(3, dtype=torch.float64)
    for axis, angle in enumerate((roll, pitch, yaw)):
        turn = torch.zeros(6, dtype=torch.float64)
        turn[3 + axis] = math.radians(angle)
        rotation = SE3.exp(turn).rotation @ rotation
    return Primitive(shape, SE3(rotation, torch.tensor(place, dtype=torch.float64)), texture)
