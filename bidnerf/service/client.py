"""A client for the service that needs only Python (and NumPy for arrays): copy this file to use it without bidnerf."""

from __future__ import annotations

import http.client
import io
import json
import struct
import time
import urllib.error
import urllib.request
import uuid
import zlib
from email.utils import parsedate_to_datetime
from pathlib import Path
from typing import Any, TypeAlias

File: TypeAlias = str | Path | bytes
"""A file, or its content as bytes."""


class ServiceError(Exception):
    """Raised if the service returns no result. ``status`` is the HTTP status, or 0 without an HTTP response."""

    def __init__(self, status: int, detail: str) -> None:
        super().__init__(detail)
        self.status = status


class ServiceClient:
    """A client that requests poses from a ``bidnerf serve`` service at ``url``.

    Requests to a busy service are retried for up to ``timeout`` seconds. All methods raise ``ServiceError`` if
    the service returns no result.
    """

    def __init__(self, url: str = "http://127.0.0.1:8000", token: str | None = None, timeout: float = 120.0) -> None:
        if not url.startswith(("http://", "https://")):
            raise ServiceError(0, f"the address is {url!r}, expected http:// or https:// before it")
        self.url, self.token, self.timeout = url.rstrip("/"), token, timeout

    def localize(
        self,
        photo: File | Any,
        map: str | None = None,
        *,
        depth: File | Any = None,
        camera: File | None = None,
        start: Any = None,
        **known: str | float | None,
    ) -> dict[str, Any]:
        """Localize a photo and return the same JSON as ``bidnerf localize``.

        ``photo`` is a file, its bytes, or a uint8 array (h, w) or (h, w, 3), also as an image of Pillow. ``map`` names the map to search, by
        default whichever map the photo shows. ``depth`` is a file, its bytes, or an array (h, w) of planar z: floats
        in metres or integers in millimetres, unless ``depth_unit`` is given. ``camera`` is a camera file or its
        content, and ``start`` is T_world_camera as 4x4 rows. ``known`` takes further values by keyword: ``name`` (of
        the frame in the answer), ``focal`` (pixels of the stored image), ``hfov`` (degrees), ``depth_unit`` (metres
        per step of the depth image) and ``seed``.
        """
        edge = uuid.uuid4().hex
        try:
            files = {
                "photo": _png(photo) if _is_array(photo) else photo,
                "depth": _npy(depth) if _is_array(depth) else depth,
                "camera": camera,
                "start": None if start is None else json.dumps(getattr(start, "tolist", lambda: start)()).encode(),
            }
            parts = [
                _part(edge, name, str(value).encode())
                for name, value in {**known, "map": map}.items()
                if value is not None
            ]
            for name, file in files.items():
                if isinstance(file, bytes):
                    parts.append(_part(edge, name, file, name))
                elif file is not None:
                    parts.append(_part(edge, name, Path(file).read_bytes(), Path(file).name))
        except OSError as error:
            expected = "the name of a file, or its content as bytes"
            raise ServiceError(
                0, f"{error.filename}: cannot be read ({error.strerror}), expected {expected}"
            ) from error
        except (TypeError, ValueError) as error:
            raise ServiceError(0, f"the request cannot be made: {error}") from error
        body = b"".join(parts) + f"--{edge}--\r\n".encode()
        return self.ask("/localize", body, f"multipart/form-data; boundary={edge}")

    def maps(self) -> dict[str, Any]:
        """Return the facts about each map, by map name."""
        return self.ask("/maps")

    def health(self) -> dict[str, Any]:
        """Return the status of the service: whether it can answer, and how many requests are waiting."""
        return self.ask("/health")

    def ask(self, path: str, body: bytes | None = None, kind: str = "application/json") -> dict[str, Any]:
        """Get the JSON object at a path such as /maps; with a ``body``, post the body there and return the JSON response."""
        until = time.monotonic() + self.timeout
        while True:
            status, retry_after, content = self._fetch(path, body, kind)
            try:
                answer = json.loads(content)
            except (ValueError, RecursionError):
                answer = None
            if status < 300 and isinstance(answer, dict):
                return answer
            wait = _seconds(retry_after)
            if status not in (429, 503) or time.monotonic() + wait > until:
                break
            time.sleep(wait)
        text = content.decode(errors="replace").strip()
        if isinstance(answer, dict):
            text = str(answer.get("detail") or answer.get("title") or text)
        if status < 300:
            text = f"the answer is {text[:60]!r}, expected a JSON object; is this the address of a service?"
        raise ServiceError(status, text or f"the answer has the status {status}")

    def _fetch(self, path: str, body: bytes | None, kind: str) -> tuple[int, str, bytes]:
        """Send a request once, and return the status, the Retry-After header and the content of the response."""
        headers = {"Content-Type": kind} | ({"Authorization": f"Bearer {self.token}"} if self.token else {})
        try:
            request = urllib.request.Request(self.url + path, body, headers)
            try:
                response = urllib.request.urlopen(request, timeout=self.timeout)
            except urllib.error.HTTPError as error:
                response = error  # a response of another status
            with response:
                return response.status, response.headers.get("Retry-After", ""), response.read()
        except (OSError, ValueError, http.client.HTTPException) as error:
            raise ServiceError(0, f"{self.url}: {getattr(error, 'reason', None) or error}") from error


def _seconds(retry_after: str) -> float:
    """Return the seconds to wait before another attempt, from a Retry-After header with a number or a date; 1 or more."""
    try:
        wait = (
            parsedate_to_datetime(retry_after).timestamp() - time.time() if ":" in retry_after else float(retry_after)
        )
    except (ValueError, OverflowError, OSError):  # there is no such header, or it is malformed
        wait = 0.0
    return max(1.0, wait)


def _part(edge: str, name: str, content: bytes, file: str | None = None) -> bytes:
    """Return a multipart form field. The stem of a photo's file name becomes the name of its frame in the answer."""
    quoted = (file or "").replace("\\", "\\\\").replace('"', "%22").replace("\r", "").replace("\n", "")
    head = f'--{edge}\r\nContent-Disposition: form-data; name="{name}"'
    return (head + (f'; filename="{quoted}"' if file else "") + "\r\n\r\n").encode() + content + b"\r\n"


def _is_array(given: Any) -> bool:
    """Return whether something is an array, a tensor or an image of Pillow."""
    return hasattr(given, "shape") or hasattr(given, "__array_interface__")


def _npy(array: Any) -> bytes:
    import numpy as np

    np.save(file := io.BytesIO(), np.asarray(array))
    return file.getvalue()


def _png(array: Any) -> bytes:
    import numpy as np

    pixels = np.ascontiguousarray(array)
    kinds = {(): 0, (3,): 2, (4,): 6}  # of PNG: grey, RGB, RGBA
    if pixels.dtype != np.uint8 or pixels.ndim not in (2, 3) or pixels.shape[2:] not in kinds:
        raise ServiceError(0, f"photo is {pixels.dtype} {pixels.shape}, expected bytes (h, w) or (h, w, 3)")

    def chunk(kind: bytes, content: bytes) -> bytes:
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))

    height, width = pixels.shape[:2]
    head = struct.pack(">IIBBBBB", width, height, 8, kinds[pixels.shape[2:]], 0, 0, 0)
    data = chunk(b"IDAT", zlib.compress(b"".join([b"\0" + row.tobytes() for row in pixels]), 1))
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + data + chunk(b"IEND", b"")
