"""The folder of a trained run: its config, its latest checkpoint, and how its poses were transformed. No code
in it is run.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
import yaml
from torch import Tensor

from bidnerf_core.errors import InputError
from bidnerf_core.geometry import SE3, Similarity, rigid_pose
from bidnerf_core.io import Record, read_file, read_record, read_saved
from bidnerf_nerfstudio.placement import after, inverse

CONFIG = "config.yml"
TRANSFORMS = "dataparser_transforms.json"
EXPECTED = "the folder of a nerfstudio run, with config.yml and nerfstudio_models/step-*.ckpt"
STEP = re.compile(r"step-(\d+)\.ckpt")
PREFIX = "_model."
COLMAP = [[0.0, 1.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0]]
"""nerfstudio's default for a missing ``applied_transform`` in data that it processed with COLMAP."""


class _PlainLoader(yaml.SafeLoader):
    """Reads Python objects as the plain values with which they are written: nothing is imported or called."""


def _plain(loader: yaml.SafeLoader, suffix: str, node: yaml.Node) -> Any:
    if isinstance(node, yaml.MappingNode):
        return loader.construct_mapping(node, deep=True)
    if isinstance(node, yaml.SequenceNode):
        return loader.construct_sequence(node, deep=True)
    return suffix.partition(":")[2] or loader.construct_scalar(node)  # type: ignore[arg-type]


_PlainLoader.add_multi_constructor("tag:yaml.org,2002:python/", _plain)


@dataclass(frozen=True)
class Run:
    """A nerfstudio run, as far as it can be read without nerfstudio."""

    folder: Path
    config: Record

    @property
    def model(self) -> Record:
        """The settings of the model."""
        return _part(_part(self.config, "pipeline"), "model")

    @property
    def kind(self) -> str:
        """Name of the model's class, such as "NerfactoModel"."""
        return (self.model.text("_target") or "").rpartition(".")[2]

    @property
    def parser(self) -> Record:
        """The settings of the dataset parser."""
        return _part(_part(_part(self.config, "pipeline"), "datamanager"), "dataparser")

    @property
    def data(self) -> Path | None:
        """The dataset that the run was trained on, a folder or a JSON file, according to the config."""
        manager = _part(_part(self.config, "pipeline"), "datamanager")
        for record in (self.parser, manager, self.config):
            parts = record.value("data")
            if isinstance(parts, list) and parts and all(isinstance(part, str) for part in parts):
                return Path(*parts)
        return None

    @cached_property
    def checkpoint(self) -> Path:
        """The checkpoint of the latest step. Raises ``InputError`` if there is none."""
        parts = self.config.value("relative_model_dir")
        named = isinstance(parts, list) and bool(parts) and all(isinstance(part, str) for part in parts)
        folder = self.folder.joinpath(*parts) if named else self.folder / "nerfstudio_models"
        found = [(int(match[1]), path) for path in folder.glob("*.ckpt") if (match := STEP.fullmatch(path.name))]
        if not found:
            raise InputError("no step-*.ckpt", where=folder, expected="the checkpoint of a training run")
        return max(found)[1]

    def weights(self) -> tuple[dict[str, Tensor], int]:
        """Return the model's tensors by name, and the number of training steps. Raises ``InputError`` for damage."""
        found = read_saved(self.checkpoint, EXPECTED)
        tensors = found.get("pipeline") if isinstance(found, dict) else None
        if not isinstance(tensors, dict):
            raise InputError("contains no 'pipeline'", where=self.checkpoint, expected="a nerfstudio checkpoint")
        named = {
            name.removeprefix("module.").removeprefix(PREFIX): value
            for name, value in tensors.items()
            if isinstance(name, str) and isinstance(value, Tensor) and ".lpips." not in name
        }
        step = found.get("step")
        return named, step + 1 if type(step) is int and step >= 0 else 1

    def trained_from_data(self, data: Path | None) -> tuple[Similarity, str]:
        """Return the transform from dataset coordinates to training coordinates, and a sentence about it.

        ``data`` is the dataset, if it still exists. Without it, coordinates are those before
        ``applied_transform``, which the dataset may state; without the run's own file, they are training
        coordinates.
        """
        path = self.folder / TRANSFORMS
        if not path.is_file():
            return Similarity(1.0, SE3.identity()), (
                f"no {TRANSFORMS}, which older versions did not write: poses will be in training coordinates"
            )
        record = read_record(path, "the transform and the scale of nerfstudio's poses")
        scale = record.number("scale")
        if scale is None or not 1e-12 < scale < 1e12:
            raise record.error(f"scale is {scale}", expected="a number above 0")
        found = Similarity(scale, _moved(record, "transform", record.items("transform"), scale))
        if data is None:
            return found, (
                "poses will be in the coordinates of the original data, before any applied_transform: the"
                " dataset is not where the config says (`data`)"
            )
        applied = _applied(data)
        told = "poses will be in the coordinates of the dataset"
        if applied is None:
            return found, told
        return after(found, inverse(applied)), f"{told}, whose applied_transform is taken into account"


def read_run(path: Path) -> Run:
    """Read the run in a folder, or the one of a config.yml. Raises ``InputError`` for anything else."""
    folder = path.parent if path.name == CONFIG else path
    file = folder / CONFIG
    if not file.is_file():
        raise InputError(f"no {CONFIG}", where=path, expected=EXPECTED)
    # A config has about ten thousand bytes, and YAML is slow to parse.
    if file.stat().st_size > 4 * 2**20:
        raise InputError(f"has {file.stat().st_size:,} bytes", where=file, expected="a config of nerfstudio")
    text = read_file(file, "a config of nerfstudio").decode("utf-8", "replace")
    try:
        found = yaml.load(text, _PlainLoader)
    except (yaml.YAMLError, ValueError, TypeError, RecursionError) as error:
        reason = " ".join(str(error).split())[:120]
        raise InputError(f"not readable ({reason})", where=file, expected="a config of nerfstudio") from error
    if not isinstance(found, dict) or not isinstance(found.get("pipeline"), dict):
        raise InputError("has no pipeline", where=file, expected="a config of nerfstudio")
    return Run(folder, Record(str(file), found))


def _part(record: Record, key: str) -> Record:
    found = record.value(key)
    if not isinstance(found, dict):
        raise record.error(f"no {key}", expected="a config of nerfstudio")
    return Record(f"{record.where}: {key}", found)


def _moved(record: Record, key: str, rows: Any, scale: float) -> SE3:
    """Return the transform that has the same effect after scaling as that of ``rows`` has before it."""
    matrix = torch.tensor(record.matrix(key, rows), dtype=torch.float64)
    T = rigid_pose(matrix, record.where, f"the rotation of {key}")
    return SE3(T.rotation, scale * T.translation)


def _applied(data: Path) -> Similarity | None:
    """Return the transform applied to a dataset's poses before they were stored, or None if it states none."""
    file = data if data.suffix == ".json" else data / "transforms.json"
    if not file.is_file():
        return None
    record = read_record(file)
    scale = record.number("applied_scale") or 1.0
    rows = record.items("applied_transform")
    if rows is None and (data / "colmap" / "sparse" / "0").exists():
        rows = COLMAP
    if rows is not None:
        return Similarity(scale, _moved(record, "applied_transform", rows, scale))
    return None if scale == 1.0 else Similarity(scale, SE3.identity())
