"""The importer of checkpoints."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

from bidnerf_core.errors import InputError
from bidnerf_core.fields import SceneBounds
from bidnerf_core.geometry import Similarity
from bidnerf_core.io import background_colour
from bidnerf_core.maps import ImportedField
from bidnerf_core.settings import Count, Settings
from bidnerf_nerf_pytorch.checkpoint import is_checkpoint, read_checkpoint
from bidnerf_nerf_pytorch.field import NerfPytorchField
from bidnerf_nerf_pytorch.recipe import NerfPytorchConfig

ENDINGS = (".ckpt", ".pt", ".pth", ".tar")
Box = tuple[float, float, float, float, float, float]


@dataclass(frozen=True)
class ImportSettings(Settings):
    """Settings that a checkpoint does not contain."""

    near: float = 2.0  # distance along a ray before which there is nothing, in the scene's unit
    far: float = 6.0  # distance along a ray beyond which there is nothing
    background: Literal["white", "black"] = "white"  # colour where a ray meets nothing
    # lower and upper corner of the scene; nothing outside is rendered
    box: Box = (-1.5, -1.5, -1.5, 1.5, 1.5, 1.5)
    coarse_samples: Count = 64  # places on a ray at which the coarse network is evaluated
    fine_samples: Count = 64  # further places at which the fine network is evaluated
    octaves: bool = True  # whether frequencies double (nerf-pytorch's log_sampling), which the weights do not reveal


@dataclass(frozen=True)
class NerfPytorchImporter:
    """Reads checkpoints of krrish94/nerf-pytorch."""

    summary: str = "checkpoints of krrish94/nerf-pytorch (.ckpt)"
    config_type: type = ImportSettings

    def recognises(self, path: Path) -> bool:
        """Return whether the file is a checkpoint with a coarse and a fine network."""
        if path.suffix.lower() not in ENDINGS or not path.is_file():
            return False
        try:
            return is_checkpoint(path)
        except (InputError, OSError):
            return False

    def read(self, path: Path, config: ImportSettings, placement: Similarity) -> ImportedField:
        """Read the field of both networks, see ``Importer``. It stays in the world that it was trained in."""
        if not placement.is_identity:
            raise InputError(
                "networks cannot be moved or scaled;",
                where=path,
                expected="photos in their world, without scale or pose",
            )
        bounds = SceneBounds(
            config.box[:3], config.box[3:], config.near, config.far, background_colour(config.background)
        )
        found = read_checkpoint(path, config.octaves)
        settings = NerfPytorchConfig(
            **asdict(found.network),
            coarse_samples=config.coarse_samples,
            fine_samples=config.fine_samples,
            steps=max(1, found.steps),
        )
        field = NerfPytorchField(settings, bounds)
        field.load_state_dict(found.tensors)
        size = f"{settings.layers} layers of {settings.width}"
        facts = (f"coarse and fine network of {size}, {found.steps} steps",)
        return ImportedField("nerf-pytorch", settings, dict(field.state_dict()), bounds, found=facts, steps=found.steps)


importer = NerfPytorchImporter()
"""checkpoints of krrish94/nerf-pytorch (.ckpt)"""
