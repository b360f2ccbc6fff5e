"""The importer of files of Gaussians."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.captures import StoredCamera, cameras_beside
from bidnerf_core.errors import InputError
from bidnerf_core.geometry import Similarity
from bidnerf_core.maps import UNMOVED, ImportedField, bounds_about
from bidnerf_core.settings import NotNegative, Range, Settings
from bidnerf_gaussians.field import GaussiansField
from bidnerf_gaussians.formats import Format, format_of
from bidnerf_gaussians.gaussians import Gaussians, cleaned
from bidnerf_gaussians.recipe import GaussiansConfig

DILATION = 0.3
"""Square pixels that the original 3DGS code adds to the covariance of each Gaussian in an image."""
UP = (0.0, -1.0, 0.0)


@dataclass(frozen=True)
class ImportSettings(Settings):
    """Settings that a file does not contain."""

    # angle between neighbouring pixels of the training images (radians), by which the original 3DGS code
    # widens small Gaussians; 0: not widened
    pixel_angle: Annotated[float, Range(0, 0.1)] = 0.001
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)  # colour (rgb) where a ray hits nothing
    degree: Annotated[int, Range(0, 3)] = 3  # highest degree of the harmonics that is kept
    # composite in the order of the means, as do the renderers with which splats are trained
    by_means: bool = True
    least_opacity: NotNegative = 0.0  # opacity below which Gaussians are left out


@dataclass(frozen=True)
class GaussiansImporter:
    """Reads files of Gaussians in all formats."""

    summary: str = (
        "Gaussian splats: .ply, compressed .ply, .splat, .spz, .sog, .glb, checkpoints of gsplat and splatfacto"
    )
    config_type: type = ImportSettings

    def recognises(self, path: Path) -> bool:
        """Return whether the file is one of the formats."""
        try:
            return format_of(path) is not None
        except OSError:
            return False

    def read(self, path: Path, config: ImportSettings, placement: Similarity) -> ImportedField:
        """Read the Gaussians in a file as a field, see ``Importer``."""
        found = format_of(path)
        if found is None:
            raise InputError("not a readable file of Gaussians", where=path, expected=self.summary)
        return imported(found.read(path), str(path), config, placement, found, cameras_beside(path, placement))


def imported(
    gaussians: Gaussians,
    where: str,
    config: ImportSettings = ImportSettings(),
    placement: Similarity = UNMOVED,
    of: Format | None = None,
    cameras: tuple[StoredCamera, ...] = (),
) -> ImportedField:
    """Build a field from Gaussians of any source. Raises ``InputError`` if none of them can be rendered."""
    kept, dropped = cleaned(gaussians, where)
    if config.least_opacity:
        before, kept = len(kept), kept[kept.opacities >= config.least_opacity]
        if not len(kept):
            raise InputError(f"no Gaussian reaches opacity {config.least_opacity:g} (least_opacity)", where=where)
    count = len(gaussians)
    kept = replace(kept, harmonics=kept.harmonics[:, : (config.degree + 1) ** 2])
    T = placement.T_target_source
    moved = kept.similar(placement.scale, T.rotation, T.translation)
    moved = with_dilation(moved, config.pixel_angle, cameras)
    # Only opaque Gaussians count as matter in measuring the extent of the scene, unless there are too few.
    opaque = moved.means[moved.opacities > 0.3]
    points = opaque if len(opaque) >= 100 else moved.means
    bounds = bounds_about(points, config.background)
    settings = GaussiansConfig(gaussians=len(moved), degree=moved.degree, by_means=config.by_means, steps=1)
    field = GaussiansField(settings, bounds)
    field.assign(moved)
    facts = [f"{count:,} Gaussians, harmonics of degree {gaussians.degree}" + (f" ({of.name})" if of else "")]
    if dropped:
        facts.append(f"left out {dropped}")
    if config.least_opacity:
        facts.append(f"left out {before - len(kept):,} with an opacity below {config.least_opacity:g}")
    if of is not None:
        facts.append(f"axes: {of.convention}")
    up = T.rotation.double() @ torch.tensor(UP if of is None else of.up, dtype=torch.float64)
    return ImportedField(
        "gaussians",
        settings,
        dict(field.state_dict()),
        bounds,
        found=tuple(facts),
        steps=settings.steps,
        points=points,
        cameras=cameras,
        up=(float(up[0]), float(up[1]), float(up[2])),
    )


def with_dilation(gaussians: Gaussians, pixel_angle: float, cameras: tuple[StoredCamera, ...] = ()) -> Gaussians:
    """Return the Gaussians as wide as an image renderer shows them: at least about half a pixel.

    The original 3DGS code adds ``DILATION`` square pixels to the covariance in the image, and Gaussians are
    trained with it. A ray has no width, so the Gaussians themselves are widened by the size of a pixel at
    their distance from the nearest camera or, if no camera is known, from half the scene's diameter away (as
    in the 3D filter of Yu et al. 2024).
    """
    if pixel_angle == 0:
        return gaussians
    width = math.sqrt(DILATION) * pixel_angle * _distances(gaussians.means, cameras)
    square = (2 * gaussians.log_scales).exp() + width.square()[:, None]
    return replace(gaussians, log_scales=0.5 * square.log())


def _distances(means: Float[Tensor, "n 3"], cameras: tuple[StoredCamera, ...]) -> Float[Tensor, "n"]:
    if not cameras:
        middle = means.median(0).values
        away = torch.linalg.vector_norm(means - middle, dim=-1)
        return torch.maximum(away, away.median()).clamp(
            max=float(away.quantile(0.9) if len(away) < 2**24 else away.max())
        )
    eyes = torch.stack([camera.pose.translation for camera in cameras]).to(means)
    return torch.cat([torch.cdist(some, eyes).amin(1) for some in means.split(65536)])


importer = GaussiansImporter()
"""Gaussian splats: .ply, compressed .ply, .splat, .spz, .sog, .glb, checkpoints of gsplat and splatfacto"""
