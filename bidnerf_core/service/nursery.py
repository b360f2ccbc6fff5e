"""The process that loads the maps once and forks the workers, which share its memory.

It has a single thread, so that forks are safe, and it never handles a request: a worker that fails or is
stopped is replaced within milliseconds, with the maps as they were loaded. It ends, with all its workers,
when the service that started it ends.
"""

from __future__ import annotations

import contextlib
import gc
import os
import signal
import socket
import sys
from pathlib import Path
from typing import Any

from bidnerf_core.errors import InputError, InputWarning
from bidnerf_core.service import wire
from bidnerf_core.service.settings import ChosenMethod
from bidnerf_core.service.worker import Worker


def main() -> None:
    """Serve the socket whose descriptor is the program's argument."""
    control = socket.socket(fileno=int(sys.argv[1]))
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # the system then reaps workers that end
    request = wire.receive(control)
    if request is None:
        return
    worker = _prepared(control, request[0])
    if worker is not None:
        _fork_on_demand(control, worker)


def _prepared(control: socket.socket, order: dict[str, Any]) -> Worker | None:
    """Load the maps and report them, or the reason why they cannot be served."""
    import logging
    import warnings

    import cv2
    import torch

    logging.getLogger("bidnerf").addHandler(logging.NullHandler())
    warnings.simplefilter("ignore", InputWarning)
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    try:
        maps = {name: Path(folder) for name, folder in order["maps"].items()}
        method = ChosenMethod(order["name"], order["config"], order["device"])
        worker = Worker.load(maps, method, order["max_pixels"], Path(order["folder"]))
    except (InputError, OSError, RuntimeError, MemoryError) as error:
        wire.send(control, {"error": str(error) or type(error).__name__})
        return None
    gc.collect()
    gc.freeze()  # otherwise a collection in a worker would write to, and so copy, every page with an object
    wire.send(control, {"maps": worker.described})
    return worker


def _fork_on_demand(control: socket.socket, worker: Worker) -> None:
    while True:
        asked, descriptors, _, _ = socket.recv_fds(control, len(wire.ANOTHER), 1)
        if not asked:
            with contextlib.suppress(OSError):
                os.killpg(0, signal.SIGKILL)  # including those that are busy
            return
        if os.fork() == 0:
            control.close()
            signal.signal(signal.SIGCHLD, signal.SIG_DFL)
            status = 1
            try:
                worker.serve(socket.socket(fileno=descriptors[0]))
                status = 0
            finally:
                os._exit(status)
        for descriptor in descriptors:
            os.close(descriptor)


if __name__ == "__main__":
    main()
