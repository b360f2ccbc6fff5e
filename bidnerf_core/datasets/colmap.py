"""Points of a COLMAP sparse model observed by the frames of a dataset, in metres.

Images of the model and frames of the dataset are matched by name. The model has its own world frame and
length unit; the length of this unit in metres is estimated from the training camera positions, which are in
both the model and the dataset. No other pose is used.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Annotated

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.datasets.colmap_files import ModelImage, read_model
from bidnerf_core.depth import nearest_depth
from bidnerf_core.errors import InputError, enumeration, errors_in
from bidnerf_core.frames import View
from bidnerf_core.geometry import SE3, fit_most, spread
from bidnerf_core.settings import Above, Settings, WholeNumbers


@dataclass(frozen=True)
class SparseChoice(Settings):
    """Selection criteria for the points of a COLMAP model."""

    points_error: Annotated[float, Above(0)] = 2.0  # largest mean reprojection error of a selected point, pixels
    points_views: Annotated[int, WholeNumbers(1)] = 2  # smallest number of images that observe a selected point


class SparsePoints:
    """The points of the model in ``folder``, scaled to metres by the training poses ``places`` (frame name, T_world_camera).

    The unit of the model is ``metres`` long, as estimated from ``cameras`` training cameras. ``misfit`` is the median
    distance between these cameras and the model's, relative to their spread.

    Raises ``InputError`` if the folder holds no valid model, and if its cameras are not the training cameras.
    """

    def __init__(
        self, folder: Path, places: Sequence[tuple[str, SE3]], choice: SparseChoice, split: str = "train"
    ) -> None:
        self.folder = folder
        images, self._points = read_model(folder)
        # By the name of the frame: the stem, or folders and stem as joined by datasets ("left_0001").
        self._images: dict[str, list[tuple[tuple[str, ...], ModelImage]]] = defaultdict(list)
        for image in images:
            parts = PurePosixPath(image.name.replace("\\", "/")).with_suffix("").parts
            for name in {"_".join(parts[-count:]) for count in range(1, len(parts) + 1)}:
                self._images[name].append((parts[:-1], image))
        self._some = f"{len(images)} images ({enumeration([image.name for image in images], 3) or 'none'})"
        points = self._points
        sound = points.positions.isfinite().all(-1) & ~points.errors.isnan()
        # A negative error was never computed and excludes no point.
        self._chosen = sound & (points.errors <= choice.points_error) & (points.tracks >= choice.points_views)
        if not bool(self._chosen.any()):
            raise InputError(
                f"none of its {len(self._chosen)} points has a reprojection error of {choice.points_error:g}"
                f" pixels or less and {choice.points_views} observations or more",
                where=folder,
            )
        known = [
            (placed.T_camera_model.inverse().translation, T.translation)
            for name, T in places
            if (placed := self._image(name, split))
        ]
        if len(known) < 2:
            raise InputError(
                f"has {len(known)} of the {len(places)} training cameras",
                where=folder,
                expected=f"at least 2 to determine its unit; it has {self._some}",
            )
        there, here = (torch.stack([pair[i].double().cpu() for pair in known]) for i in (0, 1))
        with errors_in(f"{folder}: the unit cannot be estimated from the training cameras"):
            fit, errors, used = fit_most(there, here)
        self.metres, self.cameras = fit.scale, int(used.sum())
        self.misfit = float(errors[used].median()) / spread(here[used])
        # A larger misfit indicates a different scene; a hand-held camera that moved by decimetres reaches 0.03.
        if self.misfit > 0.2:
            raise InputError(
                f"its cameras are {self.misfit:.0%} of their spread away from the training cameras",
                where=folder,
                expected="at most 20%; is it a model of these images?",
            )

    def _image(self, name: str, split: str) -> ModelImage | None:
        """Return the model's image of a frame, or None. Folders named train, val or test separate the frames of splits.

        Raises ``InputError`` if the name is ambiguous.
        """
        others = {"train", "val", "test"} - {split}
        fits = [(folders, image) for folders, image in self._images.get(name, []) if not others & set(folders)]
        fits = [(folders, image) for folders, image in fits if split in folders] or fits
        if len(fits) > 1:
            raise InputError(
                f"frame {name!r} may be any of {', '.join(image.name for _, image in fits[:4])};",
                where=self.folder,
                expected="one image of that name",
            )
        return fits[0][1] if fits else None

    @property
    def summary(self) -> str:
        """A one-line description of the model's unit."""
        checked = f", positions agree to {self.misfit:.2%} of their spread" if self.cameras > 2 else ", unchecked"
        return f"{self.folder}: its unit is {self.metres:.4g} m according to {self.cameras} training cameras{checked}"

    def seen(self, name: str, split: str) -> Float[Tensor, "n 3"]:
        """Return the points that a frame observes (metres, camera frame); empty if the frame is not in the model."""
        image = self._image(name, split)
        if image is None:
            return torch.zeros((0, 3), dtype=torch.float64)
        rows = self._points.rows(image.points, self._chosen)
        points = image.T_camera_model.apply(self._points.positions[rows[rows >= 0]]) * self.metres
        return points[points[:, 2] > 0]

    def onto(self, view: View, split: str) -> View:
        """Return the view with the depth (planar z) of the nearest observed point at each pixel, 0 elsewhere.

        A view with measured depth, or without observed points, is returned unchanged.
        """
        points = self.seen(view.frame.name, split)
        if view.frame.has_depth or len(points) == 0:
            return view
        return View(view.frame.replace(depth=nearest_depth(points, view.frame.intrinsics)), view.T_ref_camera)
