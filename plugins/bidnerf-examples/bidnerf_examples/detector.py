"""A detector: OpenCV's ORB, whose 256 bits become as many channels, so that Euclidean distance counts differing bits."""

from __future__ import annotations

import cv2
import numpy as np
import torch
from torch import Tensor

from bidnerf_core.mapping import FIRST_CENTRE, Keypoints, grey_image

BITS = 256
STEP = 32
"""Value of a set bit: squared distances are then of the same order as those of SIFT."""


def detector(rgb: Tensor) -> Keypoints:
    """ORB (Rublee et al. 2011) from OpenCV, with one channel for each of its 256 bits."""
    orb = cv2.ORB.create(nfeatures=2000, edgeThreshold=12, patchSize=24, fastThreshold=5)
    found, descriptors = orb.detectAndCompute(grey_image(rgb), None)
    if descriptors is None or not len(found):
        return Keypoints(torch.zeros(0, 2), torch.zeros(0), torch.zeros((0, BITS), dtype=torch.uint8))
    order = np.argsort([-keypoint.response for keypoint in found], kind="stable")
    pixels = (np.asarray(cv2.KeyPoint.convert(found), dtype=np.float32) + FIRST_CENTRE)[order]
    sizes = np.array([found[i].size for i in order], dtype=np.float32)
    bits = STEP * np.unpackbits(np.asarray(descriptors, dtype=np.uint8)[order], axis=1)
    return Keypoints(torch.from_numpy(pixels), torch.from_numpy(sizes), torch.from_numpy(bits))
