"""Faults of the whole image: it is mirrored, upside down or covered."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Generator

from bidnerf_core.camera.orientation import Orientation
from bidnerf_core.frames.frame import Frame


def mirrored(frame: Frame, on: float, generator: Generator) -> Frame:
    """Swap left and right of colour and depth; the result is not a view of the scene from anywhere."""
    return _turned(frame, Orientation(mirrors_columns=True)) if on else frame


def flipped(frame: Frame, on: float, generator: Generator) -> Frame:
    """Swap top and bottom of colour and depth; the result is not a view of the scene from anywhere."""
    return _turned(frame, Orientation(mirrors_rows=True)) if on else frame


def upside_down(frame: Frame, on: float, generator: Generator) -> Frame:
    """Turn the image by 180 degrees, as if the camera had been held upside down."""
    return _turned(frame, Orientation(mirrors_columns=True, mirrors_rows=True)) if on else frame


def covered_lens(frame: Frame, on: float, generator: Generator) -> Frame:
    """Show one random colour everywhere, without any measured depth."""
    if not on:
        return frame
    colour = torch.rand(3, generator=generator).to(frame.rgb)
    depth = None if frame.depth is None else torch.zeros_like(frame.depth)
    alpha = None if frame.alpha is None else torch.ones_like(frame.alpha)
    return replace(frame, rgb=colour.expand_as(frame.rgb).clone(), depth=depth, alpha=alpha)


def _turned(frame: Frame, orientation: Orientation) -> Frame:
    return replace(
        frame,
        rgb=orientation.upright(frame.rgb),
        depth=None if frame.depth is None else orientation.upright(frame.depth),
        alpha=None if frame.alpha is None else orientation.upright(frame.alpha),
        intrinsics=frame.intrinsics.upright(orientation),
    )
