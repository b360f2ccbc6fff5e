"""The importer of nerfstudio runs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor, nn

from bidnerf_core.backend import load_backend
from bidnerf_core.errors import InputError, enumeration
from bidnerf_core.fields import SceneBounds
from bidnerf_core.geometry import Similarity
from bidnerf_core.io import Record, background_colour
from bidnerf_core.maps import ImportedField
from bidnerf_core.settings import Settings
from bidnerf_nerfstudio import models
from bidnerf_nerfstudio.placement import Placement, after, inverse
from bidnerf_nerfstudio.run import CONFIG, Run, read_run
from bidnerf_nerfstudio.weights import Weights

UP = (0.0, 0.0, 1.0)
"""Upward direction in training coordinates, to which nerfstudio rotates the poses by default."""


@dataclass(frozen=True)
class ImportSettings(Settings):
    """Settings that a run does not contain, or that have become outdated."""

    data: str = ""  # dataset that the run was trained on, if it was moved; "": as in the config
    # colour where a ray hits nothing; run: as in the run's renderings, which is black for random and
    # last_sample
    background: Literal["run", "white", "black"] = "run"


@dataclass(frozen=True)
class NerfstudioImporter:
    """Reads runs of nerfacto, instant-ngp, vanilla-nerf and splatfacto."""

    summary: str = "runs of nerfstudio (the folder with config.yml): nerfacto, instant-ngp, vanilla-nerf, splatfacto"
    config_type: type = ImportSettings

    def recognises(self, path: Path) -> bool:
        """Return whether the path is the folder of a run, or its config."""
        try:
            return bool(read_run(path).kind)
        except (InputError, OSError):
            return False

    def read(self, path: Path, config: ImportSettings, placement: Similarity) -> ImportedField:
        """Read the field of a run, see ``Importer``."""
        run = read_run(path)
        data, told = _data(run, config)
        to_training, frame = run.trained_from_data(data)
        placed = Placement.from_similarity(after(to_training, inverse(placement)))
        if run.kind in SPLATS:
            found = _splats(run, after(placement, inverse(to_training)))
        else:
            found = _networks(run, placed, config)
        photos = (
            (data.parent if data.suffix == ".json" else data) if data is not None and placement.is_identity else None
        )
        if data is not None and photos is None:
            told = "its photos are ignored, since their poses are not in the world of the map (`scale`, `T_world_file`)"
        facts = (*found.found, frame, *([told] if told else []))
        up = torch.tensor(placed.rotation, dtype=torch.float64).reshape(3, 3).mT @ torch.tensor(UP, dtype=torch.float64)
        return replace(found, found=facts, photos=photos, up=(float(up[0]), float(up[1]), float(up[2])))


def _data(run: Run, config: ImportSettings) -> tuple[Path | None, str]:
    """Return the dataset of the run, or None and a sentence. Raises ``InputError`` if the given one does not exist."""
    if config.data:
        given = Path(config.data)
        if not given.exists():
            raise InputError("no such file or folder", where=given, expected="the dataset of the run (`data`)")
        return given, ""
    named = run.data
    if named is None or not named.exists():
        where = "the config names no dataset" if named is None else f"its dataset {named} is no longer there"
        return None, f"{where}: no photos for landmarks (`photos`, or `data`)"
    return named, ""


@dataclass(frozen=True)
class Model:
    """A kind of model: the backend that renders it, and how its tensors are read."""

    backend: str
    read: Callable[[Weights, Record, Record], models.Read]
    reach: Callable[[Record], tuple[float, float]]  # nearest and farthest distance of matter, in training units


def _planes(model: Record) -> tuple[float, float]:
    return model.number("near_plane") or 0.0, model.number("far_plane") or 1000.0


def _collider(model: Record) -> tuple[float, float]:
    found = model.value("collider_params")
    params = Record(f"{model.where}: collider_params", found if isinstance(found, dict) else {})
    return params.number("near_plane") or 2.0, params.number("far_plane") or 6.0


NERFACTO = Model("nerfstudio-nerfacto", models.nerfacto, _planes)
MODELS = {
    "NerfactoModel": NERFACTO,
    "DepthNerfactoModel": NERFACTO,
    "NGPModel": Model("nerfstudio-ngp", models.instant_ngp, _planes),
    "NeRFModel": Model("nerfstudio-vanilla", models.vanilla, _collider),
}
SPLATS = ("SplatfactoModel",)


def _networks(run: Run, placement: Placement, config: ImportSettings) -> ImportedField:
    model = MODELS.get(run.kind)
    if model is None:
        known = enumeration([*MODELS, *SPLATS])
        raise InputError(
            f"a run of {run.kind}, which cannot be read;",
            where=run.folder / CONFIG,
            expected=f"one of {known}",
        )
    tensors, steps = run.weights()
    weights = Weights(run.checkpoint, tensors)
    read = model.read(weights, run.model, run.parser)
    bounds = _bounds(read, model.reach(run.model), placement, run, config)
    settings = replace(read.settings, placement=placement.numbers, steps=max(1, steps))
    field: Any = load_backend(model.backend).build(settings, bounds)
    state: dict[str, Tensor] = weights.load(_module(field), read.state)
    facts = (f"{run.kind} of nerfstudio, {steps} steps ({run.checkpoint.name}); {read.told}",)
    return ImportedField(model.backend, settings, state, bounds, found=facts, steps=settings.steps)


def _module(field: Any) -> nn.Module:
    return field


def _bounds(
    read: models.Read, reach: tuple[float, float], placement: Placement, run: Run, config: ImportSettings
) -> SceneBounds:
    """Return the bounds in the world: the box around that of the training, and its distance limits."""
    lower, upper = (torch.tensor(corner, dtype=torch.float64) for corner in (read.box[:3], read.box[3:]))
    if not bool((lower < upper).all()):
        raise InputError(f"the scene's box {read.box} is empty", where=run.checkpoint, expected="one with an extent")
    corners = torch.cartesian_prod(*torch.stack([lower, upper], dim=-1))
    world = inverse(placement.similarity).apply(corners)
    low, high = world.amin(0).tolist(), world.amax(0).tolist()
    named = run.model.text("background_color") if config.background == "run" else config.background
    colour = background_colour("white" if named == "white" else "black")
    near, far = (distance / placement.scale for distance in reach)
    return SceneBounds((low[0], low[1], low[2]), (high[0], high[1], high[2]), near, far, colour, read.contracted)


def _splats(run: Run, placement: Similarity) -> ImportedField:
    """Read the field of a splatfacto run using the plugin for Gaussians. Raises ``InputError`` without that plugin."""
    try:
        from bidnerf_gaussians import importer
    except ImportError as error:
        raise InputError(
            f"a run of {run.kind}",
            where=run.folder / CONFIG,
            expected="the plugin bidnerf-gaussians to be installed",
        ) from error
    return importer.read(run.checkpoint, importer.config_type(), placement)


importer = NerfstudioImporter()
"""runs of nerfstudio (the folder with config.yml): nerfacto, instant-ngp, vanilla-nerf, splatfacto"""
