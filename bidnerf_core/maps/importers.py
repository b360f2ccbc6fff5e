"""Importers: what reads a trained field, a mesh or the like from a file, found by name as backends are."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import KW_ONLY, dataclass
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.captures.cameras import StoredCamera
from bidnerf_core.errors import InputError, enumeration
from bidnerf_core.fields.contract import SceneBounds
from bidnerf_core.geometry.se3 import SE3
from bidnerf_core.geometry.similarity import Similarity
from bidnerf_core.registry import Plugins, interface_defects

UNMOVED = Similarity(1.0, SE3.identity())
"""The placement of a field in the coordinates of its file."""


@dataclass(frozen=True, eq=False)
class ImportedField:
    """What an importer found in a file: how a backend builds the field, and its tensors."""

    backend: str  # name of the backend that builds the field
    config: Any  # of the backend's ``config_type``
    tensors: dict[str, Tensor]  # state_dict of the field
    bounds: SceneBounds
    _: KW_ONLY
    found: tuple[str, ...] = ()  # sentences on what the file holds, such as counts, and what was left out
    steps: int = 1  # of its training, where that is known
    points: Float[Tensor, "n 3"] | None = (
        None  # metres, world: places on the matter, from which its extent is told
    )
    cameras: tuple[StoredCamera, ...] = ()  # those of its training images, where files beside it tell
    up: tuple[float, float, float] = (0.0, 0.0, 1.0)  # direction that is upwards by the format's convention
    surface: tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"]] | None = (
        None  # points (metres, world) on the matter of a scan, and their colours: its surface, which need not be rendered
    )
    is_coloured: bool = True  # whether its colours mean something; otherwise renderings give no landmarks
    photos: Path | None = (
        None  # dataset of its training images, whose poses are in the world; not used where others are given
    )
    is_solid: bool = False  # whether matter encloses no free space, so that the scene is seen from around it


@runtime_checkable
class Importer(Protocol):
    """What reads fields of one kind."""

    @property
    def summary(self) -> str:
        """One line for ``bidnerf plugins importers``: which files it reads."""
        ...

    @property
    def config_type(self) -> type:
        """A frozen dataclass with a default for every field: what the user may have to say about a file."""
        ...

    def recognises(self, path: Path) -> bool:
        """Return whether the file or folder is one to read, as told from its name and its first bytes. Raises nothing."""
        ...

    def read(self, path: Path, config: Any, placement: Similarity) -> ImportedField:
        """Return the field in a file, moved by ``placement`` from the file's coordinates to the world.

        Raises ``InputError`` for a damaged file, before memory is allocated for what it only declares, and for a placement that
        a field of its kind cannot take. Code in a file is never run.
        """
        ...


def _defects(importer: Any) -> Iterator[str]:
    methods = {"recognises": ("path",), "read": ("path", "config", "placement")}
    yield from interface_defects(importer, ("summary", "config_type"), methods)


IMPORTERS: Plugins[Importer] = Plugins("importers", _defects)
"""The importers by name."""


def importer_of(path: Path, name: str | None = None) -> tuple[str, Importer]:
    """Return the importer of that name or, without one, that which recognises the file, with its name.

    Raises ``InputError`` where there is no such file, and where none or several recognise it.
    """
    if not path.exists():
        raise InputError(f"{path}: no such file or folder, expected a trained field")
    if name is not None:
        return name, IMPORTERS.load(name)
    found = [(each, IMPORTERS.load(each)) for each in IMPORTERS]
    able = [(each, importer) for each, importer in found if importer.recognises(path)]
    if len(able) == 1:
        return able[0]
    if able:
        names = enumeration([each for each, _ in able])
        raise InputError(f"{path}: {names} can each read it; expected one of them to be chosen (--as)")
    known = "; ".join(f"{each} reads {importer.summary}" for each, importer in found)
    raise InputError(
        f"{path}: no installed importer recognises it"
        + (
            f" ({known})"
            if known
            else ", since none is installed (pip install bidnerf-gaussians is one for splats)"
        )
    )


def robust_box(
    points: Float[Tensor, "n 3"], outside: float = 0.005, margin: float = 0.05
) -> tuple[Float[Tensor, "3"], Float[Tensor, "3"]]:
    """Return the corners of a box about all points but a share of ``outside`` at each end of each axis.

    It is widened by ``margin`` times its longest side.
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
    """Return bounds for matter at ``points`` (metres, world) whose training images are not known.

    Where much of the matter is far outside of the box about most of it, the scene is unbounded: the box is then that about its
    dense part, and ``contracted``.
    """
    inner, outer = robust_box(points, 0.15, 0.25), robust_box(points)
    sides = [float((upper - lower).max()) for lower, upper in (inner, outer)]
    contracted = sides[1] > UNBOUNDED * sides[0]
    lower, upper = inner if contracted else outer
    farthest = points[:: max(1, len(points) // 200_000)].double() - (lower + upper) / 2
    reach = float(torch.linalg.vector_norm(farthest, dim=-1).quantile(0.999))
    diagonal = float(torch.linalg.vector_norm(upper - lower))
    far = 1.5 * (reach + diagonal) if contracted else 3 * diagonal
    low, high = ((float(c[0]), float(c[1]), float(c[2])) for c in (lower, upper))
    return SceneBounds(low, high, 1e-3 * diagonal, far, background, contracted, footprint)


UNBOUNDED = 3.0
"""Ratio of the sides of the boxes about nearly all matter and about most of it, above which a scene is unbounded."""
