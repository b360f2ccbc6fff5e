"""The process that loads the maps once, and the workers forked from it, which share its memory and localize photos.

The loading process has a single thread, so that forking is safe, and it never handles a request. A worker that fails
or is killed is replaced by a fork within milliseconds, and workers share memory only for reading.
"""

from __future__ import annotations

import contextlib
import gc
import json
import os
import pickle
import signal
import socket
import sys
from collections.abc import Mapping
from io import BufferedRWPair
from pathlib import Path
from typing import Any, cast

from bidnerf.results import Answer
from bidnerf.results import localize as localize_photos
from bidnerf.service.models import MapFacts, Refused, Upload, validate
from bidnerf.service.protocols import SERVICES
from bidnerf.service.upload import public_message, read_upload
from bidnerf_core.camera import CameraSource
from bidnerf_core.errors import InputError, InputWarning
from bidnerf_core.io import parse_json, to_plain
from bidnerf_core.localization import settings_of
from bidnerf_core.maps import Localizer, Map, MapCollection, load_map


class LoadedMaps:
    """The maps of a service with their localizers, which answer requests; they are loaded before workers are forked."""

    def __init__(self, localizers: Mapping[str, Localizer], max_pixels: float) -> None:
        """Store the localizers by map name; several maps form a collection, for photos whose map is not known."""
        self.localizers, self.max_pixels, first = localizers, max_pixels, next(iter(localizers.values()))
        self.scenes = {name: cast(Map, localizer.scene) for name, localizer in localizers.items()}
        self.together: MapCollection | None = None
        if len(localizers) > 1:
            self.together = MapCollection(self.scenes, first.method, first.config, localizers=dict(localizers))

    def describe(self) -> dict[str, Any]:
        """Return the facts about each map that clients may see, by map name; the other facts reveal photos and folders."""
        described = dict[str, Any]()
        for name, scene in self.scenes.items():
            facts = scene.describe().plain() | {"anchor": to_plain(scene.anchor), "backend": scene.info.backend or None}
            described[name] = {key: facts[key] for key in MapFacts.model_fields}
        return described

    def answer(self, task: Mapping[str, Any], folder: Path) -> dict[str, Any]:
        """Return the status and the body of the response to a request; the request's files may be written to ``folder``.

        ``task`` holds the name of the ``map``, or None for whichever map the photo shows, and either an ``upload`` or
        the ``body`` of a request to ``protocol``, as bytes.
        """
        outcomes = list[str]()

        def localize(upload: Upload) -> tuple[Answer, dict[str, Any]]:
            answer, body = self.localize(task["map"], upload, folder)
            outcomes.append(str(answer.localization.outcome))
            return answer, body

        try:
            if (protocol := task.get("protocol")) is None:
                _, body = localize(task["upload"])
            else:
                try:
                    given = parse_json(task["body"], "", "a JSON object")
                    validate(SERVICES[protocol].request, given)
                except InputError as error:
                    raise Refused(400, str(error)) from error
                body = SERVICES[protocol].answer(given, self.scenes[task["map"]], localize)
            reply: dict[str, Any] = {"status": 200, "body": body}
        except Refused as error:
            reply = {"status": error.status, "detail": error.detail, "more": error.more}
        except InputError as error:
            reply = {"status": 422, "detail": public_message(error, folder)}
        except Exception as error:  # the worker goes on, and the log states what happened
            reply = {"status": 500, "detail": "", "fault": f"{type(error).__name__}: {error}"}
        return reply | {"outcome": outcomes[-1] if outcomes else "bad input" if reply["status"] < 500 else "fault"}

    def localize(self, name: str | None, upload: Upload, folder: Path) -> tuple[Answer, dict[str, Any]]:
        """Localize a photo in the map ``name`` or, if it is None, in whichever of the maps the photo shows.

        Returns the answer, and its JSON values as printed by ``bidnerf localize --json``.
        """
        several = self.together if name is None else None
        localizer = next(iter(self.localizers.values())) if name is None else self.localizers[name]
        usual = CameraSource(assumed=localizer.assumed_cameras if several is None else several.cameras)
        photos, start = read_upload(upload, usual, folder, self.max_pixels)
        if several is not None and start is not None:
            raise InputError("start was given without map", expected=f"map as one of {', '.join(self.localizers)}")
        answers: Any = localize_photos(
            localizer if several is None else several, photos, start=lambda _: start, seed=upload.seed
        )
        (answer,) = answers.answers
        return answer, {**answers.plain(answer), "frame": upload.name}


def main() -> None:
    """Load the maps named in the parent's order, then fork a worker whenever the parent asks for one.

    The program's argument is the descriptor of the socket on which the order arrives. Each byte that arrives
    afterwards comes with the socket that a new worker will serve.
    """
    assert os.getpgrp() == os.getpid(), "this process ends its group"
    control = socket.socket(fileno=int(sys.argv[1]))
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # the system then reaps workers that end
    with control.makefile("rwb") as stream:
        order = pickle.load(stream)
        try:
            maps = _load(order)
        except (InputError, OSError, RuntimeError, MemoryError) as error:
            _send(stream, {"error": str(error) or type(error).__name__})
            return
        gc.collect()
        gc.freeze()  # otherwise garbage collection in a worker would write to, and so copy, every page with objects
        _send(stream, {"maps": maps.describe()})
    while True:
        message, descriptors, _, _ = socket.recv_fds(control, 1, 1)
        if not message:
            with contextlib.suppress(OSError):
                os.killpg(0, signal.SIGKILL)  # including those that are busy
            return
        if os.fork() == 0:
            control.close()
            signal.signal(signal.SIGCHLD, signal.SIG_DFL)
            try:
                with socket.socket(fileno=descriptors[0]).makefile("rwb") as stream:
                    _serve(maps, order["device"], stream)
            finally:
                os._exit(0)
        os.close(descriptors[0])


def _load(order: Mapping[str, Any]) -> LoadedMaps:
    """Load the maps named in ``order``. Raises ``InputError`` if a map cannot be served."""
    import logging
    import warnings

    import cv2
    import torch

    logging.getLogger("bidnerf").addHandler(logging.NullHandler())
    warnings.simplefilter("ignore", InputWarning)
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    config = settings_of(order["method"], order["config"])
    warm_up = order["device"] == "cpu"
    localizers = {
        name: Localizer(load_map(folder), order["method"], config, warm_up=warm_up)
        for name, folder in order["maps"].items()
    }
    return LoadedMaps(localizers, order["max_pixels"])


def _serve(maps: LoadedMaps, device: str, stream: BufferedRWPair) -> None:
    """Answer requests until the connection ends.

    On an accelerator, whose state does not survive a fork, the localizers are created again first.
    """
    try:
        if device != "cpu":
            moved = {
                name: Localizer(maps.scenes[name], each.method, each.config, device)
                for name, each in maps.localizers.items()
            }
            maps = LoadedMaps(moved, maps.max_pixels)
    except (InputError, RuntimeError) as error:
        _send(stream, {"error": str(error)})
        return
    _send(stream, {"pid": os.getpid()})
    with contextlib.suppress(EOFError, ConnectionError):
        while True:
            task, folder = pickle.load(stream)
            _send(stream, maps.answer(task, Path(folder)))


def _send(stream: BufferedRWPair, message: Mapping[str, Any]) -> None:
    """Send a message as JSON: the listening process must not unpickle data of a worker that a photo may have compromised."""
    stream.write(json.dumps(message).encode() + b"\n")
    stream.flush()


if __name__ == "__main__":
    main()
