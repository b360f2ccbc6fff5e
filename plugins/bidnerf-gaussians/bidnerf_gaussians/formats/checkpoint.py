"""Checkpoints of gsplat's examples and of nerfstudio's splatfacto, read without running code in them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from bidnerf_core.errors import InputError
from bidnerf_core.io import read_saved
from bidnerf_gaussians.gaussians import Gaussians

EXPECTED = "a checkpoint of gsplat or splatfacto"
ENDINGS = (".pt", ".ckpt", ".pth")
NAMES = {
    "means": "means",
    "scales": "log_scales",
    "quats": "quaternions",
    "opacities": "logits",
    "sh0": "sh0",
    "shN": "shN",
    "features_dc": "sh0",
    "features_rest": "shN",
}
"""The names used here for the parameters of both."""
PREFIX = "_model.gauss_params."
"""Prefix of the names of splatfacto's parameters."""


def recognises(path: Path) -> bool:
    """Return whether the file was written by ``torch.save`` and contains names of Gaussian parameters."""
    if path.suffix.lower() not in ENDINGS or not path.is_file():
        return False
    try:
        return {"means", "log_scales"} <= set(_parameters(read_saved(path, EXPECTED, mapped=True)))
    except InputError:
        return False


def read(path: Path) -> Gaussians:
    """Read the Gaussians of a checkpoint. Raises ``InputError`` if it would run code, or contains something else."""
    found = _parameters(read_saved(path, EXPECTED))
    missing = [name for name in ("means", "log_scales", "quaternions", "logits", "sh0") if name not in found]
    if missing:
        raise InputError(f"has no {', '.join(missing)}", where=path, expected=EXPECTED)
    try:
        parts = {name: value.float() for name, value in found.items()}
        count = len(parts["means"])
        sh0 = parts["sh0"].reshape(count, 1, 3)
        harmonics = torch.cat([sh0, parts["shN"].reshape(count, -1, 3)], dim=1) if "shN" in parts else sh0
        return Gaussians(
            parts["means"].reshape(count, 3),
            parts["log_scales"].reshape(count, 3),
            parts["quaternions"].reshape(count, 4),
            parts["logits"].reshape(count),
            harmonics,
        )
    except (RuntimeError, TypeError) as error:
        raise InputError(f"tensors with different counts ({error})", where=path, expected=EXPECTED) from error


def _parameters(saved: Any) -> dict[str, Tensor]:
    tensors = _inside(saved)
    return {ours: tensors[theirs] for theirs, ours in NAMES.items() if isinstance(tensors.get(theirs), Tensor)}


def _inside(found: Any) -> dict[str, Any]:
    """Return the parameters by name: gsplat stores them under "splats", splatfacto under "pipeline" with a prefix."""
    for key in ("splats", "pipeline"):
        if isinstance(found, dict) and isinstance(found.get(key), dict):
            found = found[key]
    if not isinstance(found, dict):
        return {}
    return {str(name).removeprefix(PREFIX): value for name, value in found.items()}
