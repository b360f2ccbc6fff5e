"""Densification with a fixed number: Gaussians that are hardly visible are moved to where others contribute much."""

from __future__ import annotations

import math

import torch
from torch import Generator

from bidnerf_gaussians.field import GaussiansField
from bidnerf_gaussians.quaternions import matrices


@torch.no_grad()
def relocate(field: GaussiansField, least_opacity: float, generator: Generator) -> int:
    """Split opaque and wide Gaussians, reusing nearly transparent ones, and return how many were moved.

    The split ones are drawn by opacity times covered area. Both parts get the opacity with which the two, one
    behind the other, are as opaque as the original (Kheradmand et al. 2024, eq. 9), and are placed around its
    mean according to its own density.
    """
    opacity = field.logits.sigmoid().cpu()
    dead = (opacity < least_opacity).nonzero()[:, 0]
    # At most a twentieth of the Gaussians is moved at once.
    dead = dead[torch.randperm(len(dead), generator=generator)[: int(0.05 * len(opacity))]]
    area = torch.exp(field.log_scales.cpu().sort(dim=-1).values[:, 1:].sum(-1))
    weight = torch.where(opacity < least_opacity, 0, opacity * area).double()
    alive = int((weight > 0).sum())
    count = min(len(dead), alive)
    if not count:
        return 0
    chosen = torch.multinomial(weight, count, generator=generator)
    offsets = torch.randn((count, 3), generator=generator)
    device = field.means.device
    dead, chosen, offsets = dead[:count].to(device), chosen.to(device), offsets.to(device)
    turn = matrices(torch.nn.functional.normalize(field.quaternions[chosen], dim=-1))
    offset = (turn @ (field.log_scales[chosen].exp() * offsets)[..., None])[..., 0] / 2
    share = 1 - (1 - field.logits[chosen].sigmoid()).clamp(min=1e-6).sqrt()
    logit = share.clamp(least_opacity, 1 - 1e-6).logit()
    # The two Gaussians that replace one are narrower by a factor of 1.6, as in the original 3DGS code.
    middle, width = field.means[chosen], field.log_scales[chosen] - math.log(1.6)
    turns, harmonics = field.quaternions[chosen], field.harmonics[chosen]
    for index, place in ((chosen, middle + offset), (dead, middle - offset)):
        field.means[index], field.log_scales[index], field.logits[index] = place, width, logit
        field.quaternions[index], field.harmonics[index] = turns, harmonics
    return count
