"""Scene faults: occluding objects, and objects that moved, appeared or vanished since the scene was mapped."""

from __future__ import annotations

import math
from dataclasses import replace

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.ndimage import binary_dilation
from torch import Generator, Tensor

from bidnerf_core.evaluation.faults.camera import reflected, warped
from bidnerf_core.evaluation.faults.fault import depth_of, random_direction, random_pixel, uniform_number
from bidnerf_core.frames import Frame

RIM = 3
"""Width, in pixels, of the surroundings from which a hole is filled."""


def occluder(frame: Frame, share: float, generator: Generator) -> Frame:
    """Put a textured object in front of ``share`` of the image.

    If the frame has depth, the object's depth is measured.
    """
    mask, colours = _textured_blob(frame, share, generator)
    if frame.depth is None or not frame.has_depth:
        return _pasted(frame, mask, colours, frame.depth)
    # The object is nearer than the nearest part of the scene, the second percentile of its depth, with a relief of 5 %.
    near = float(np.quantile(frame.depth[frame.depth > 0].numpy(), 0.02))
    relief = 1 + 0.05 * _bounded_noise(frame, 3, generator)
    return _pasted(frame, mask, colours, uniform_number(generator, 0.4, 0.8) * near * relief)


def unmeasured_occluder(frame: Frame, share: float, generator: Generator) -> Frame:
    """Put a textured object in front of ``share`` of the image, too near for its depth to be measured."""
    mask, colours = _textured_blob(frame, share, generator)
    depth = None if frame.depth is None else torch.zeros_like(frame.depth)
    return _pasted(frame, mask, colours, depth)


def moved_thing(frame: Frame, share: float, generator: Generator) -> Frame:
    """Copy a piece of the scene, slightly nearer, to another position, where it covers ``share`` of the image.

    The features of the copy match those of the map, and consistently support a wrong pose.
    """
    height, width = frame.rgb.shape[:2]
    mask = blob(height, width, share, generator)
    # The piece moves by a fraction of the image's shorter side, and comes slightly nearer.
    travel = uniform_number(generator, 0.15, 0.3) * min(height, width)
    move = torch.tensor(random_direction(generator)) * travel
    elsewhere = warped(frame, reflected(frame.intrinsics.pixel_centres() - move, width, height))
    depth = None if elsewhere.depth is None else elsewhere.depth * uniform_number(generator, 0.85, 0.98)
    return _pasted(frame, mask, elsewhere.rgb, depth, elsewhere.alpha)


def added_thing(frame: Frame, share: float, generator: Generator) -> Frame:
    """Put a textured object on ``share`` of the measured surface, from which it protrudes slightly."""
    mask = _surface_piece(frame, share, generator)
    # The height above the surface, towards the camera, is relative to the depth.
    rise = uniform_number(generator, 0.02, 0.1) * (1 + 0.4 * _bounded_noise(frame, 6, generator))
    colours = texture(frame.intrinsics.height, frame.intrinsics.width, generator)
    return _pasted(frame, mask, colours, depth_of(frame) * (1 - rise))


def vanished_thing(frame: Frame, share: float, generator: Generator) -> Frame:
    """Remove ``share`` of the measured surface in one piece, and show the background or the surroundings in its place.

    If the frame has alpha and the piece reaches the edge of the scene, the background is visible; otherwise
    the surrounding colours are continued, at the depth of the farthest surrounding surface.
    """
    mask = _surface_piece(frame, share, generator)
    rim = torch.from_numpy(binary_dilation(mask.numpy(), iterations=RIM)) & ~mask
    if not mask.any() or not rim.any():
        return frame
    depth = depth_of(frame)
    empty = None if frame.alpha is None else rim & (frame.alpha < 0.5)
    if empty is not None and empty.any():
        background = frame.rgb[empty].median(dim=0).values.expand_as(frame.rgb)
        return _pasted(frame, mask, background, torch.zeros_like(depth), torch.zeros_like(depth))
    # The surrounding colours are continued (Telea 2004).
    colours = (frame.rgb * 255).round().to(torch.uint8).contiguous().numpy()
    filled = cv2.inpaint(colours, mask.to(torch.uint8).numpy(), RIM, cv2.INPAINT_TELEA)
    return _pasted(
        frame, mask, torch.from_numpy(filled).to(frame.rgb) / 255, depth[rim].max().expand_as(depth)
    )


def _textured_blob(
    frame: Frame, share: float, generator: Generator
) -> tuple[Bool[Tensor, "h w"], Float[Tensor, "h w 3"]]:
    height, width = frame.rgb.shape[:2]
    return blob(height, width, share, generator), texture(height, width, generator)


def _surface_piece(frame: Frame, share: float, generator: Generator) -> Bool[Tensor, "h w"]:
    """Mark ``share`` of the measured pixels: those whose points are nearest to a randomly chosen one."""
    depth = depth_of(frame)
    points = frame.intrinsics.unproject(frame.intrinsics.pixel_centres()) * depth[..., None]
    row, column = random_pixel(depth > 0, generator)
    distance = (points - points[row, column]).norm(dim=-1)
    order = distance.masked_fill(depth <= 0, torch.inf).flatten().argsort()
    mask = torch.zeros(depth.numel(), dtype=torch.bool)
    mask[order[: round(share * int((depth > 0).sum()))]] = True
    return mask.reshape(depth.shape)


def _bounded_noise(frame: Frame, cells: int, generator: Generator) -> Float[Tensor, "h w"]:
    camera = frame.intrinsics
    return smooth_noise(camera.height, camera.width, cells, cells, generator).clamp(-2, 2)


def _pasted(
    frame: Frame,
    mask: Bool[Tensor, "h w"],
    rgb: Float[Tensor, "h w 3"],
    depth: Float[Tensor, "h w"] | None,
    alpha: Float[Tensor, "h w"] | None = None,
) -> Frame:
    """Return the frame with new colours, depth and alpha (1 by default) inside ``mask``."""
    pasted = replace(frame, rgb=torch.where(mask[..., None], rgb, frame.rgb))
    if frame.depth is not None and depth is not None:
        pasted = pasted.replace(depth=torch.where(mask, depth.to(frame.depth), frame.depth))
    if frame.alpha is not None:
        cover = torch.ones_like(frame.alpha) if alpha is None else alpha
        pasted = pasted.replace(alpha=torch.where(mask, cover, frame.alpha))
    return pasted


def blob(height: int, width: int, share: float, generator: Generator) -> Bool[Tensor, "h w"]:
    """Return a mask of one irregular piece around a random position that covers exactly ``share`` of the image.

    With the same generator state, a larger share covers everything that a smaller one does.
    """
    centre = uniform_number(generator, 0.2, 0.8) * width, uniform_number(generator, 0.2, 0.8) * height
    down = torch.arange(height, dtype=torch.float32)[:, None] + 0.5 - centre[1]
    across = torch.arange(width, dtype=torch.float32)[None, :] + 0.5 - centre[0]
    # The logarithm of the outline's radius is a sum of waves around the centre. Every point of the outline is visible from
    # there, so that the blob is one piece.
    angle = torch.atan2(down, across)
    waves = [
        uniform_number(generator, -0.35, 0.35)
        * torch.cos(n * angle + uniform_number(generator, 0, 2 * math.pi))
        for n in range(2, 6)  # number of periods around the outline
    ]
    distance = torch.hypot(down, across) / torch.stack(waves).sum(0).exp()
    covered = round(share * height * width)
    mask = torch.zeros(height * width, dtype=torch.bool)
    mask[distance.flatten().argsort()[:covered]] = True
    return mask.reshape(height, width)


def texture(height: int, width: int, generator: Generator) -> Float[Tensor, "h w 3"]:
    """Return random colours with detail at several scales and full contrast, with as many features as a photo."""
    longer = max(height, width)
    layers = []
    # From one octave of noise to the next, the number of cells along the longer side doubles.
    for octave in range(2, 8):
        rows, columns = (max(2, round(2**octave * side / longer)) for side in (height, width))
        layer = [smooth_noise(height, width, rows, columns, generator) for _ in range(3)]
        layers.append(torch.stack(layer, -1) * 2 ** (1 - octave / 2))
    noise = torch.stack(layers).sum(0)
    low, high = noise.flatten(0, 1).quantile(torch.tensor([0.02, 0.98]), dim=0)
    return ((noise - low) / (high - low).clamp_min(1e-6)).clamp(0, 1)


def smooth_noise(
    height: int, width: int, rows: int, columns: int, generator: Generator
) -> Float[Tensor, "h w"]:
    """Return normally distributed values on a grid of ``rows`` by ``columns``, interpolated with cubic splines."""
    values = torch.randn((1, 1, rows, columns), generator=generator)
    return torch.nn.functional.interpolate(values, (height, width), mode="bicubic", align_corners=False)[0, 0]
