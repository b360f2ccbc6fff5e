"""A simulated device, with which any machine can test that code neither copies between devices nor waits for a device.

Tensors on the device "meta" stand in for those on a GPU. While ``Elsewhere`` is active, their
values are stored and computed on the CPU, so that code runs as it would on a GPU; but operations that mix tensors
of both devices, which a GPU does not allow, raise ``DeviceFault``. Within ``strict``, so does any operation
that makes the host wait for the device: copies to and from the CPU, reading numbers from a tensor (``float``,
``bool``, ``item``, ``tolist``), and sizes that depend on values (``nonzero``, indexing by a mask). Outside
``strict``, these operations are counted. ``check_steps`` checks that the steps of a localization can stay on the field's device.
"""

from __future__ import annotations

import contextlib
import copy
import sys
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from functools import cache
from typing import Any, cast
from unittest.mock import patch

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from bidnerf.testing import SCENE_BOUNDS, MapWithLandmarks, rgbd_views
from bidnerf_bid import (
    AdamSettings,
    AdamSteps,
    BidConfig,
    DepthSettings,
    DescentSettings,
    SampledLoss,
    objective_of,
    pivot,
)
from bidnerf_core import devices
from bidnerf_core.devices import move_to, without_waiting
from bidnerf_core.fields import RadianceField, levels
from bidnerf_core.localization import (
    ColourSettings,
    DepthLossSettings,
    Problem,
    draw_rays,
    rig,
    states_at,
)
from bidnerf_core.mapping import descend
from optional import require

DEVICE = torch.device("meta")
"""The simulated device."""

_aten = torch.ops.aten
_adam: Any = sys.modules[torch.optim.Adam.__module__]
READS = {
    **dict.fromkeys(("_local_scalar_dense", "is_nonzero"), "reads a number"),
    "equal": "reads whether tensors are equal",
    **dict.fromkeys(
        (
            "nonzero",
            "masked_select",
            "_unique2",
            "unique_dim",
            "unique_consecutive",
            "repeat_interleave",
            "bincount",
        ),
        "has a size that depends on values",
    ),
    **dict.fromkeys(
        ("_linalg_svd", "_linalg_eigh", "_linalg_solve_ex", "linalg_cholesky", "linalg_lstsq"),
        "is a factorization that waits for the device",
    ),
}
"""Operations that make the host wait, by name, with the reason for each."""
INDEXED = ("index", "index_put", "index_put_", "_index_put_impl_", "_unsafe_index")
"""Operations with indices, which may be masks."""


class DeviceFault(AssertionError):
    """Raised if an operation mixes tensors on the device with those on the CPU and, in strict use, if code waits for the device."""


class _There(torch.Tensor):
    """A tensor that reports ``DEVICE`` as its device and keeps its values in a tensor on the CPU."""

    host_values: Tensor

    @staticmethod
    def __new__(cls, values: Tensor) -> _There:
        made: _There = torch.Tensor._make_wrapper_subclass(
            cls,
            values.size(),
            strides=values.stride(),
            storage_offset=values.storage_offset(),
            dtype=values.dtype,
            layout=values.layout,
            device=DEVICE,
        )
        made.host_values = values
        return made

    def __init__(self, values: Tensor) -> None:
        pass

    def tolist(self) -> Any:
        return self.cpu().tolist()

    def numpy(self, *, force: bool = False) -> Any:
        return self.cpu().numpy(force=force)

    def new_tensor(self, data: Any, *args: Any, **options: Any) -> Tensor:
        return torch.tensor(data, dtype=options.pop("dtype", self.dtype), **options).to(DEVICE)

    @classmethod
    def __torch_dispatch__(  # type: ignore[override]
        cls, func: Any, types: Any, args: Any = (), kwargs: Any = None
    ) -> Any:
        return _run(func, args, kwargs or {}, None)


class Elsewhere(TorchDispatchMode):
    """A context that makes ``DEVICE`` usable. Outside ``strict()``, tensors may be moved between devices and read, but not mixed.

    ``waits`` counts, by operation, how often the host waited for the device.
    """

    def __init__(self) -> None:
        super().__init__()
        self.waits = Counter[str]()
        self._strict = False

    def __enter__(self) -> Any:
        devices.forget()
        self._patches = contextlib.ExitStack()
        self._patches.callback(devices.forget)
        self._patches.enter_context(patch.object(torch, "Generator", _generator_of(torch.Generator)))
        self._patches.enter_context(patch.object(_adam, "_device_dtype_check_for_fused"))
        return super().__enter__()

    def __exit__(self, *exception: Any) -> None:
        super().__exit__(*exception)
        self._patches.close()

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
    flat = _leaves((*args, *kwargs.values()))
    there = any(isinstance(part, _There) for part in flat)
    wanted = None if kwargs.get("device") is None else torch.device(kwargs["device"]).type
    if any(isinstance(part, Tensor) and part.is_meta and not isinstance(part, _There) for part in flat):
        raise DeviceFault("a tensor was made of the host's numbers on the device, as torch.tensor(..., device=...)")
    if not there and wanted != DEVICE.type:
        return func(*args, **kwargs)
    name, is_returned, outputs = _signature(func)
    if mode is not None and (fault := _waiting(name, args, flat, there, wanted)) is not None:
        if mode._strict:
            raise DeviceFault(fault)
        mode.waits[name] += 1
    # PyTorch itself moves tensors without dimensions, and the indices of a tensor on the device.
    indexed = name in INDEXED and isinstance(args[0], _There)
    here = [part for part in _on_cpu(_leaves(args[2:]) if indexed else flat) if part.ndim > 0]
    if there and here and name not in ("_to_copy", "copy_"):
        shapes = ", ".join(str(tuple(part.shape)) for part in here)
        raise DeviceFault(f"{name} mixes devices: a tensor of shape {shapes} is on the CPU")
    if wanted == DEVICE.type or func is _aten._to_copy.default:
        kwargs = kwargs | {"device": torch.device("cpu")}
    found = func(
        *[_each(_values_of, part) for part in args], **{key: _each(_values_of, part) for key, part in kwargs.items()}
    )
    if wanted == "cpu":
        return found.clone() if isinstance(found, Tensor) else found
    # A result that is written in place is the argument itself.
    written = [args[index] if index < len(args) else kwargs.get(key) for index, key in outputs]
    if written and is_returned:
        return written[0] if len(func._schema.returns) == 1 else tuple(written)
    return _each(lambda part: _There(part) if type(part) is Tensor else part, found)


@cache
def _signature(func: Any) -> tuple[str, bool, list[tuple[int, str]]]:
    """Return the name of an operation, whether it returns anything, and the positions and names of the arguments it writes."""
    schema = func._schema
    outputs = [
        (index, argument.name)
        for index, argument in enumerate(schema.arguments)
        if argument.alias_info is not None and argument.alias_info.is_write
    ]
    return schema.name.removeprefix("aten::"), bool(schema.returns), outputs


def _leaves(parts: Iterable[Any]) -> list[Any]:
    """Return an operation's arguments with lists, which are never nested, flattened; far faster than PyTorch's ``tree_leaves``."""
    return [leaf for part in parts for leaf in (part if isinstance(part, list | tuple) else (part,))]


def _each(change: Callable[[Any], Any], part: Any) -> Any:
    """Return ``change`` applied to an argument or result, or to each element if it is a list or tuple."""
    return type(part)([change(each) for each in part]) if isinstance(part, list | tuple) else change(part)


def _values_of(part: Any) -> Any:
    return part.host_values if isinstance(part, _There) else part


def _on_cpu(parts: Iterable[Any]) -> list[Tensor]:
    return [part for part in parts if isinstance(part, Tensor) and not isinstance(part, _There)]


def _waiting(name: str, args: Any, flat: list[Any], there: bool, wanted: str | None) -> str | None:
    """Return the reason why an operation makes the host wait for the device or copies between the two; None if it does neither."""
    if there and name in READS:
        return f"{name} {READS[name]}: the host waits for the device"
    if name == "copy_":
        return "copy_ copies between devices" if _on_cpu(flat) else None
    if name == "_to_copy":
        moves = there != ((wanted or args[0].device.type) == DEVICE.type)
        return f"a tensor of shape {tuple(args[0].shape)} is copied between devices" if moves else None
    if name not in INDEXED:
        return None
    if any(index is not None and index.dtype == torch.bool for index in args[1]):
        return "an index by a mask has a size that depends on values: the host waits for the device"
    if there and any(part.ndim > 0 for part in _on_cpu(flat)):
        return f"{name} copies an index between devices"
    return None


def _generator_of(kind: Any) -> Any:
    """Return a stand-in for the generator class ``kind``, whose instances PyTorch cannot create on ``DEVICE``.

    For ``DEVICE``, the stand-in creates a generator on the CPU that reports ``DEVICE`` as its device; for any other device, it
    creates an instance of ``kind``.
    """

    class SimulatedGenerator(kind):
        def __new__(cls, device: Any = "cpu") -> Any:
            is_simulated = torch.device(device).type == DEVICE.type
            return super().__new__(cls) if is_simulated else kind(device)

        @property
        def device(self) -> torch.device:
            return DEVICE

    return SimulatedGenerator


# Steps.

CHECKED_RAYS = 48


def check_steps(field: RadianceField) -> None:
    """Check that localization steps at each level stay on the device and reach the same pose as on the CPU.

    The steps must neither copy between devices nor wait for one. The device is simulated.
    Fields without parameters and buffers have no device and pass.
    """
    for number in range(len(levels(field))):
        expected = _first_order(_problem(field), number, None)
        who = f"{type(field).__name__}, level {number}"
        with Elsewhere() as mode:
            there: Any = cast(Any, copy.deepcopy(field)).to(DEVICE)
            problem = _problem(there)
            if problem.device != DEVICE:
                return
            try:
                step = "a step of Adam"
                found = _first_order(problem, number, mode)
                step = "a step of Levenberg-Marquardt"
                _second_order(problem, number, mode)
            except DeviceFault as fault:
                reason = f"{fault}; expected all of it on the field's device, in shapes that are known"
                raise AssertionError(f"{who}: {step}: {reason}") from fault
        other = "steps on another device lead to a different pose than on the CPU; is some state not moved?"
        assert torch.allclose(found, expected, rtol=0, atol=1e-3), f"{who}: {other}"


class StaysOnDevice:
    """A test for classes of ``BackendContract``: the steps of a localization in a trained field stay on its device."""

    def test_steps_stay_on_the_device(self) -> None:
        check_steps(cast(Any, self)._trained())


def _problem(field: RadianceField) -> Problem:
    view = rgbd_views(coverage=False)[0]
    # Steps begin at this tangent vector (metres, radians) from the true pose.
    off = torch.tensor((0.05, -0.03, 0.04, 0.01, -0.02, 0.01), dtype=torch.float64)
    start = view.T_ref_camera.to("cpu", torch.float64).retract(off)
    return rig(MapWithLandmarks(field, SCENE_BOUNDS, None), [view], start)


def _first_order(problem: Problem, level: int, mode: Elsewhere | None) -> Tensor:
    """Return the pose (4 4) after two steps of Adam: the first fills caches, and the second must stay on the device."""
    device, start = problem.device, require(problem.start)
    objective = objective_of(ColourSettings(), DepthSettings(depth_scale=0.1))
    settings = DescentSettings(CHECKED_RAYS, level=level)
    generator = torch.Generator(device).manual_seed(0)
    loss = SampledLoss(move_to(problem, problem.device), objective, 0, settings, BidConfig().reach, generator)
    steps = AdamSteps(loss, pivot("scene", problem), AdamSettings(), start.to(device))
    with without_waiting():
        steps()
        with contextlib.nullcontext() if mode is None else mode.strict():
            steps()
    return steps.T.to("cpu").matrix()


def _second_order(problem: Problem, level: int, mode: Elsewhere) -> None:
    rays = draw_rays(problem, ColourSettings(), DepthLossSettings(), CHECKED_RAYS, 0, levels(problem.field)[level])
    start = move_to(states_at(require(problem.start)[None]), DEVICE)
    with without_waiting():
        descend(start, [rays], 1)
        with mode.strict():
            descend(start, [rays], 2)
