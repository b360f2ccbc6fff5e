"""The start of ``bidnerf localize``: a pose from a file, the perturbed true pose, or none."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from bidnerf_core.datasets import Query
from bidnerf_core.errors import UsageError
from bidnerf_core.evaluation import FARTHEST_START, perturb
from bidnerf_core.geometry import SE3
from bidnerf_core.results import pose_of


@dataclass(frozen=True)
class StartSpec:
    """The start given by the arguments: one of the two fields, or neither. ``file`` is the file of ``fixed``."""

    fixed: dict[str, SE3] | None = None  # T_world_camera by query name; a single one applies to all
    perturb: tuple[float, float] | None = None  # length in the unit of the map, degrees
    file: Path | None = None

    def check(self) -> None:
        """Raise ``UsageError`` for a perturbation out of range."""
        if self.perturb is not None:
            limits = (("T", "metres", FARTHEST_START), ("R", "degrees", 180.0))
            for (what, unit, most), value in zip(limits, self.perturb, strict=True):
                if not 0 <= value <= most:
                    raise UsageError(
                        f"{what} is {value:g}", where="--perturb", expected=f"{unit} from 0 to {most:g}"
                    )

    @property
    def given(self) -> bool:
        return self.fixed is not None or self.perturb is not None

    def pose(self, query: Query, seed: int) -> SE3 | None:
        """Return T_world_camera to start from. ``seed`` determines the direction in which the true pose is
        perturbed.

        Raises ``InputError`` if a file of several poses has none for this query.
        """
        if self.perturb is not None and query.truth is not None:
            return perturb(query.truth, *self.perturb, seed)
        return None if self.fixed is None else pose_of(self.fixed, query.name, self.file or "start")
