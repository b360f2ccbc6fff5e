"""Reading of checkpoints. The architecture is inferred from the weights, since the accompanying config file
may differ.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torch import Tensor

from bidnerf_core.errors import InputError
from bidnerf_core.io import read_saved
from bidnerf_nerf_pytorch.network import Network, NetworkConfig

EXPECTED = "a nerf-pytorch checkpoint"
NETWORKS = {"coarse": "model_coarse_state_dict", "fine": "model_fine_state_dict"}
HIDDEN = re.compile(r"layers_xyz\.\d+\.weight")


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """Two networks of one architecture."""

    network: NetworkConfig
    tensors: dict[str, Tensor]  # named as in the field's state_dict
    steps: int  # of training


def is_checkpoint(path: Path) -> bool:
    """Return whether a file that ``torch.save`` wrote holds both networks. Raises ``InputError`` for another kind of file."""
    found = read_saved(path, EXPECTED, mapped=True)
    return isinstance(found, dict) and all(isinstance(found.get(key), dict) for key in NETWORKS.values())


def read_checkpoint(path: Path, octaves: bool = True) -> Checkpoint:
    """Read the networks in ``path``, without running any code in it.

    ``octaves`` is the only choice that the weights do not reveal. Raises a one-line ``InputError`` if there
    is no such file, it contains code or is not a nerf-pytorch checkpoint, the fine network is missing, or the
    architecture is unknown.
    """
    found = read_saved(path, EXPECTED)
    if not isinstance(found, dict) or not isinstance(found.get(NETWORKS["coarse"]), dict):
        raise InputError(f"contains no {NETWORKS['coarse']!r}", where=path, expected="a nerf-pytorch checkpoint")
    if not isinstance(found.get(NETWORKS["fine"]), dict):
        raise InputError("has no fine network", where=path, expected="a coarse and a fine one")
    kinds: dict[str, NetworkConfig] = {}
    tensors: dict[str, Tensor] = {}
    for level, key in NETWORKS.items():
        kinds[level] = _architecture(found[key], octaves, f"{path}: {level} network")
        tensors |= {f"{level}.network.{name}": value.float() for name, value in found[key].items()}
    if kinds["coarse"] != kinds["fine"]:
        raise InputError(f"the networks differ ({kinds['coarse']}; {kinds['fine']})", where=path, expected="equal ones")
    steps = found.get("iter")
    return Checkpoint(kinds["fine"], tensors, steps + 1 if type(steps) is int and steps >= 0 else 0)


def _architecture(tensors: dict[str, Any], octaves: bool, where: str) -> NetworkConfig:
    """Infer the architecture from the shapes, after checking that such a network has exactly these tensors."""
    shapes = {name: tuple(getattr(value, "shape", ())) for name, value in tensors.items()}
    width, seen = _sizes(shapes.get("layer1.weight"), where)
    inputs = [shapes.get(f"layers_xyz.{i}.weight", ()) for i in range(sum(map(_is_hidden, shapes)))]
    turned = (width + 27, *shapes.get("layers_dir.0.weight", ()))[-1] - width
    skips = tuple(i for i, shape in enumerate(inputs, 1) if shape[-1:] == (width + seen,))
    frequencies = *_frequencies(seen, where), *_frequencies(turned, where)
    try:
        network = NetworkConfig(1 + len(inputs), width, skips, *frequencies, octaves, "fc_out.weight" not in shapes)
    except InputError as error:
        raise InputError(f"unknown architecture, {error}", where=where) from error
    _check(tensors, shapes, Network(network), where)
    return network


def _is_hidden(name: str) -> bool:
    return HIDDEN.fullmatch(name) is not None


def _sizes(shape: tuple[int, ...] | None, where: str) -> tuple[int, int]:
    if shape is None or len(shape) != 2:
        raise InputError("unknown architecture without 'layer1.weight'", where=where, expected="FlexibleNeRFModel")
    return shape[0], shape[1]


def _frequencies(width: int, where: str) -> tuple[int, bool]:
    """Return the number of frequencies of an encoding of length ``width``, and whether it includes the input itself."""
    if width < 3 or width % 3:
        raise InputError(f"unknown architecture, {width} inputs where a multiple of 3 was expected", where=where)
    return width // 6, width // 3 % 2 == 1


def _check(tensors: dict[str, Any], shapes: dict[str, tuple[int, ...]], network: Network, where: str) -> None:
    expected = {name: tuple(value.shape) for name, value in network.state_dict().items()}
    for name in sorted(expected.keys() | shapes.keys()):
        found, wanted = shapes.get(name, "nothing"), expected.get(name, "nothing")
        if found != wanted:
            raise InputError(f"unknown architecture, {name!r} is {found}", where=where, expected=wanted)
        value = tensors[name]
        if not (value.is_floating_point() and bool(value.isfinite().all())):
            raise InputError(f"{name!r} has values that are not finite numbers", where=where)
