"""The tensors of nerfstudio's models under the names of the networks here, and the sizes implied by their shapes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor, nn

from bidnerf_core.errors import InputError
from bidnerf_nerfstudio.networks import HashConfig

TCNN = (
    "was trained with tiny-cuda-nn, whose networks cannot be read here; train with"
    " --pipeline.model.implementation torch"
)


@dataclass(frozen=True, eq=False)
class Weights:
    """Tensors by nerfstudio's names."""

    path: Path  # for messages
    tensors: Mapping[str, Tensor]

    def __post_init__(self) -> None:
        packed = [name for name in self.tensors if name.endswith(".params")]
        if packed:
            raise InputError(f"{TCNN} ({packed[0]!r})", where=self.path)

    def error(self, found: str, expected: str | None = None) -> InputError:
        return InputError(found, where=self.path, expected=expected)

    def get(self, name: str) -> Tensor:
        """Return a tensor of finite numbers, in single precision."""
        found = self.tensors.get(name)
        if found is None:
            raise self.error(f"no {name!r}", expected="a checkpoint of the model that the config names")
        if found.is_floating_point() and not bool(found.isfinite().all()):
            raise self.error(f"{name!r} has values that are not finite numbers")
        return found.float()

    def number(self, name: str) -> int:
        """Return an integer stored as a tensor."""
        found = self.get(name)
        if found.numel() != 1:
            raise self.error(f"{name!r} is {tuple(found.shape)}", expected="one number")
        return int(found)

    def layers(self, prefix: str) -> list[str]:
        """Return the name prefixes of a network's layers, in order."""
        names: list[str] = []
        while f"{prefix}layers.{len(names)}.weight" in self.tensors:
            names.append(f"{prefix}layers.{len(names)}.")
        if not names:
            raise self.error(
                f"no '{prefix}layers.0.weight'", expected="a checkpoint of the model that the config names"
            )
        return names

    def shape(self, name: str, dimensions: int) -> tuple[int, ...]:
        """Return the shape of a tensor with that many dimensions."""
        shape = tuple(self.get(name).shape)
        if len(shape) != dimensions:
            raise self.error(f"{name!r} is {shape}", expected=f"{dimensions} dimensions")
        return shape

    def hash_config(self, field: str, table: str, layers: list[str], base: int) -> HashConfig:
        """Return the sizes of a hash encoding and of the layers that follow it; ``field`` is the prefix of
        its numbers.
        """
        rows, features = self.shape(table, 2)
        levels, log2 = self.number(f"{field}num_levels"), self.number(f"{field}log2_hashmap_size")
        if not (1 <= levels <= 64 and 1 <= log2 <= 30 and rows == levels * 2**log2):
            raise self.error(f"{table!r} has {rows:,} rows", expected=f"{levels} tables of 2 to the power of {log2}")
        width = self.shape(f"{layers[0]}weight", 2)[0] if len(layers) > 1 else 1
        return HashConfig(levels, features, log2, base, self.number(f"{field}max_res"), width, len(layers))

    def renamed(self, names: Mapping[str, str]) -> dict[str, Tensor]:
        """Return the tensors named by the values of ``names`` under the keys."""
        return {ours: self.get(theirs) for ours, theirs in names.items()}

    def load(self, field: nn.Module, state: dict[str, Tensor]) -> dict[str, Tensor]:
        """Load the tensors into a field and return its whole state. Raises ``InputError`` if shapes differ."""
        expected = field.state_dict()
        for name, value in expected.items():
            if name not in state:
                raise self.error(f"nothing for {name!r} in it", expected=tuple(value.shape))
            if state[name].shape != value.shape:
                raise self.error(f"{name!r} is {tuple(state[name].shape)}", expected=tuple(value.shape))
        field.load_state_dict({name: state[name].to(value.dtype) for name, value in expected.items()})
        return {name: value.detach() for name, value in field.state_dict().items()}


def layer_names(ours: str, theirs: list[str]) -> dict[str, str]:
    """Map the names of weights and biases here, which begin with ``ours``, to nerfstudio's."""
    return {
        f"{ours}layers.{number}.{part}": f"{prefix}{part}"
        for number, prefix in enumerate(theirs)
        for part in ("weight", "bias")
    }


def mean_code(weights: Weights, name: str, mean: bool) -> Tensor:
    """Return the appearance code with which nerfstudio renders: the mean over its images, or zeros."""
    codes = weights.get(name)
    if codes.dim() != 2 or not len(codes):
        raise weights.error(f"{name!r} is {tuple(codes.shape)}", expected="a code for each image")
    return codes.mean(0) if mean else torch.zeros(codes.shape[1])
