"""Visual vocabularies, and the VLAD vectors into which they pool the descriptors of an image.

For each word of a vocabulary, a VLAD vector (Jegou et al. 2010, "Aggregating local descriptors into a compact image
representation") sums the residuals of the descriptors nearest to it, so an image becomes one vector whatever its number of
keypoints. Maps store landmarks instead of images: the landmarks visible to each of a map's cameras represent its image.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor
from torch.nn.functional import normalize

from bidnerf_core.camera import Intrinsics
from bidnerf_core.geometry import SE3
from bidnerf_core.mapping.landmarks.descriptors import k_means, nearest_centre
from bidnerf_core.mapping.landmarks.landmark_map import LandmarkMap


@dataclass(frozen=True, eq=False)
class Vocabulary:
    """Visual words, by which the descriptors of an image are pooled."""

    words: Float[Tensor, "w d"]

    @staticmethod
    def of(descriptors: Sequence[UInt8[Tensor, "n d"]], seed: int = 0) -> Vocabulary:
        """Build a vocabulary of at most 32 words from about 20,000 ``descriptors``, equally many from each map."""
        generator = torch.Generator().manual_seed(seed)
        share = -(-20_000 // len(descriptors))
        some = torch.cat([one[torch.randperm(len(one), generator=generator)[:share]] for one in descriptors])
        return Vocabulary(k_means(some, min(32, len(some)), generator))

    def pool(self, descriptors: UInt8[Tensor, "n d"], word: Tensor | None = None) -> Float[Tensor, "p"]:
        """Return the VLAD vector of descriptors, of unit length; ``word`` holds each descriptor's nearest word, if known."""
        word = nearest_centre(descriptors, self.words) if word is None else word
        sums = torch.zeros_like(self.words).index_add_(0, word, descriptors.float() - self.words[word])
        roots = sums.sign() * sums.abs().sqrt()  # so that repeated structures do not dominate
        return normalize(normalize(roots, dim=1).flatten(), dim=0)


def pool_views(
    vocabulary: Vocabulary, landmarks: LandmarkMap, cameras: Sequence[tuple[Intrinsics, SE3]]
) -> Float[Tensor, "v p"]:
    """Return the VLAD vectors of the landmarks visible to a map's cameras (T_world_camera), and of all landmarks last.

    At most 48 cameras, at regular intervals, are pooled, except those that see fewer than eight landmarks.
    """
    word = nearest_centre(landmarks.descriptors, vocabulary.words)
    shown = [visible(landmarks, *camera) for camera in cameras[:: max(1, math.ceil(len(cameras) / 48))]]
    vectors = [vocabulary.pool(landmarks.descriptors[seen], word[seen]) for seen in shown if len(seen) >= 8]
    return torch.stack([*vectors, vocabulary.pool(landmarks.descriptors, word)])


def visible(landmarks: LandmarkMap, camera: Intrinsics, T_world_camera: SE3) -> Int[Tensor, "m"]:
    """Return the numbers of the landmarks visible to a camera, ignoring occlusion.

    Landmarks count as visible up to 10 degrees beyond their cones of viewing directions.
    """
    slopes = torch.tensor([camera.width / 2 / camera.fx, camera.height / 2 / camera.fy])
    return landmarks.in_view(T_world_camera, slopes, math.radians(10))[0]
