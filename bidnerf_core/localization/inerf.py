"""Method ``inerf``: the colours of one image, in full detail (Yen-Chen et al. 2021, iNeRF).

"In full detail" is the field itself, which a NeRF renders hierarchically with its coarse and its fine network. iNeRF
optimizes the magnitude and the axis of one screw motion from the start; here each step is an update of its own in the same
frame, the world's. The two differ to second order, and updates have no axis that would be undefined at magnitude 0.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from bidnerf_core.errors import InputError
from bidnerf_core.localization.first_order import descended
from bidnerf_core.localization.method_settings import (
    AdamSettings,
    ColourSettings,
    DescentSettings,
    objective_of,
)
from bidnerf_core.localization.methods import Method
from bidnerf_core.localization.problem import Problem
from bidnerf_core.localization.result import Localization
from bidnerf_core.settings import Settings


@dataclass(frozen=True)
class InerfConfig(Settings):
    """Settings of method ``inerf``: the learning rate and its decay are iNeRF's (section 4)."""

    descent: DescentSettings = DescentSettings(pixels="interest-regions", pivot="world")
    adam: AdamSettings = AdamSettings(max_steps=300)
    colour: ColourSettings = ColourSettings(colour_loss="l2")


INERF_PRESETS = {"paper": replace(InerfConfig(), adam=AdamSettings(max_steps=1000))}
"""The settings with which BID-NeRF compares: iNeRF's own learning rate, 1000 steps of 2048 rays."""


def inerf(problem: Problem, config: InerfConfig, seed: int = 0) -> Localization:
    """Descend from ``problem.start`` on colour alone. Raises ``InputError`` for more than one image."""
    if len(problem.views) > 1:
        raise InputError(f"method inerf takes one image, got {len(problem.views)}; method bid takes several")
    objective = objective_of(config.colour, None)
    return descended(problem, config.descent, config.adam, objective, 0, seed, "inerf")


INERF = Method(
    inerf,
    InerfConfig,
    needs_start=True,
    uses_depth=False,
    presets=INERF_PRESETS,
    summary="Adam on the colours of one image in full detail (iNeRF)",
)
