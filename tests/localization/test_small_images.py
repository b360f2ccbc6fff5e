"""Small images that are compared with renderings."""

from __future__ import annotations

import torch

from bidnerf import SE3, Frame, View

# Inside: thumbnails are compared with thumbnails
from bidnerf_core.localization.terms.images import Thumbnail
from landmark_scene import PINHOLE


def test_the_thumbnail_of_a_mirror_image_is_the_mirrored_thumbnail(generator: torch.Generator) -> None:
    rgb = torch.rand(300, 400, 3, generator=generator)
    views = [View(Frame("a", image.contiguous(), PINHOLE), SE3.identity()) for image in (rgb, rgb.flip(1))]
    here, there = (Thumbnail.of(view, 32) for view in views)
    torch.testing.assert_close(here.mirrored.rgb, there.rgb)
    torch.testing.assert_close(here.mirrored.slopes, there.slopes)
    torch.testing.assert_close(here.mirrored.flat, there.flat)
