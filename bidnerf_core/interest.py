"""Pixels where something is to be seen: interest points, and the regions around them (iNeRF, section 3.2)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal
from weakref import WeakKeyDictionary

import torch
from jaxtyping import Int
from kornia.color import rgb_to_grayscale
from kornia.feature import gftt_response
from kornia.geometry.subpix import nms2d
from kornia.morphology import dilation
from torch import Generator, Tensor

from bidnerf_core.frames import Frame
from bidnerf_core.pixels import PixelDrawer, uniform

DrawerName = Literal["uniform", "interest-points", "interest-regions"]
QUALITY = 0.01
"""Corner response, in parts of the image's strongest, from which a local maximum is an interest point."""
FAINTEST = 1e-5
"""The same, absolute: above what noise of a grey level (1/255) does to a blank wall."""
BORDER = 3
"""Pixels around each that the corner detector looks at; it does not take smaller images."""
REACH, ROUNDS = 5, 3
"""Regions are points dilated by squares of so many pixels, so many times."""


def interest_points(frame: Frame) -> Int[Tensor, "n 2"]:
    """Corners (column, row) after Shi and Tomasi 1994, "Good features to track"; none where nothing stands out."""
    if min(frame.rgb.shape[:2]) <= BORDER:
        return torch.zeros((0, 2), dtype=torch.long)
    grey = rgb_to_grayscale(frame.rgb.detach().float().cpu().permute(2, 0, 1)[None])
    response = nms2d(gftt_response(grey), (5, 5))[0, 0]
    strong = response > max(QUALITY * float(response.max()), FAINTEST)
    return strong.nonzero().flip(-1)


def interest_regions(frame: Frame) -> Int[Tensor, "n 2"]:
    """Interest points and their surroundings, row by row."""
    columns, rows = interest_points(frame).unbind(-1)
    mask = torch.zeros((1, 1, *frame.rgb.shape[:2]))
    mask[0, 0, rows, columns] = 1
    for _ in range(ROUNDS):
        mask = dilation(mask, torch.ones(REACH, REACH))
    return (mask[0, 0] > 0).nonzero().flip(-1)


class Among:
    """Draws among the pixels that ``choose`` finds in a frame, each as likely as any other, with replacement.

    A frame is searched once. In one where nothing is found, such as the image of a blank wall, pixels are drawn
    uniformly: it still tells of depth, and of where the edges are not.
    """

    def __init__(self, choose: Callable[[Frame], Tensor]) -> None:
        self._choose = choose
        self._found: WeakKeyDictionary[Frame, Tensor] = WeakKeyDictionary()

    def __call__(self, frame: Frame, count: int, generator: Generator) -> Int[Tensor, "n 2"]:
        if frame not in self._found:
            self._found[frame] = self._choose(frame)
        found = self._found[frame]
        if len(found) == 0:
            return uniform(frame, count, generator)
        return found[torch.randint(len(found), (count,), generator=generator)]


def drawer(name: DrawerName) -> PixelDrawer:
    """A pixel drawer by name, which remembers what it finds in a frame."""
    if name == "uniform":
        return uniform
    return Among(interest_points if name == "interest-points" else interest_regions)
