"""Steps as CUDA graphs: all operations of a step in one launch.

A step of a few thousand rays is some hundreds of short operations. Launching each from Python takes longer than it computes;
a graph of them takes the device's time only. What may be recorded is what runs without waiting for the device (see
``waiting``), in the same shapes each time, on tensors that it writes in place.
"""

from __future__ import annotations

from collections.abc import Callable
from threading import Lock

import torch
from torch import Generator

WARM_UP = 3
"""Steps to take before one is recorded: caches are filled and kernels loaded in these, which a recording does not allow."""


_recording = Lock()
"""One recording at a time: it begins with waiting for all that the device does, which another recording forbids."""


def recorded(step: Callable[[], None], device: torch.device, generator: Generator) -> Callable[[], None]:
    """Return a function that does what ``step`` would: on a GPU, the replay of a graph of it, if it can be recorded.

    ``generator`` is that from which the step draws. Recording takes no step.
    """
    if device.type != "cuda":
        return step
    graph, before = torch.cuda.CUDAGraph(), generator.clone_state()
    graph.register_generator_state(generator)
    with _recording, torch.cuda.device(device):
        try:
            # Other threads may go on launching.
            with torch.cuda.graph(graph, capture_error_mode="thread_local"):
                step()
        except RuntimeError:  # it waits for the device somewhere, as a third party's field may
            generator.graphsafe_set_state(before)  # the other one expects to be recorded still
            return step
    return graph.replay
