"""Torch devices and threads: placement of tensors, waiting for a device, CUDA graphs, the number of CPU threads, and tasks on many."""

from __future__ import annotations

import copy
import warnings
import weakref
from collections import OrderedDict, abc, deque
from collections.abc import Callable, Hashable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, nullcontext
from contextvars import ContextVar
from dataclasses import fields, is_dataclass
from functools import lru_cache
from threading import Lock
from typing import Any, TypeVar, cast

import torch
from jaxtyping import Shaped
from torch import Generator, Tensor, nn
from torch.utils._pytree import tree_leaves

from bidnerf_core.errors import InputError
from bidnerf_core.progress import current_job

Value = TypeVar("Value")
_Rows = TypeVar("_Rows", bound="TensorRows")


# Constants as tensors. Each is created once per device, since its creation copies data from the host to the device.

_notes: list[list[Tensor]] = []


def constant(values: tuple[float, ...], like: Tensor) -> Shaped[Tensor, "n"]:
    """Return ``values`` with the dtype and device of ``like``. The result is shared: do not modify it."""
    found = _constant(values, like.dtype, like.device)
    for notes in _notes:
        notes.append(found)
    return found


@lru_cache(maxsize=256)
def _constant(values: tuple[float, ...], dtype: torch.dtype, device: torch.device) -> Tensor:
    with torch.inference_mode(False):
        return torch.tensor(values, dtype=dtype).to(device)


def forget() -> None:
    """Discard all constants and graphs, for instance when a device no longer exists."""
    _constant.cache_clear()
    _free.clear()


# Whether code may make the host wait for the device. On a GPU, each number that the host reads from a tensor,
# and each size that depends on values, blocks the host until the device has finished all queued work.
# Skipping needless computation is worth that wait in training and when whole images are rendered, but not in
# the short steps of a localization: there, code computes more than it needs, in shapes known in advance.

_allowed: ContextVar[bool] = ContextVar("waiting_allowed", default=True)


@contextmanager
def without_waiting() -> Iterator[None]:
    """Make ``may_wait`` return False for all devices but the CPU, in this thread and within the block."""
    token = _allowed.set(False)
    try:
        yield
    finally:
        _allowed.reset(token)


def may_wait(device: torch.device) -> bool:
    """Return whether code may read values from tensors on ``device``; always True for the CPU, which queues no work."""
    return device.type == "cpu" or _allowed.get()


# CUDA graphs. A localization or a training step consists of hundreds of short operations, each of which takes longer to
# launch from Python than to compute; a graph launches all of them at once. Work can be captured if it never waits
# for the device, has the same shapes each time, and reads and writes the same tensors. Numbers computed in Python
# keep their values from the capture.

_capturing = Lock()
"""Lock that allows one capture at a time: a capture begins by waiting for the device, which is forbidden while another runs."""
_sharing = Lock()
_free: dict[torch.device, list[_Lane]] = {}
"""The lanes of each device that no thread is using, with the most recently used lane at the end."""


class Resident:
    """Base class of objects that stay on their device, such as a map's surface; ``run_on`` does not move them."""


def capture_graph(
    step: Callable[[], None],
    device: torch.device,
    generator: Generator | None = None,
    memory: tuple[Any, torch.cuda.Stream] | None = None,
) -> Callable[[], None]:
    """Return a callable equivalent to ``step``; on a GPU, it replays a CUDA graph.

    ``generator`` is the generator from which ``step`` draws random numbers, if any. Capturing does not execute ``step``.
    If the capture fails, ``step`` itself is returned, with a warning. Run ``step`` once or twice before capturing it, since
    filling caches and loading kernels is not allowed during a capture. Graphs that are never replayed at the same time may
    share their temporary ``memory``: a pool, and the stream on which they are captured.
    """
    if device.type != "cuda":
        return step
    constants: list[Tensor] = []  # those requested during the capture, in any thread
    graph, before = torch.cuda.CUDAGraph(), None if generator is None else generator.clone_state()
    if generator is not None:
        graph.register_generator_state(generator)
    # If a capture fails, torch leaves the thread on the capture's stream; the outer context restores it.
    with _capturing, torch.cuda.device(device), torch.cuda.stream(torch.cuda.current_stream(device)):
        try:
            # Other threads may continue to launch operations.
            pool, stream = memory or graph_memory(device)
            _notes.append(constants)
            with torch.cuda.graph(graph, pool, stream, capture_error_mode="thread_local"):
                step()
        except RuntimeError as error:  # the step waits for the device somewhere, as a third-party field may
            if generator is not None and before is not None:
                generator.graphsafe_set_state(before)  # the registered one still expects a capture
            warnings.warn(
                "operations are launched one by one, since a step cannot be captured: " + str(error).partition("\n")[0],
                stacklevel=2,
            )
            return step
        finally:  # by identity, since two empty lists are equal
            _notes[:] = [notes for notes in _notes if notes is not constants]

    def replay(read: list[Tensor] = constants) -> None:  # keeps alive what the graph reads
        graph.replay()

    return replay


def graph_memory(device: torch.device) -> tuple[Any, torch.cuda.Stream]:
    """Return a pool for the temporary memory of graphs, and a stream on which to capture them."""
    # Torch hands out the same 32 streams per priority in turn. Captures use a separate priority, since whatever
    # another thread launches on the stream of a capture would become part of the graph.
    return torch.cuda.graph_pool_handle(), torch.cuda.Stream(device, priority=-1)


def wait_for(device: torch.device) -> None:
    """Wait until a GPU has finished all queued work, on any stream; does nothing for a CPU."""
    if device.type == "cuda":
        with _capturing:
            torch.cuda.synchronize(device)


def run_on(device: torch.device, function: Callable[..., Value], *values: Any) -> Value:
    """Return ``function(*values)``, computed on ``device``, with all tensors of the result on the CPU.

    Tensors in ``values`` are found as ``move_to`` finds them, except that modules and ``Resident`` objects must already be
    on the device. All CPU tensors are sent in one copy, and all results return in another, which is the only point at
    which the host waits. On a GPU, repeated calls with values of the same shapes replay a CUDA graph, so the
    function must not draw random numbers, nor let the contents of a tensor decide which operations it runs.
    """
    if device.type == "cpu":
        return function(*values)
    tensors: list[Tensor] = []
    key = (function, _structure(values, tensors))
    with _sharing:
        free = _free.setdefault(device, [])
        lane = next((lane for lane in reversed(free) if key in lane.remotes), free[-1] if free else None)
        if lane is None:
            lane = _Lane(device)
        else:
            free.remove(lane)
    try:
        if key not in lane.remotes:
            # Keys that refer to a field or a surface that no longer exists
            parts = {old: tree_leaves(old) for old in lane.remotes}
            for old in [old for old in parts if any(isinstance(p, weakref.ref) and p() is None for p in parts[old])]:
                del lane.remotes[old]
            lane.remotes[key] = _Remote(function, values, tensors, lane)
        lane.remotes.move_to_end(key)
        while len(lane.remotes) > 128:  # functions of different shapes; the least recently used is discarded
            lane.remotes.popitem(last=False)
        return cast(Value, lane.remotes[key](tensors))
    finally:
        with _sharing:
            free.append(lane)


class _Lane:
    """Functions on a device that only one thread calls at a time, so that their graphs can share memory."""

    def __init__(self, device: torch.device) -> None:
        self.device, self.remotes = device, OrderedDict[Hashable, _Remote]()
        self.memory = graph_memory(device) if device.type == "cuda" else None


class _Remote:
    """A function whose arguments are copied into fixed tensors on a device, as a CUDA graph requires."""

    def __init__(self, function: Callable[..., Any], values: Any, tensors: Sequence[Tensor], lane: _Lane) -> None:
        self._lane, self._calls, device = lane, 0, lane.device
        # Tensors of any dtype begin at multiples of 16 bytes in the common buffer.
        sizes = [-(-t.nbytes // 16) * 16 if t.device.type == "cpu" else 0 for t in tensors]
        self._sent = torch.empty(sum(sizes), dtype=torch.uint8, pin_memory=device.type == "cuda")
        self._received = torch.empty_like(self._sent, device=device)
        self._sources, self._arguments, first = list[Tensor](), list[Tensor](), 0
        for tensor, size in zip(tensors, sizes, strict=True):
            if tensor.device.type == "cpu":
                parts = (buffer[first : first + tensor.nbytes] for buffer in (self._sent, self._received))
                source, argument = (part.view(tensor.dtype).view(tensor.shape) for part in parts)
            else:
                source = argument = torch.empty_like(tensor)
            self._sources.append(source)
            self._arguments.append(argument)
            first += size

        template = _outline(values)

        def step() -> None:
            result = function(*_rebuild(template, iter(self._arguments)))
            parts: list[Tensor] = []
            _structure(result, parts)
            self._result, self._parts = _outline(result), parts
            self._bytes = torch.cat([part.reshape(-1).view(torch.uint8) for part in parts])

        self._step: Callable[[], None] = step

    @torch.no_grad()
    def __call__(self, tensors: Sequence[Tensor]) -> Any:
        for source, tensor in zip(self._sources, tensors, strict=True):
            source.copy_(tensor)
        self._received.copy_(self._sent, non_blocking=True)
        with without_waiting():
            if self._calls == 1:  # the first call fills caches, and may be the only one of its shape
                # During a capture, a thread cannot create what it uses for the first time, such as its handles for
                # linear algebra, and another thread may have made the first call.
                launched = self._step
                launched()
                self._step = capture_graph(launched, self._lane.device, memory=self._lane.memory)
                if self._step is launched and self._lane.memory:  # a failed capture leaves its pool unusable
                    self._lane.memory = graph_memory(self._lane.device)
            self._step()
        self._calls += 1
        shapes = zip(self._bytes.cpu().split([part.nbytes for part in self._parts]), self._parts, strict=True)
        return _rebuild(self._result, (b.clone().view(part.dtype).view(part.shape) for b, part in shapes))


def _structure(value: Any, tensors: list[Tensor]) -> Hashable:
    """Append the tensors in ``value`` to ``tensors``, and return a key of everything else that a graph depends on."""
    if isinstance(value, Tensor):
        tensors.append(value)
        return value.shape, value.dtype, value.device
    if isinstance(value, nn.Module | Resident):
        return weakref.ref(value)  # whose hash and equality are those of the value, which exists during the call
    if is_dataclass(value) and not isinstance(value, type):
        parts = (vars(value)[part.name] for part in fields(value) if part.name in vars(value))
        return type(value), *(_structure(part, tensors) for part in parts)
    if isinstance(value, dict):
        return dict, tuple(value), *(_structure(part, tensors) for part in value.values())
    if type(value) in (list, tuple):
        return type(value), *(_structure(part, tensors) for part in value)
    return cast(Hashable, value)


def _outline(value: Any) -> Any:
    """Return ``value`` with empty tensors and with weak references to fields and surfaces, so that no part of a map is kept alive."""
    return _map_parts(
        value, lambda part: torch.empty(0) if isinstance(part, Tensor) else weakref.ref(part), (nn.Module, Resident)
    )


def _rebuild(value: Any, tensors: Iterator[Tensor]) -> Any:
    """Return the value of an outline, whose tensors are, in order, the next ones from ``tensors``."""
    return _map_parts(value, lambda part: next(tensors) if isinstance(part, Tensor) else part(), (weakref.ref,))


# Objects that hold tensors.


class TensorRows:
    """Base class of dataclasses whose fields are tensors with a common first axis, which is indexed and has a length."""

    def __len__(self) -> int:
        return len(next(iter(vars(self).values())))

    def __getitem__(self: _Rows, index: Tensor | slice | None) -> _Rows:
        """Select rows by an index along the first axis or by a mask; None adds an axis of length 1."""
        return self.map(lambda part: part[index])

    def map(self: _Rows, change: Callable[[Tensor], Tensor]) -> _Rows:
        """Return the object with ``change`` applied to each tensor."""
        return type(self)(*(change(part) for part in vars(self).values()))

    @classmethod
    def joined(cls: type[_Rows], parts: Iterable[_Rows]) -> _Rows:
        """Concatenate the rows of ``parts``."""
        return cls(*map(torch.cat, zip(*(vars(part).values() for part in parts), strict=True)))


def working_device(device: torch.device | str) -> torch.device:
    """Return the named device after a test computation on it: a valid name does not mean that the device works here.

    Raises ``InputError`` if the device does not work.
    """
    try:
        found = torch.device(device)
        if found.type == "cpu" and found.index:  # torch ignores the number
            raise RuntimeError("there is only one CPU")
        torch.ones((), device=found).item()
    except (RuntimeError, AssertionError, TypeError) as error:  # depends on the build of torch
        raise InputError(
            f"device {str(device)!r} does not work here", expected="a working device such as cpu"
        ) from error
    return found


def move_to(value: Value, device: torch.device | str) -> Value:
    """Return ``value`` with every tensor in it on ``device``; ``value`` itself is not modified.

    Tensors are found in modules, in the fields of dataclasses, and in lists, tuples and dictionaries of
    these. Anything else stays the same object, as does ``value`` itself if it is already on ``device``.
    Values cached by a dataclass are recomputed on the device.
    """
    there = torch.device(device)

    def change(part: Any) -> Any:
        if isinstance(part, Tensor):
            return part if _is_on(part, there) else part.to(there)
        tensors = (*part.parameters(), *part.buffers())
        return part if all(_is_on(t, there) for t in tensors) else copy.deepcopy(part).to(there)

    return cast(Value, _map_parts(value, change, (nn.Module,)))


def _map_parts(value: Any, change: Callable[[Any], Any], whole: tuple[type, ...]) -> Any:
    """Return ``value`` with ``change`` applied to its tensors and its parts of the types ``whole``; ``value`` itself if none changes."""
    if isinstance(value, (Tensor, *whole)):
        return change(value)
    if is_dataclass(value) and not isinstance(value, type):
        parts = {part.name: vars(value)[part.name] for part in fields(value) if part.name in vars(value)}
        there = _map_parts(parts, change, whole)
        if there is parts:
            return value
        found = object.__new__(type(value))
        vars(found).update(there)  # also the fields that its constructor does not take
        return found
    if isinstance(value, dict):
        content = {key: _map_parts(part, change, whole) for key, part in value.items()}
        return content if any(content[key] is not value[key] for key in value) else value
    if type(value) in (list, tuple):
        items = [_map_parts(part, change, whole) for part in value]
        return value if all(new is old for new, old in zip(items, value, strict=True)) else type(value)(items)
    return value


def _is_on(tensor: Tensor, device: torch.device) -> bool:
    """Return whether a tensor is on ``device``; a device without an index matches any device of its type."""
    here = tensor.device
    return here.type == device.type and device.index in (None, here.index)


# Threads of torch's operators on a CPU.

_setting = Lock()


@contextmanager
def threads_at_most(count: int) -> Iterator[int]:
    """Run torch operators called from this Python thread on at most ``count`` threads within the block.

    Yields the number of threads used before the block. With a single thread, sums are the same on any machine.
    Other Python threads are not affected, and may enter such blocks as well.
    """
    usual = torch.get_num_threads()
    if usual > count:
        set_threads_here(count)
    try:
        yield usual
    finally:
        if usual > count:
            set_threads_here(usual)


def set_threads_here(count: int) -> None:
    """Set how many threads torch's operators use when called from this Python thread only.

    ``torch.set_num_threads`` also sets the number for Python threads that start later; this function restores
    that number.
    """
    with _setting:
        torch.get_num_threads()  # on first use, a thread takes the default, which would override a value set before
        default = _in_new_thread(torch.get_num_threads)
        torch.set_num_threads(count)
        _in_new_thread(lambda: torch.set_num_threads(default))


def _in_new_thread(function: Callable[[], Value]) -> Value:
    with ThreadPoolExecutor(1) as pool:
        return pool.submit(function).result()


AHEAD = 64
"""Number of tasks submitted ahead of the results, which bounds the memory of what runs them."""


def map_tasks(work: Callable[..., Value], tasks: Iterable[tuple[Any, ...]]) -> abc.Generator[Value, None, None]:
    """Yield ``work(*task)`` for each of the independent tasks, in order.

    The executor of this thread's job runs them (see ``job_context``), otherwise as many threads as torch uses. Other processes receive
    ``work`` and the tasks by pickle. Closing the generator cancels the tasks that wait.
    """
    executor = current_job().executor
    with ThreadPoolExecutor(max(1, torch.get_num_threads())) if executor is None else nullcontext(executor) as pool:
        waiting = deque[Future[Value]]()
        try:
            for task in tasks:
                waiting.append(pool.submit(work, *task))
                if len(waiting) > AHEAD:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            for future in waiting:
                future.cancel()
