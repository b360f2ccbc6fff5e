"""The requirements on posers, which find the poses of photos."""

from __future__ import annotations

import math
import tempfile
from pathlib import Path
from typing import ClassVar

import torch
from PIL import Image

from bidnerf.testing.faults import Named, calling, require
from bidnerf.testing.textured_field import photograph
from bidnerf_core.camera import Intrinsics
from bidnerf_core.datasets import POSERS, DatasetOptions
from bidnerf_core.geometry import SE3, fit_similarity

PHOTO_CAMERA = Intrinsics(260.0, 260.0, 128.0, 96.0, 256, 192)


class PoserContract(Named):
    """Tests of a poser; to use them, derive a class whose name begins with ``Test`` and set ``name``.

    The photos show a textured ground from ``poses`` above it, by a known camera of 256 x 192 pixels. ``largest_error``
    (metres and radians, from 4 m above) is that of a pose after the similarity between the dataset's world and the true one.
    """

    kind = "poser"
    largest_error: ClassVar[float] = 0.05
    poses: ClassVar[list[SE3]] = [
        SE3.exp(torch.tensor([0.0, 0.0, 0.0, math.pi - 0.1 * (n % 2), 0.0, 0.0], dtype=torch.float64)).translated(
            torch.tensor([0.5 * n - 1.5, 0.4 * (n % 3), 4.0], dtype=torch.float64)
        )
        for n in range(7)
    ]

    def test_dataset_has_the_poses_of_the_photos(self) -> None:
        truth = {f"{number:02d}": T for number, T in enumerate(self.poses)}
        with tempfile.TemporaryDirectory() as folder:
            photos, out = Path(folder) / "photos", Path(folder) / "poses"
            photos.mkdir()
            for name, T in truth.items():
                Image.fromarray((photograph(T, PHOTO_CAMERA) * 255).round().to(torch.uint8).numpy()).save(
                    photos / f"{name}.png"
                )
            with calling(f"{self._who} of {len(truth)} photos"):
                record = self._part(POSERS.load)(photos, out, PHOTO_CAMERA)
            with calling(f"reading the dataset of {self._who}"):
                views = DatasetOptions().open(out).views("all")
        names = [view.frame.name for view in views]
        require(
            self._who,
            (record.placed == len(names), f"placed is {record.placed}, expected {len(names)}, the photos with a pose"),
            (len(names) > 2 and set(names) <= set(truth), f"found poses of {names}, expected those of {list(truth)}"),
            (
                all(view.frame.intrinsics == PHOTO_CAMERA for view in views),
                "the dataset has another camera, expected the one that was given",
            ),
        )
        found, true = SE3.stack([view.T_ref_camera for view in views]), SE3.stack([truth[name] for name in names])
        moved = fit_similarity(found.translation, true.translation).move(found)
        error = float((true.inverse() @ moved).log().norm(dim=-1).max())
        require(
            self._who,
            (
                error <= self.largest_error,
                f"a pose is off by {error:.3g} (metres, radians) after alignment, expected {self.largest_error:g} or less;"
                " are the poses T_world_camera with x right, y down and z forward?",
            ),
        )
