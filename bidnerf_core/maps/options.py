"""The options with which maps are trained and imported: one set for commands and Python."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import get_args

import torch

from bidnerf_core.captures import RefinementChoice
from bidnerf_core.datasets import DatasetOptions, SparseChoice
from bidnerf_core.errors import InputError
from bidnerf_core.geometry import SE3
from bidnerf_core.mapping import USUAL_FEATURES, find_features


@dataclass(frozen=True)
class MapOptions:
    """What training and importing have in common: which images are used, and where the map goes."""

    images: DatasetOptions = DatasetOptions()
    """how the images are read: split, camera, size and so on"""

    features: str = USUAL_FEATURES
    """name of the detector of the landmarks"""

    device: torch.device | str = "cpu"
    """device of the training and of the map that is returned"""

    overwrite: bool = False
    """whether a folder that is not empty is replaced"""

    def __post_init__(self) -> None:
        find_features(self.features)


@dataclass(frozen=True)
class TrainOptions(MapOptions):
    """How a map is trained, beside the settings of its backend."""

    refine_poses: RefinementChoice = "auto"
    """when the given poses are refined with the keypoints that images share: always, never, or auto (if the images contradict
    them)"""

    trust_poses: bool = False
    """whether poses that contradict most pairs of images are accepted"""

    depth_points: str | Path | None = None
    """folder of a COLMAP sparse model whose points provide depth for images without any"""

    point_choice: SparseChoice = SparseChoice()
    """which of these points are used"""

    checkpoint_seconds: float = 60.0
    """time between checkpoints: the most work lost if the program is killed"""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.refine_poses not in get_args(RefinementChoice):
            choices = ", ".join(get_args(RefinementChoice))
            raise InputError(f"refine_poses is {self.refine_poses!r}", expected=f"one of {choices}")
        if not self.checkpoint_seconds >= 0:
            raise InputError(f"checkpoint_seconds is {self.checkpoint_seconds}", expected="0 or more")


@dataclass(frozen=True)
class ImportOptions(MapOptions):
    """How the coordinates of a file are taken to the world, and by which importer."""

    importer: str | None = None
    """name of an installed importer, by default the one that recognizes the file"""

    scale: float = 1.0
    """factor of all lengths: metres per unit of the file"""

    T_world_file: SE3 | None = None
    """transforms the scaled coordinates of the file to the world"""
