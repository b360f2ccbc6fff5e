"""The two demo scenes, in closed form: a toy lorry and a furnished room. Metres; the world's z axis points up.

No rotation or reflection maps either onto itself, so poses are never ambiguous.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from types import SimpleNamespace

import torch

from bidnerf.scenes.closed_form import ClosedFormScene
from bidnerf.scenes.primitives import (
    Faces,
    Primitive,
    Shape,
    Texture,
    ball,
    blotches,
    box,
    checker,
    cylinder,
    stripes,
)
from bidnerf_core.fields import SceneBounds
from bidnerf_core.geometry import SE3

C = SimpleNamespace(
    navy=(0.15, 0.27, 0.42),
    teal=(0.16, 0.62, 0.56),
    sand=(0.93, 0.78, 0.45),
    orange=(0.96, 0.60, 0.30),
    red=(0.88, 0.36, 0.28),
    cream=(0.96, 0.94, 0.87),
    sky=(0.55, 0.78, 0.88),
    blue=(0.25, 0.48, 0.66),
    plum=(0.45, 0.30, 0.48),
    rose=(0.86, 0.55, 0.62),
    moss=(0.42, 0.56, 0.28),
    leaf=(0.64, 0.76, 0.38),
    wood=(0.72, 0.51, 0.33),
    oak=(0.55, 0.37, 0.24),
    slate=(0.30, 0.32, 0.36),
    white=(0.99, 0.98, 0.95),
)
"""The colours of the scenes."""


def demo_object() -> ClosedFormScene:
    """Return a toy lorry within the cube from -1 to 1, with its nose towards +x, in front of a white background."""
    bounds = SceneBounds((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0), 0.1, 12.0, (1.0, 1.0, 1.0))
    tyres = [
        ((0.58, -0.36), 0.25, C.sand),
        ((0.58, 0.36), 0.25, C.teal),
        ((-0.5, -0.36), 0.3, C.rose),
        ((-0.5, 0.36), 0.3, C.sky),
    ]
    wheels = [
        _solid(disc, (x, y + math.copysign(outward, y), radius - 0.85), paint, roll=90)
        for (x, y), radius, hub in tyres
        for disc, outward, paint in (
            (cylinder(radius, 0.1), 0.0, checker(C.slate, C.navy, 0.24, phase=x)),
            (cylinder(0.6 * radius, 0.03), 0.1, blotches(hub, C.red, 0.25, round(9 * x * y))),
        )
    ]
    solids = [
        _solid(box((0.9, 0.36, 0.09)), (0, 0, -0.36), stripes(C.navy, C.blue, (1, 0.6, 0), 0.3)),
        _solid(box((0.24, 0.38, 0.38)), (0.44, 0, 0.1), blotches(C.red, C.orange, 0.5, 1)),
        _solid(box((0.2, 0.39, 0.13)), (0.46, 0, 0.24), stripes(C.sky, C.white, (1, 0, 1), 0.32)),
        _solid(box((0.16, 0.33, 0.19)), (0.79, 0, -0.09), checker(C.red, C.sand, (0.4, 0.3, 0.4))),
        _solid(cylinder(0.07, 0.3), (0.76, 0.24, 0.3), stripes(C.slate, C.cream, (0, 0, 1), 0.2)),
        _solid(ball(0.085), (0.91, -0.19, -0.02), blotches(C.sand, C.white, 0.2, 2)),
        _solid(ball(0.085), (0.91, 0.19, -0.02), blotches(C.sand, C.orange, 0.2, 3)),
        *wheels,
        _solid(box((0.52, 0.03, 0.14)), (-0.37, 0.34, -0.14), checker(C.wood, C.oak, (0.35, 0.3, 0.3))),
        _solid(box((0.52, 0.03, 0.14)), (-0.37, -0.34, -0.14), checker(C.sand, C.moss, (0.35, 0.3, 0.3))),
        _solid(ball(0.31), (-0.1, 0.03, 0.04), checker(C.teal, C.cream, 0.36)),
        _solid(box((0.2, 0.18, 0.2)), (-0.6, -0.1, -0.05), blotches(C.leaf, C.moss, 0.3, 4), yaw=25),
        _solid(cylinder(0.13, 0.2), (-0.63, -0.08, 0.35), stripes(C.plum, C.rose, (1, 0, 2), 0.22)),
        _solid(
            cylinder(0.1, 0.27),
            (-0.5, 0.22, -0.16),
            stripes(C.orange, C.cream, (0, 1, 1), 0.2),
            roll=90,
            yaw=80,
        ),
    ]
    return ClosedFormScene(solids, bounds, "demo_object")


def demo_room() -> ClosedFormScene:
    """Return a living room of 4 x 3 x 2.5 m around the z axis with its floor at z = 0, to be seen from inside.

    Against its walls and on its floor are a table, a sofa, a shelf with books (at -x), and decoration.
    """
    bounds = SceneBounds((-2.05, -1.55, -0.05), (2.05, 1.55, 2.55), 0.05, 6.0)
    walls = Faces(
        (
            stripes(C.sky, C.cream, (0, 1, 0.25), 0.6),
            blotches(C.teal, C.sand, 0.9, 11),
            checker(C.cream, C.rose, (0.8, 0.8, 0.6)),
            stripes(C.leaf, C.cream, (1, 0, 0), 0.5),
            blotches(C.white, C.cream, 1.2, 12),
            checker(C.wood, C.oak, (0.9, 0.4, 9.0)),
        )
    )
    legs = [
        _solid(cylinder(0.035, 0.34), (x, y, 0.34), stripes(C.oak, C.sand, (0, 0, 1), 0.3, phase=x))
        for x in (0.65, 1.35)
        for y in (-0.85, -0.35)
    ]
    boards = [
        _solid(box((0.16, 0.6, 0.02)), (-1.84, -0.6, z), stripes(C.wood, C.oak, (0, 1, 0), 0.4))
        for z in (0.4, 0.85, 1.3)
    ]
    paints = [
        (C.red, C.cream),
        (C.teal, C.sand),
        (C.navy, C.sky),
        (C.orange, C.plum),
        (C.leaf, C.moss),
        (C.rose, C.cream),
        (C.blue, C.sand),
    ]
    talls = [0.13 + 0.015 * (3 * i % 5) for i in range(len(paints))]
    books = [
        _solid(
            box((0.12, 0.07, tall)),
            (-1.85, -1.05 + 0.14 * i, (0.4, 0.85, 1.3)[i % 3] + 0.02 + tall),
            stripes(*paint, (0, 0.3, 1), 0.22, phase=float(i)),
        )
        for i, (paint, tall) in enumerate(zip(paints, talls, strict=True))
    ]
    solids = [
        _solid(box((2.0, 1.5, 1.25)), (0, 0, 1.25), walls),
        _solid(cylinder(0.75, 0.012), (0.25, -0.1, 0.0), blotches(C.red, C.navy, 0.5, 13)),
        *legs,
        _solid(box((0.48, 0.36, 0.03)), (1.0, -0.6, 0.7), stripes(C.wood, C.sand, (0.2, 1, 0), 0.28)),
        _solid(ball(0.13), (1.2, -0.5, 0.86), checker(C.orange, C.cream, 0.2)),
        _solid(box((0.12, 0.09, 0.07)), (0.8, -0.7, 0.8), blotches(C.plum, C.sky, 0.2, 14), yaw=30),
        _solid(box((0.22, 0.22, 0.22)), (0.3, -0.75, 0.22), checker(C.blue, C.cream, 0.3), yaw=20),
        _solid(box((0.8, 0.36, 0.2)), (-0.7, 1.12, 0.2), blotches(C.blue, C.navy, 0.4, 15)),
        _solid(box((0.8, 0.1, 0.42)), (-0.7, 1.38, 0.42), blotches(C.blue, C.teal, 0.4, 16)),
        _solid(box((0.1, 0.38, 0.3)), (-1.5, 1.1, 0.3), blotches(C.blue, C.navy, 0.35, 17)),
        _solid(box((0.1, 0.38, 0.3)), (0.1, 1.1, 0.3), blotches(C.blue, C.plum, 0.35, 18)),
        _solid(box((0.19, 0.07, 0.19)), (-1.15, 1.15, 0.58), checker(C.sand, C.red, 0.22), roll=-20, yaw=12),
        _solid(
            box((0.19, 0.07, 0.19)),
            (-0.3, 1.15, 0.58),
            stripes(C.rose, C.cream, (1, 0, 1), 0.16),
            roll=-20,
            yaw=-15,
        ),
        *boards,
        *books,
        _solid(ball(0.12), (-1.84, -0.25, 1.44), checker(C.sky, C.leaf, 0.2)),
        _solid(box((0.02, 0.45, 0.35)), (1.99, 0.35, 1.5), blotches(C.sky, C.white, 0.45, 19)),
        _solid(box((0.01, 0.51, 0.41)), (1.99, 0.35, 1.5), stripes(C.oak, C.wood, (0, 1, 1), 0.4)),
        _solid(box((0.4, 0.02, 0.28)), (-0.6, 1.49, 1.55), blotches(C.orange, C.plum, 0.35, 20)),
        _solid(box((0.22, 0.02, 0.3)), (0.55, 1.49, 1.45), checker(C.navy, C.sand, 0.3)),
        _solid(box((0.3, 0.02, 0.3)), (-0.7, -1.49, 1.5), blotches(C.red, C.cream, 0.3, 21), pitch=45),
        _solid(box((0.5, 0.02, 0.25)), (0.9, -1.49, 1.6), stripes(C.teal, C.navy, (1, 0, 2), 0.3)),
        _solid(cylinder(0.16, 0.17), (1.65, 1.1, 0.17), stripes(C.orange, C.red, (1, 1, 1), 0.25)),
        _solid(ball(0.3), (1.62, 1.1, 0.62), blotches(C.moss, C.leaf, 0.22, 22)),
        _solid(ball(0.2), (1.5, 0.95, 0.95), blotches(C.leaf, C.moss, 0.2, 23)),
        _solid(cylinder(0.02, 0.75), (0.75, 1.25, 0.75), stripes(C.slate, C.cream, (0, 0, 1), 0.3)),
        _solid(cylinder(0.2, 0.16), (0.75, 1.25, 1.55), stripes(C.sand, C.cream, (1, 0, 1), 0.2)),
        _solid(ball(0.17), (0.2, 0.3, 2.2), checker(C.cream, C.orange, 0.24)),
    ]
    return ClosedFormScene(solids, bounds, "demo_room", light=(0.45, -0.3, 0.85), contrast=0.4)


def _solid(
    shape: Shape, position: Sequence[float], texture: Texture, yaw: float = 0, pitch: float = 0, roll: float = 0
) -> Primitive:
    """Return a shape rotated about x (roll), then y (pitch), then z (yaw), in degrees, and moved to ``position`` (metres)."""
    rotation = torch.eye(3, dtype=torch.float64)
    for axis, angle in enumerate((roll, pitch, yaw)):
        turn = torch.zeros(6, dtype=torch.float64)
        turn[3 + axis] = math.radians(angle)
        rotation = SE3.exp(turn).rotation @ rotation
    return Primitive(shape, SE3(rotation, torch.tensor(position, dtype=torch.float64)), texture)
