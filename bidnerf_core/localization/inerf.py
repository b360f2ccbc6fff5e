"""Method ``inerf``: the colours of one image, in full detail (Yen-Chen et al. 2021, iNeRF).

"In full detail" is the field itself, which a NeRF renders hierarchically, with its coarse and its fine network. Where iNeRF
descends by the magnitude and the axis of one screw motion from the start, here each step is an update of its own in the
same frame, the world's: the two differ in second order, and this one has no axis to lose at magnitude 0.
"""

from __future__ import annotations

from dataclasses import dataclass

from bidnerf_core.errors import InputError
from bidnerf_core.localization.problem import Problem
from bidnerf_core.localization.result import Localization
from bidnerf_core.localization.solvers.adam import DescentConfig, descend
from bidnerf_core.localization.solvers.pivots import PivotName
from bidnerf_core.pixels import DrawerName
from bidnerf_core.residuals import Objective
from bidnerf_core.robust import Robust, RobustName


@dataclass(frozen=True)
class InerfConfig(DescentConfig):
    """Settings of method ``inerf``: the learning rate and its decay are iNeRF's (section 4)."""

    max_steps: int = 300
    pixels: DrawerName = "interest-regions"  # where pixels are drawn: anywhere, at corners, around corners
    colour_loss: RobustName = "l2"  # robust loss of colour differences
    pivot: PivotName = "world"  # what an update turns about: iNeRF's is the origin of the world

    @property
    def objective(self) -> Objective:
        colour = Robust(self.colour_loss, self.colour_scale)
        return Objective(colour, colour, depth_weight=0.0)


def inerf(problem: Problem, config: InerfConfig, seed: int = 0) -> Localization:
    """Descend from ``problem.start`` on colour alone. Raises ``InputError`` for more than one image."""
    if len(problem.views) > 1:
        raise InputError(f"method inerf takes one image, got {len(problem.views)}; method bid takes several")
    return descend(problem, config, config.objective, 0, seed, "inerf")
