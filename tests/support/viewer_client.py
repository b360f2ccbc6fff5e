"""A live viewer of the room, run in a thread, and a client that asks it."""

from __future__ import annotations

import contextlib
import json
import tempfile
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from http.client import HTTPConnection
from pathlib import Path
from queue import SimpleQueue
from typing import Any
from urllib.parse import urlsplit

import viewed
from bidnerf import Localizer, Map
from bidnerf.service import ServiceLimits
from bidnerf.viewer import LiveView, serve_view
from bidnerf_core.camera import CameraSource
from bidnerf_core.datasets import DatasetOptions, Photos
from photo_room import CAMERA

LIMITS = ServiceLimits(max_megabytes=1.0, max_megapixels=1.0)


@dataclass
class Reply:
    """An answer over HTTP."""

    status_code: int
    headers: dict[str, str]
    content: bytes

    def json(self) -> Any:
        return json.loads(self.content)


@dataclass
class Client:
    """Asks a viewer, with paths as they are written."""

    port: int

    def request(
        self, method: str, path: str, body: bytes | None = None, headers: dict[str, str] | None = None
    ) -> Reply:
        connection = HTTPConnection("127.0.0.1", self.port, timeout=120)
        try:
            connection.request(method, path, body, headers or {})
            found = connection.getresponse()
            return Reply(found.status, {k.lower(): v for k, v in found.getheaders()}, found.read())
        finally:
            connection.close()

    def get(self, path: str, **headers: str) -> Reply:
        return self.request("GET", path, headers=headers)

    def post(self, path: str, content: bytes | None = None, headers: dict[str, str] | None = None) -> Reply:
        return self.request("POST", path, content, headers)


@contextlib.contextmanager
def serving(
    room: Map,
    token: str | None = None,
    camera: CameraSource | None = None,
    method: str = "auto",
    config: Any = None,
) -> Iterator[Client]:
    """Run a viewer of the room, with one photo to choose; ``camera`` is that of other photos."""
    stop, ready = threading.Event(), SimpleQueue[str]()
    with tempfile.TemporaryDirectory() as folder:
        source = Photos([viewed.photo_file(Path(folder))], DatasetOptions(CameraSource(assumed=(CAMERA,))))
        shown = LiveView(Localizer(room, method, config), source, camera=camera)
        options = {"token": token, "limits": LIMITS, "ready": ready.put, "stop": stop, "port": 0}
        thread = threading.Thread(target=serve_view, args=[shown], kwargs=options)
        thread.start()
        try:
            yield Client(int(urlsplit(ready.get(timeout=120)).port or 0))
        finally:
            stop.set()
            thread.join(60)
    assert not thread.is_alive()
