"""Importers: plugins, found by name like backends, that read trained fields, meshes and the like from files."""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import torch
from jaxtyping import Float, Int
from torch import Tensor

from bidnerf_core.captures import StoredCamera
from bidnerf_core.datasets import Capture, find_reader
from bidnerf_core.errors import InputError, enumeration
from bidnerf_core.fields import SceneBounds
from bidnerf_core.geometry import SE3, Similarity
from bidnerf_core.io import open_binary, require_existing
from bidnerf_core.mapping import Keypoints
from bidnerf_core.maps.description_file import DESCRIPTION
from bidnerf_core.registry import Plugins, interface_defects

UNMOVED = Similarity(1.0, SE3.identity())
"""The identity placement, which leaves a field in the coordinates of its file."""


@dataclass(frozen=True, eq=False)
class Structure:
    """Posed images and the points that they observe, as reconstructed by structure from motion."""

    capture: Capture  # the images, all with poses and named; without a file, if their keypoints are known
    positions: Float[Tensor, "p 3"]  # metres, world, float64
    # number of the point that each keypoint of an image observes; -1: none
    observed: tuple[Int[Tensor, "k"], ...]
    keypoints: tuple[Keypoints, ...] = ()  # of the images as stored; empty: to be detected in them


@dataclass(frozen=True, eq=False)
class ImportedField:
    """The result of an importer: the field's backend, settings and tensors, and facts about the scene."""

    backend: str  # name of the backend that builds the field
    config: Any  # of the backend's ``config_type``
    tensors: dict[str, Tensor]  # state_dict of the field
    bounds: SceneBounds
    _: KW_ONLY
    found: tuple[str, ...] = ()  # sentences on the content of the file, such as counts, and what was left out
    steps: int = 1  # of its training; 1 if unknown
    # metres, world: points on the matter, from which its extent is reported
    points: Float[Tensor, "n 3"] | None = None
    cameras: tuple[StoredCamera, ...] = ()  # those of its training images, if files next to it provide them
    up: tuple[float, float, float] = (0.0, 0.0, 1.0)  # upward direction by the format's convention
    # points (metres, world) on the matter of a scan, and their colours: its surface, which then need not be rendered
    surface: tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"]] | None = None
    is_coloured: bool = True  # whether its colours are meaningful; otherwise renderings give no landmarks
    # dataset of its training images, with poses in the world; unused if others are given
    photos: Path | None = None
    is_solid: bool = False  # whether matter encloses no free space, so that the scene is viewed from outside
    # from which landmarks are made; the field is then none (``NoField``), its backend ""
    structure: Structure | None = None


@runtime_checkable
class Importer(Protocol):
    """Reads fields from files of one kind."""

    @property
    def summary(self) -> str:
        """One-line description for ``bidnerf plugins importers``: the files that the importer reads."""
        ...

    @property
    def config_type(self) -> type:
        """The type of the importer's settings: a frozen dataclass with a default for every field."""
        ...

    def recognises(self, path: Path) -> bool:
        """Return whether the importer can read the file or folder, judging by name and first bytes. Never raises."""
        ...

    def read(self, path: Path, config: Any, placement: Similarity) -> ImportedField:
        """Return the field in a file, transformed by ``placement`` from the file's coordinates to the world.

        Raises ``InputError`` for a damaged file, before memory is allocated for data that it only declares,
        and for a placement that this kind of field does not support. Code in a file is never run.

        An importer of posed images also takes ``image_folder``, the folder of the images if the user names one, else None.
        """
        ...


IMPORTERS: Plugins[Importer] = Plugins(
    "importers",
    lambda importer: interface_defects(
        importer,
        ("summary", "config_type"),
        {"recognises": ("path",), "read": ("path", "config", "placement")},
    ),
)
"""The installed importers, by name."""

OFFERED = {
    "gaussians": "splats",
    "scan": "meshes and scanned points",
    "nerfstudio": "checkpoints of nerfstudio",
    "nerf-pytorch": "those of nerf-pytorch",
}
"""What the importers of bidnerf's own plugins read, by their names."""


def importer_of(path: Path, name: str | None = None) -> tuple[str, Importer]:
    """Return the name and importer for a file: the importer called ``name`` or, without a name, the one that recognizes the file.

    Raises ``InputError`` if there is no such file, if the file is unreadable or a Git LFS pointer, and if no
    importer or more than one recognizes it.
    """
    require_existing(path, expected="a trained field or a COLMAP model")
    if name is not None:
        return name, IMPORTERS.load(name)
    if path.is_file():
        open_binary(path, "a trained field").close()
    found = [(each, IMPORTERS.load(each)) for each in IMPORTERS]
    able = [(each, importer) for each, importer in found if importer.recognises(path)]
    if len(able) == 1:
        return able[0]
    if able:
        raise InputError(
            f"{enumeration([each for each, _ in able])} can each read it; choose one of them (`importer`)", where=path
        )
    if (path / DESCRIPTION).is_file():
        raise InputError("is a map already, as bidnerf writes them", where=path, expected="a trained field")
    if find_reader(path) is not None:
        raise InputError(
            "is a dataset", where=path, expected="a trained field; 'bidnerf train' makes a map of a dataset"
        )
    known = "; ".join(f"{each} reads {importer.summary}" for each, importer in found)
    absent = [f"./plugins/bidnerf-{each} for {what}" for each, what in OFFERED.items() if each not in IMPORTERS]
    raise InputError(
        f"no installed importer recognizes it ({known})"
        + (f"; in a clone of bidnerf, pip install {enumeration(absent)}" if absent else ""),
        where=path,
    )


def robust_box(
    points: Float[Tensor, "n 3"], outside: float = 0.005, margin: float = 0.05
) -> tuple[Float[Tensor, "3"], Float[Tensor, "3"]]:
    """Return the lower and upper corner of a box around all but the fraction ``outside`` of points at each end of each axis.

    The box is then widened on every side by ``margin`` times its longest side.
    """
    some = points[:: max(1, len(points) // 200_000)].double()
    lower, upper = (some.quantile(q, dim=0) for q in (outside, 1 - outside))
    pad = margin * float((upper - lower).max()) or 1e-6
    return lower - pad, upper + pad


def bounds_about(
    points: Float[Tensor, "n 3"],
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    footprint: float = 0.0,
) -> SceneBounds:
    """Return scene bounds for geometry at ``points`` (metres, world) whose training images are unknown.

    If much of the geometry lies far outside the box around most of it, the scene is unbounded: the box then
    encloses only the dense part, and ``contracted`` is set. ``background`` (RGB in [0, 1]) and ``footprint``
    (metres) are copied to the result.
    """
    inner, outer = robust_box(points, 0.15, 0.25), robust_box(points)
    sides = [float((upper - lower).max()) for lower, upper in (inner, outer)]
    # The scene is unbounded if nearly all of its matter takes a box several times as large as most of it.
    contracted = sides[1] > 3 * sides[0]
    lower, upper = inner if contracted else outer
    farthest = points[:: max(1, len(points) // 200_000)].double() - (lower + upper) / 2
    reach = float(torch.linalg.vector_norm(farthest, dim=-1).quantile(0.999))
    diagonal = float(torch.linalg.vector_norm(upper - lower))
    far = 1.5 * (reach + diagonal) if contracted else 3 * diagonal
    low, high = ((float(c[0]), float(c[1]), float(c[2])) for c in (lower, upper))
    return SceneBounds(low, high, 1e-3 * diagonal, far, background, contracted, footprint)
