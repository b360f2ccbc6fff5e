"""Renderings of a map, and the encoding of arrays and images as JSON values: base64 of little-endian numbers, and data URLs."""

from __future__ import annotations

import base64
import io
import math
from dataclasses import replace
from typing import Any, TypeAlias

import numpy as np
import torch
from jaxtyping import Float, UInt8
from PIL import Image
from torch import Tensor

from bidnerf.results import as_picture
from bidnerf_core.camera import Intrinsics
from bidnerf_core.fields import has_field, render_image
from bidnerf_core.geometry import SE3
from bidnerf_core.io import png_bytes
from bidnerf_core.localization import SceneMap, surface_renderer
from bidnerf_core.maps import picture_at

JsonObject: TypeAlias = dict[str, Any]
"""A part of the page's state, which the page's scripts read. Its entries are described by the function that returns it."""


def pack(array: np.ndarray) -> JsonObject:
    """Return an array of bytes, 16-bit integers or floats as its ``type``, its ``shape`` and its data in ``base64``."""
    kinds = {"i1": "int8", "u1": "uint8", "u2": "uint16", "f4": "float32", "f8": "float32"}
    kind = kinds[array.dtype.str[1:]]
    content = np.ascontiguousarray(array, dtype=np.dtype(kind).newbyteorder("<")).tobytes()
    return {"type": kind, "shape": array.shape, "base64": base64.b64encode(content).decode()}


def pack_points(points: Float[Tensor, "n 3"]) -> JsonObject:
    """Return points quantized to 16-bit integers, ``places``: a coordinate is ``lower + value / 65535 * size``."""
    values = points.detach().cpu().double().numpy()
    lower = values.min(0) if len(values) else np.zeros(3)
    size = max(float((values - lower).max(initial=0.0)), 1e-9)
    return {
        "lower": lower.tolist(),
        "size": size,
        "places": pack(((values - lower) / size * 65535 + 0.5).astype(np.uint16)),
    }


def pack_colours(rgb: Float[Tensor, "n 3"]) -> JsonObject:
    """Return colours in [0, 1], quantized to bytes."""
    return pack((rgb.detach().cpu().float().clamp(0, 1).numpy() * 255 + 0.5).astype(np.uint8))


def jpeg(image: Float[Tensor, "h w 3"] | UInt8[np.ndarray, "h w 3"]) -> bytes:
    """Return an image as the bytes of a JPEG file."""
    file = io.BytesIO()
    Image.fromarray(as_picture(image)).save(file, "JPEG", quality=85)
    return file.getvalue()


def jpeg_json(image: Float[Tensor, "h w 3"]) -> JsonObject:
    """Return an image as the data ``url`` of a JPEG, with its ``width`` and ``height`` in pixels."""
    return {
        "url": "data:image/jpeg;base64," + base64.b64encode(jpeg(image)).decode(),
        "width": int(image.shape[1]),
        "height": int(image.shape[0]),
    }


def png_json(image: UInt8[np.ndarray, "h w channels"]) -> JsonObject:
    """Return an image, with or without an alpha channel, in the format of ``jpeg_json`` but encoded as PNG."""
    return {
        "url": "data:image/png;base64," + base64.b64encode(png_bytes(image)).decode(),
        "width": image.shape[1],
        "height": image.shape[0],
    }


def field_image(scene: SceneMap, camera: Intrinsics, T_world_camera: SE3) -> Float[Tensor, "h w 3"]:
    """Render the colours of the field, in [0, 1], from a camera that may be nearer or farther away than those of the images.

    If the map has no field, its landmarks are drawn as dots.
    """
    bounds = scene.bounds
    position = T_world_camera.translation.detach().cpu().double()
    if scene.surface is not None and len(scene.surface.surfels):
        away = (scene.surface.surfels.positions.cpu().double() - position).norm(dim=-1).min()
        bounds = replace(bounds, near=min(bounds.near, float(away) / 2))  # to show the nearest surface
    distance = float((position - torch.tensor(bounds.centre, dtype=torch.float64)).norm())
    # There is no matter farther from the centre than this.
    beyond = bounds.far if bounds.contracted else math.hypot(*bounds.size) / 2
    bounds = replace(bounds, far=max(bounds.far, distance + beyond))
    if not has_field(scene.field):
        return picture_at(scene, camera, T_world_camera)
    # After every 4,096 pixels, the rendering stops if the job was cancelled, see ``job_context``.
    return render_image(scene.field, camera, T_world_camera, bounds, 4096).rgb


@torch.no_grad()
def quick_image(scene: SceneMap, camera: Intrinsics, T_world_camera: SE3) -> Float[Tensor, "h w 3"]:
    """Render the colours of the surface, in [0, 1], from a camera, about twenty times as fast as ``field_image``.

    If the map has no surface, the field is rendered.
    """
    if scene.surface is None:
        return field_image(scene, camera, T_world_camera)
    surface = scene.surface
    rays, _ = camera.rays(camera.pixel_centres().reshape(-1, 2))
    T = T_world_camera.to(dtype=torch.float32, device=surface.device)
    directions = T.rotate(rays.to(surface.device))
    origins = T.translation.expand_as(directions).contiguous()
    rgb, _, _ = surface_renderer(surface, scene.bounds.background)(origins, directions)
    return rgb.cpu().clamp(0, 1).reshape(camera.height, camera.width, 3)
