"""Conversion of landmarks to named tensors, for storage, and back."""

from __future__ import annotations

import math
from dataclasses import astuple
from typing import Any

import torch
from torch import Tensor

from bidnerf_core.fields.contract import LARGEST_LENGTH
from bidnerf_core.mapping.landmarks.landmark_map import PER_LANDMARK, HeldOutTrial, LandmarkMap
from bidnerf_core.mapping.tensors import check_kinds, check_range, check_unit_length

LANDMARK_KINDS = {
    "positions": ((-1, 3), torch.float32),
    "deviations": ((-1, 2), torch.float32),
    "descriptors": ((-1, -1), torch.uint8),
    "directions": ((-1, 3), torch.float32),
    "cones": ((-1,), torch.float32),
    "sizes": ((-1,), torch.float32),
    "views": ((-1,), torch.int32),
    "noise": ((), torch.float64),
    "pose_covariance": ((6, 6), torch.float64),
}
"""Shape (-1: any length) and dtype of each tensor."""
LATER_KINDS = {
    "correlation": ((), torch.float64),
    "usual_matches": ((), torch.float64),
    "calibration_scatter": ((4,), torch.float64),
    "trial": ((4,), torch.float64),  # the fields of ``HeldOutTrial`` in order
    "moving": ((), torch.float64),
}
"""Shape and dtype of the tensors that maps of earlier versions lack."""


def landmark_tensors(landmarks: LandmarkMap) -> dict[str, Tensor]:
    """Return copies of the tensors of ``landmarks``, by name and in the dtypes of ``LANDMARK_KINDS``."""
    values = {name: getattr(landmarks, name) for name in LANDMARK_KINDS | LATER_KINDS}
    values["trial"] = astuple(landmarks.trial)
    found = {
        name: torch.as_tensor(values[name], dtype=kind)
        for name, (_, kind) in (LANDMARK_KINDS | LATER_KINDS).items()
    }
    return {name: value.contiguous().clone() for name, value in found.items()}


def landmarks_from_tensors(tensors: dict[str, Tensor]) -> LandmarkMap:
    """Return the landmarks from the tensors that ``landmark_tensors`` returned.

    Raises ``KeyError`` for a missing tensor, ``ValueError`` for one of a wrong shape, dtype or content.
    """
    present = LANDMARK_KINDS | {name: kind for name, kind in LATER_KINDS.items() if name in tensors}
    check_kinds(tensors, present)
    _check_contents(tensors)
    parts: dict[str, Any] = {name: tensors[name] for name in present}
    for name in {"noise", "correlation", "usual_matches", "moving"} & present.keys():
        parts[name] = float(tensors[name])
    if "trial" in parts:
        images, found, translation, rotation_deg = parts["trial"].tolist()
        parts["trial"] = HeldOutTrial(int(images), int(found), translation, rotation_deg)
    return LandmarkMap(**parts)


def _check_contents(tensors: dict[str, Tensor]) -> None:
    count = len(tensors["positions"])
    for name in PER_LANDMARK:
        if len(tensors[name]) != count:
            raise ValueError(f"{name} has {len(tensors[name])} landmarks, positions has {count}")
    if not tensors["descriptors"].shape[1]:
        raise ValueError("descriptors have no channels")
    if not float(tensors["noise"]) > 0:
        raise ValueError(f"noise is {float(tensors['noise'])}, expected a positive number of pixels")
    if "correlation" in tensors and not float(tensors["correlation"]) > 0:
        raise ValueError(f"correlation is {float(tensors['correlation'])}, expected a positive number")
    if "usual_matches" in tensors and not float(tensors["usual_matches"]) >= 0:
        raise ValueError(f"usual_matches is {float(tensors['usual_matches'])}, expected 0 or more")
    if "moving" in tensors and not 0 <= float(tensors["moving"]) <= 1:
        raise ValueError(f"moving is {float(tensors['moving'])}, expected a share of the images")
    if "calibration_scatter" in tensors and not bool((tensors["calibration_scatter"] > 0).all()):
        raise ValueError(
            f"calibration_scatter is {tensors['calibration_scatter'].tolist()}, expected positive"
        )
    check_range(tensors, "positions", -LARGEST_LENGTH, LARGEST_LENGTH)
    check_range(tensors, "deviations", 0.0, LARGEST_LENGTH)
    check_range(tensors, "sizes", 0.0, LARGEST_LENGTH)
    check_range(tensors, "cones", 0.0, math.pi + 1e-6)
    check_range(tensors, "views", 1, 2**31)
    check_unit_length(tensors, "directions")
    covariance = tensors["pose_covariance"]
    if float((covariance - covariance.mT).abs().max()) > 0 or float(torch.linalg.eigvalsh(covariance)[0]) < 0:
        raise ValueError("pose_covariance is not symmetric and positive semidefinite")
