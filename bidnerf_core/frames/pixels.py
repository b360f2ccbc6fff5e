"""Selection of pixels, and their conversion to measured rays.

A ``PixelDrawer`` picks pixels of a frame; ``observe`` turns them into rays in the view's reference frame with
the colour and distance measured there. This is the only place where planar depth becomes distance along the
ray.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Literal, Protocol, runtime_checkable
from weakref import WeakKeyDictionary

import torch
from jaxtyping import Bool, Float, Int
from kornia.color import rgb_to_grayscale
from kornia.feature import gftt_response
from kornia.geometry.subpix import nms2d
from kornia.morphology import dilation
from scipy.ndimage import distance_transform_edt
from torch import Generator, Tensor

from bidnerf_core.camera import exposure_times, poses_of_rows
from bidnerf_core.fields import Observations
from bidnerf_core.frames.colours import colours_at
from bidnerf_core.frames.frame import Frame, View


@runtime_checkable
class PixelDrawer(Protocol):
    """Draws ``count`` pixels (column, row) of a frame; they are on the device of ``generator``."""

    def __call__(self, frame: Frame, count: int, generator: Generator) -> Int[Tensor, "n 2"]: ...


def uniform(frame: Frame, count: int, generator: Generator) -> Int[Tensor, "n 2"]:
    """Draw uniformly among the pixels that are not hidden, with replacement."""
    if frame.hidden is not None:
        return among_visible(frame, count, generator)
    size, where = frame.intrinsics, generator.device
    columns = torch.randint(size.width, (count,), generator=generator, device=where)
    rows = torch.randint(size.height, (count,), generator=generator, device=where)
    return torch.stack([columns, rows], dim=-1)


def all_pixels(frame: Frame) -> Int[Tensor, "n 2"]:
    """Return all pixels (column, row) of a frame, row by row: their centres at +0.5, truncated."""
    return frame.intrinsics.pixel_centres().long().reshape(-1, 2)


def observe(
    view: View,
    pixels: Int[Tensor, "n 2"],
    dtype: torch.dtype = torch.float32,
    device: torch.device | str | None = None,
) -> Observations:
    """Return the measurements of ``view`` at ``pixels``, as half-lines in its reference frame.

    They are on ``device``, by default that of the image. Nothing is copied if the image, the pose and ``pixels`` are there.
    """
    frame = view.frame
    columns, rows = pixels.to(frame.held_rgb.device).unbind(-1)
    ray, length = frame.intrinsics.rays(pixels.double() + 0.5)
    depth = torch.zeros_like(length)
    if frame.depth is not None:
        depth = frame.depth[rows.to(frame.depth.device), columns.to(frame.depth.device)].to(length)
    T = view.T_ref_camera.to(length)
    if view.motion is not None and bool(view.motion.any()):
        T = T @ poses_of_rows(exposure_times(pixels.to(ray) + 0.5, frame.intrinsics), view.motion)
    directions = T.rotate(ray)
    origins = T.translation.expand_as(directions)
    there = frame.held_rgb.device if device is None else device
    coloured = torch.full((len(length),), frame.has_colour, device=length.device)
    rgb = colours_at(frame.held_rgb, rows, columns)
    return Observations(origins, directions, rgb, depth * length, coloured).to(there, dtype)


def draw(
    views: Sequence[View],
    count: int,
    drawer: PixelDrawer,
    generator: Generator,
    dtype: torch.dtype = torch.float32,
    device: torch.device | str | None = None,
) -> Observations:
    """Draw ``count`` pixels, the same number from each view; every tensor has leading axes (views, pixels per view).

    Images may be on any device; the result is on ``device``, by default that of the images.
    """
    share = max(1, count // len(views))
    parts = [observe(view, drawer(view.frame, share, generator), dtype, device) for view in views]
    return Observations.stacked(parts)


MOST_FOR_MIDDLE = 200_000
"""Number of a view's measured points above which only some of them are used for the median."""


def measured_middle(views: Sequence[View]) -> Float[Tensor, "3"] | None:
    """Return the component-wise median of the measured points, in the views' reference frame; None if there are none.

    Every fourth pixel is used, and fewer in an image with millions of them.
    """
    points = []
    for view in views:
        if view.frame.depth is None:
            continue
        number = (view.frame.depth.flatten()[::4] > 0).nonzero()[:, 0]
        number = 4 * number[:: max(1, len(number) // MOST_FOR_MIDDLE)]
        width = view.frame.intrinsics.width
        places = torch.stack([number % width, number // width], dim=-1)
        pixels = observe(view, places, torch.float64, "cpu")
        points.append(pixels.points[pixels.measured])
    together = torch.cat(points) if points else torch.zeros((0, 3))
    return together.median(0).values if len(together) else None


DrawerName = Literal["uniform", "interest-points", "interest-regions"]
QUALITY = 0.01
"""Minimum corner response of an interest point, relative to the strongest response in the image."""
FAINTEST = 1e-5
"""Minimum corner response of an interest point in any image. A blank wall with noise of 1/255 stays below it."""
BORDER = 3
"""Width, in pixels, of the margin that the corner detector needs; smaller images have no corners."""
REACH, ROUNDS = 5, 3
"""Interest regions are interest points dilated ROUNDS times with a square of REACH by REACH pixels."""


def interest_points(frame: Frame) -> Int[Tensor, "n 2"]:
    """Return corners (column, row) by Shi and Tomasi 1994, "Good features to track"; possibly none."""
    if min(frame.held_rgb.shape[:2]) <= BORDER:
        return torch.zeros((0, 2), dtype=torch.long)
    grey = rgb_to_grayscale(frame.rgb.detach().float().cpu().permute(2, 0, 1)[None])
    response = nms2d(gftt_response(grey), (5, 5))[0, 0]
    strong = response > max(QUALITY * float(response.max()), FAINTEST)
    return strong.nonzero().flip(-1)


def interest_regions(frame: Frame) -> Int[Tensor, "n 2"]:
    """Return the interest points of a frame and the pixels around them, row by row."""
    columns, rows = interest_points(frame).unbind(-1)
    mask = torch.zeros((1, 1, *frame.held_rgb.shape[:2]))
    mask[0, 0, rows, columns] = 1
    for _ in range(ROUNDS):
        mask = dilation(mask, torch.ones(REACH, REACH))
    return (mask[0, 0] > 0).nonzero().flip(-1)


class Among:
    """Draws uniformly among the pixels that ``choose`` finds in a frame, with replacement.

    Each frame is searched once. If nothing is found, as in the image of a blank wall, pixels are drawn
    uniformly: they still carry depth, and evidence of where there are no edges.
    """

    def __init__(self, choose: Callable[[Frame], Tensor]) -> None:
        self._choose = choose
        self._found: WeakKeyDictionary[Frame, Tensor] = WeakKeyDictionary()

    def __call__(self, frame: Frame, count: int, generator: Generator) -> Int[Tensor, "n 2"]:
        if frame not in self._found:
            self._found[frame] = _seen(self._choose(frame), frame).to(generator.device)
        found = self._found[frame]
        if len(found) == 0:
            return uniform(frame, count, generator)
        return found[torch.randint(len(found), (count,), generator=generator, device=found.device)]


among_visible = Among(all_pixels)
"""Draws among all pixels that are not hidden."""


def visible_at(frame: Frame, pixels: Float[Tensor, "n 2"]) -> Bool[Tensor, "n"]:
    """Return which of ``pixels`` (u, v) inside the image are not hidden."""
    if frame.hidden is None:
        return torch.ones(len(pixels), dtype=torch.bool, device=pixels.device)
    columns, rows = pixels.to(frame.hidden.device).long().unbind(-1)
    height, width = frame.hidden.shape
    return ~frame.hidden[rows.clamp(0, height - 1), columns.clamp(0, width - 1)].to(pixels.device)


def continued(frame: Frame) -> Float[Tensor, "h w 3"]:
    """Return the colours of a frame with hidden pixels filled in from the nearest visible ones."""
    if frame.hidden is None:
        return frame.rgb
    _, (rows, columns) = distance_transform_edt(frame.hidden.cpu().numpy(), return_indices=True)
    nearest = (torch.from_numpy(index).long().to(frame.rgb.device) for index in (rows, columns))
    return frame.rgb[tuple(nearest)]


def _seen(pixels: Int[Tensor, "n 2"], frame: Frame) -> Int[Tensor, "k 2"]:
    """Return the pixels that are not hidden."""
    return pixels if frame.hidden is None else pixels[visible_at(frame, pixels)]


def drawer(name: DrawerName) -> PixelDrawer:
    """Return a pixel drawer by name; it caches the interest points of each frame."""
    if name == "uniform":
        return uniform
    return Among(interest_points if name == "interest-points" else interest_regions)
