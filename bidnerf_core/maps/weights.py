"""Checking the weights of a map against its field."""

from __future__ import annotations

from pathlib import Path
from typing import cast

from torch import Tensor, nn

from bidnerf_core.backend import UpgradingField
from bidnerf_core.errors import InputError
from bidnerf_core.fields import RadianceField

LARGEST_WEIGHT = 1e9
"""Limit of a field's parameters, beyond which products would overflow in float32; trained ones stay far below it."""


def checked_weights(field: RadianceField, tensors: dict[str, Tensor], path: Path) -> dict[str, Tensor]:
    """Return a field's tensors from a file, checked, and upgraded if an earlier version stored them.

    Their names, shapes and values are checked against the field here, since torch's own message would take
    many lines.
    """
    if isinstance(field, UpgradingField):
        tensors = field.upgraded_state(tensors)
    module = cast(nn.Module, field)
    expected = module.state_dict()
    for name, value in expected.items():
        if name not in tensors:
            raise InputError(f"no tensor {name!r}", where=path, expected=f"one of shape {list(value.shape)}")
        if tensors[name].shape != value.shape:
            found, wanted = list(tensors[name].shape), list(value.shape)
            raise InputError(f"tensor {name!r} has shape {found}", where=path, expected=wanted)
        if tensors[name].is_floating_point() != value.is_floating_point():
            kinds = (str(kind).removeprefix("torch.") for kind in (tensors[name].dtype, value.dtype))
            raise InputError(f"tensor {name!r} has dtype {next(kinds)}", where=path, expected=next(kinds))
    surplus = sorted(tensors.keys() - expected.keys())
    if surplus:
        raise InputError(
            f"tensor {surplus[0]!r} is not part of the field that map.json describes", where=path
        )
    for name, _ in module.named_parameters():
        if name in tensors and not bool((tensors[name].abs() <= LARGEST_WEIGHT).all()):
            raise InputError(
                f"tensor {name!r} holds NaN, infinity or numbers above {LARGEST_WEIGHT:g}",
                where=path,
                expected="trained weights",
            )
    for name, _ in module.named_buffers():
        if name in tensors and bool(tensors[name].isnan().any()):
            raise InputError(f"tensor {name!r} holds NaN", where=path, expected="numbers")
    return tensors
