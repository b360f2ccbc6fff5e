"""The start of ``bidnerf localize``: a pose from a file, the perturbed true pose, or none."""

from __future__ import annotations

from dataclasses import dataclass

from bidnerf_core.errors import UsageError
from bidnerf_core.evaluation import protocols
from bidnerf_core.geometry.se3 import SE3


@dataclass(frozen=True)
class StartSpec:
    """A start as given by the arguments: one of the two, or none."""

    fixed: SE3 | None = None  # T_world_camera
    perturb: tuple[float, float] | None = None  # metres, degrees

    def check(self) -> None:
        """Raise ``UsageError`` for a perturbation out of range."""
        if self.perturb is not None:
            limits = (("T", "metres", protocols.FARTHEST_START), ("R", "degrees", 180.0))
            for (what, unit, most), value in zip(limits, self.perturb, strict=True):
                if not 0 <= value <= most:
                    raise UsageError(f"--perturb: {what} is {value:g}, expected {unit} from 0 to {most:g}")

    @property
    def given(self) -> bool:
        return self.fixed is not None or self.perturb is not None

    def pose(self, truth: SE3 | None, seed: int) -> SE3 | None:
        """Return T_world_camera to start from. ``seed`` determines the direction in which the true pose is perturbed."""
        if self.perturb is None or truth is None:
            return self.fixed
        return protocols.perturb(truth, *self.perturb, seed)
