"""Steps as CUDA graphs: all operations of a step in one launch.

A step of a few thousand rays consists of some hundreds of short operations, each of which takes longer to launch from Python
than to compute; a graph launches all of them at once. A step can be captured if it never waits for the device (see
``devices.without_waiting``), has the same shapes each time, and writes its results into existing tensors. Numbers computed in
Python keep the value that they had during the capture.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from threading import Lock

import torch
from torch import Generator, Tensor

from bidnerf_core.devices import noted

WARM_UP = 3
"""Steps to take before one is captured: caches are filled and kernels loaded in these, which a capture does not allow."""
_capturing = Lock()
"""Allows one capture at a time: a capture begins by waiting for the device, which another capture forbids."""


@dataclass(frozen=True, eq=False)
class _Replay:
    graph: torch.cuda.CUDAGraph
    constants: list[Tensor]  # kept alive here, since the graph reads them

    def __call__(self) -> None:
        self.graph.replay()


def captured(step: Callable[[], None], device: torch.device, generator: Generator) -> Callable[[], None]:
    """Return a function that does what ``step`` does: on a GPU, by replaying a graph of it, if it can be captured.

    ``generator`` is the one from which the step draws. Capturing takes no step. A step that cannot be captured is returned as
    it is, with a warning.
    """
    if device.type != "cuda":
        return step
    graph, before = torch.cuda.CUDAGraph(), generator.clone_state()
    graph.register_generator_state(generator)
    # Where a capture fails, torch leaves the thread on the stream of the capture; the outer context sets it back.
    with _capturing, torch.cuda.device(device), torch.cuda.stream(torch.cuda.current_stream(device)):
        try:
            # Each device has a stream of its own. Other threads may go on launching.
            stream = torch.cuda.Stream(device)
            with (
                noted() as constants,
                torch.cuda.graph(graph, stream=stream, capture_error_mode="thread_local"),
            ):
                step()
        except RuntimeError as error:  # it waits for the device somewhere, as a third party's field may
            generator.graphsafe_set_state(before)  # the registered one still expects a capture
            why = str(error).partition("\n")[0]
            warnings.warn(
                f"steps are launched one operation after the other, since one cannot be captured: {why}",
                stacklevel=2,
            )
            return step

    return _Replay(graph, constants)
