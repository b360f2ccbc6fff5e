"""The first-order methods ``bid`` (BID-NeRF) and ``inerf`` (iNeRF): Adam on the loss of sampled rays, from a start.

``bid`` uses colour and depth of one or several images at the coarse level (BID-NeRF, Alg. 1). ``inerf`` uses the colours of one image in
full detail (Yen-Chen et al. 2021, iNeRF): those of the field itself, which a NeRF renders hierarchically with its coarse and fine networks.
iNeRF optimizes the magnitude and axis of one screw motion from the start; here, each step is a separate update in the same frame, the
world's. The two differ only to second order, and such an update has no axis that is undefined at magnitude 0.
"""

from bidnerf_bid.adam import AdamSteps
from bidnerf_bid.methods import BID, INERF
from bidnerf_bid.pivot import Pivot, pivot
from bidnerf_bid.pixels import DRAWERS, DrawerName
from bidnerf_bid.residuals import DEPTH_RESIDUALS, DepthResidual, Objective, Residual, Term
from bidnerf_bid.sampled import SampledLoss
from bidnerf_bid.settings import (
    AdamSettings,
    BidConfig,
    DepthSettings,
    DescentSettings,
    InerfConfig,
    ReachSettings,
    objective_of,
)

__all__ = [
    "BID",
    "DEPTH_RESIDUALS",
    "DRAWERS",
    "INERF",
    "AdamSettings",
    "AdamSteps",
    "BidConfig",
    "DepthResidual",
    "DepthSettings",
    "DescentSettings",
    "DrawerName",
    "InerfConfig",
    "Objective",
    "Pivot",
    "ReachSettings",
    "Residual",
    "SampledLoss",
    "Term",
    "objective_of",
    "pivot",
]
