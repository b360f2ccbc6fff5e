"""A simulated device, which proves on any machine that code neither copies between devices nor waits for one.

Tensors on the device "meta" stand in for those on a GPU. While ``Elsewhere`` is active they have values,
which are stored and computed on the CPU, so that code runs as it would on a GPU; but operations on tensors of
both devices, which a GPU does not allow, raise ``DeviceFault``. Within ``strict``, so does anything that
makes the host wait for the device: copies to and from the CPU, reading numbers from a tensor (``float``,
``bool``, ``item``, ``tolist``), and sizes that depend on values (``nonzero``, indexing by a mask). Elsewhere,
these are counted.
"""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from bidnerf_core import devices

DEVICE = torch.device("meta")
"""The simulated device."""

_aten = torch.ops.aten
_adam: Any = sys.modules[torch.optim.Adam.__module__]
READS = {
    "_local_scalar_dense": "reads a number",
    "is_nonzero": "reads a number",
    "equal": "reads whether tensors are equal",
    "nonzero": "has a size that depends on values (nonzero, or a mask as an index)",
    "masked_select": "has a size that depends on values",
    "_unique2": "has a size that depends on values",
    "unique_dim": "has a size that depends on values",
    "unique_consecutive": "has a size that depends on values",
    "repeat_interleave": "has a size that depends on values",
    "bincount": "has a size that depends on values",
    "_linalg_svd": "is a factorization that waits for the device",
    "_linalg_eigh": "is a factorization that waits for the device",
    "_linalg_solve_ex": "is a factorization that waits for the device",
    "linalg_cholesky": "is a factorization that waits for the device",
    "linalg_lstsq": "is a factorization that waits for the device",
}
"""Operations that make the host wait, by name."""
INDEXED = ("index", "index_put", "index_put_", "_index_put_impl_", "_unsafe_index")
"""Operations with indices, which may be masks."""


class DeviceFault(AssertionError):
    """Code waited for the device, copied from or to it, or mixed it with the CPU."""


class _There(torch.Tensor):
    """A tensor that claims to be on ``DEVICE`` and keeps its values in a tensor on the CPU."""

    held: Tensor

    @staticmethod
    def __new__(cls, values: Tensor) -> _There:
        made: _There = torch.Tensor._make_wrapper_subclass(
            cls, values.size(), strides=values.stride(), storage_offset=values.storage_offset(),
            dtype=values.dtype, layout=values.layout, device=DEVICE,
        )  # fmt: skip
        made.held = values
        return made

    def __init__(self, values: Tensor) -> None:
        pass

    def tolist(self) -> Any:
        return self.cpu().tolist()

    def numpy(self, *, force: bool = False) -> Any:
        return self.cpu().numpy(force=force)

    def new_tensor(self, data: Any, *args: Any, **options: Any) -> Tensor:
        return torch.tensor(data, dtype=options.pop("dtype", self.dtype), **options).to(DEVICE)

    def __repr__(self) -> str:  # type: ignore[override]
        return f"elsewhere({self.held!r})"

    @classmethod
    def __torch_dispatch__(  # type: ignore[override]
        cls, func: Any, types: Any, args: Any = (), kwargs: Any = None
    ) -> Any:
        return _run(func, args, kwargs or {}, None)


class Elsewhere(TorchDispatchMode):
    """Makes ``DEVICE`` usable. Outside ``strict()``, tensors may be moved between devices and read, but not mixed.

    ``waits`` counts, by operation, how often the host waited for the device.
    """

    def __init__(self) -> None:
        super().__init__()
        self.waits = Counter[str]()
        self._strict = False

    def __enter__(self) -> Any:
        devices.forget()
        self._generator = torch.Generator
        torch.Generator = _generator_of(torch.Generator)  # type: ignore[misc]
        self._check = _adam._device_dtype_check_for_fused
        _adam._device_dtype_check_for_fused = lambda *_, **__: None
        return super().__enter__()

    def __exit__(self, *exception: Any) -> None:
        super().__exit__(*exception)
        torch.Generator = self._generator  # type: ignore[misc]
        _adam._device_dtype_check_for_fused = self._check
        devices.forget()

    @contextmanager
    def strict(self) -> Iterator[None]:
        """Raise ``DeviceFault`` for anything that would make a GPU and its host wait for each other."""
        self._strict = True
        try:
            yield
        finally:
            self._strict = False

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _run(func, args, kwargs or {}, self)


def _run(func: Any, args: Any, kwargs: dict[str, Any], mode: Elsewhere | None) -> Any:
    flat = _leaves((args, kwargs))
    there = any(isinstance(part, _There) for part in flat)
    asked = kwargs.get("device")
    wanted = None if asked is None else torch.device(asked)
    made_there = wanted is not None and wanted.type == DEVICE.type
    if any(isinstance(part, Tensor) and part.is_meta and not isinstance(part, _There) for part in flat):
        raise DeviceFault(
            "a tensor was made of the host's numbers on the device, as torch.tensor(..., device=...)"
        )
    if not there and not made_there:
        return func(*args, **kwargs)
    if mode is not None and (fault := _waiting(func, args, flat, there, wanted)) is not None:
        if mode._strict:
            raise DeviceFault(fault)
        mode.waits[func._schema.name.removeprefix("aten::")] += 1
    _check_mixing(func, args, flat, there)
    if made_there or func is _aten._to_copy.default:
        kwargs = kwargs | {"device": torch.device("cpu")}
    plain_args, plain_kwargs = _mapped(_values, (args, kwargs))
    found = func(*plain_args, **plain_kwargs)
    to_host = wanted is not None and wanted.type == "cpu"
    if to_host:
        return found.clone() if isinstance(found, Tensor) else found
    return _wrapped(func, args, kwargs, found)


def _wrapped(func: Any, args: Any, kwargs: dict[str, Any], found: Any) -> Any:
    """Return results as tensors on ``DEVICE``; a result written in place is the argument itself."""
    schema = func._schema
    aliases = [
        (args[place] if place < len(args) else kwargs.get(argument.name))
        for place, argument in enumerate(schema.arguments)
        if argument.alias_info is not None and argument.alias_info.is_write
    ]
    if aliases and schema.returns:
        return aliases[0] if len(schema.returns) == 1 else tuple(aliases)
    return _mapped(lambda part: _There(part) if type(part) is Tensor else part, found)


def _waiting(func: Any, args: Any, flat: list[Any], there: bool, wanted: torch.device | None) -> str | None:
    """Return why an operation makes the host wait for the device, or copies between them; None if it does neither."""
    name = func._schema.name.removeprefix("aten::")
    if there and name in READS:
        return f"{name} {READS[name]}: the host waits for the device"
    here = [part for part in flat if isinstance(part, Tensor) and not isinstance(part, _There)]
    if name in ("_to_copy", "copy_"):
        target = wanted.type if wanted is not None else args[0].device.type
        if name == "copy_" and here:
            return "copy_ copies between devices"
        if name == "_to_copy" and there != (target == DEVICE.type):
            return f"a tensor of shape {tuple(args[0].shape)} is copied between devices"
        return None
    if name in INDEXED and any(i is not None and i.dtype == torch.bool for i in args[1]):
        return "an index by a mask has a size that depends on values: the host waits for the device"
    if there and name in INDEXED and any(part.ndim > 0 for part in here):
        return f"{name} copies an index between devices"
    return None


def _check_mixing(func: Any, args: Any, flat: list[Any], there: bool) -> None:
    """Raise ``DeviceFault`` for tensors of both devices in one operation.

    Exempt is what PyTorch moves by itself: numbers, and the indices of a tensor on the device.
    """
    name = func._schema.name.removeprefix("aten::")
    if not there or name in ("_to_copy", "copy_"):
        return
    if name in INDEXED and isinstance(args[0], _There):
        flat = _leaves(args[2:])
    here = [part for part in flat if isinstance(part, Tensor) and not isinstance(part, _There)]
    if any(part.ndim > 0 for part in here):
        shapes = ", ".join(str(tuple(part.shape)) for part in here if part.ndim > 0)
        raise DeviceFault(f"{name} mixes devices: a tensor of shape {shapes} is on the CPU")


def _leaves(parts: Any) -> list[Any]:
    """Return the leaves of nested lists, tuples and dictionaries."""
    found: list[Any] = []
    for part in parts.values() if isinstance(parts, dict) else parts:
        if isinstance(part, list | tuple | dict):
            found += _leaves(part)
        else:
            found.append(part)
    return found


def _mapped(function: Callable[[Any], Any], parts: Any) -> Any:
    """Return ``parts`` with ``function`` applied to the leaves, see ``_leaves``. PyTorch's pytrees are slower."""
    if isinstance(parts, dict):
        return {key: _mapped(function, part) for key, part in parts.items()}
    if isinstance(parts, list | tuple):
        return type(parts)([_mapped(function, part) for part in parts])
    return function(parts)


def _values(part: Any) -> Any:
    return part.held if isinstance(part, _There) else part


def _generator_of(kind: Any) -> Any:
    """Return a subclass of the generators' class whose instances may claim to be on ``DEVICE``."""

    class There(kind):
        def __new__(cls, device: Any = "cpu") -> Any:
            elsewhere = torch.device(device).type == DEVICE.type
            return super().__new__(cls) if elsewhere else kind(device)

        def __init__(self, device: Any = "cpu") -> None:
            pass

        @property
        def device(self) -> torch.device:
            return DEVICE

    return There
