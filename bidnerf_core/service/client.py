"""A client for the service that needs only Python: copy this file to where bidnerf is not installed."""

from __future__ import annotations

import json
import time
import urllib.error
import urllib.request
import uuid
from pathlib import Path
from typing import Any


class ServiceError(Exception):
    """The service did not respond with a result; ``status`` is the HTTP status, 0 without a connection."""

    def __init__(self, status: int, detail: str) -> None:
        super().__init__(detail)
        self.status = status


class ServiceClient:
    """Requests poses from a ``bidnerf serve`` service at ``url``. A busy service is retried for up to
    ``timeout`` seconds.
    """

    def __init__(
        self, url: str = "http://127.0.0.1:8000", token: str | None = None, timeout: float = 120.0
    ) -> None:
        self.url, self.token, self.timeout = url.rstrip("/"), token, timeout

    def localize(self, photo: str | Path | bytes, **given: Any) -> dict[str, Any]:
        """Return the JSON of ``bidnerf localize`` for a photo, given as a file or its bytes.

        ``given``: ``map`` (by default the one that the photo shows) and ``name``; ``depth``, a file or its bytes, with ``depth_unit``; ``focal``,
        ``hfov``, or ``camera``, a path or such a file's content as bytes; ``start``, 4x4 rows of
        T_world_camera; ``seed``. Raises ``ServiceError``.
        """
        edge, start = uuid.uuid4().hex, given.pop("start", None)
        fields = given | {"photo": photo} | ({} if start is None else {"start": json.dumps(start).encode()})
        files = ("photo", "depth", "camera", "start")
        parts = [_part(edge, n, v, n in files) for n, v in fields.items() if v is not None]
        body = b"".join(parts) + f"--{edge}--\r\n".encode()
        found: dict[str, Any] = self.ask("/localize", body, f"multipart/form-data; boundary={edge}")
        return found

    def ask(self, path: str, body: bytes | None = None, kind: str = "application/json") -> Any:
        """Return the JSON at a path such as /maps, or the response to ``body``. Raises ``ServiceError``."""
        headers = {"Content-Type": kind} | ({"Authorization": f"Bearer {self.token}"} if self.token else {})
        request, until = (
            urllib.request.Request(self.url + path, body, headers),
            time.monotonic() + self.timeout,
        )
        while True:
            try:
                with urllib.request.urlopen(request, timeout=self.timeout) as answer:
                    return json.load(answer)
            except urllib.error.HTTPError as error:
                wait = float(error.headers.get("Retry-After") or 0)
                if error.code not in (429, 503) or time.monotonic() + wait > until:
                    text = error.read().decode(errors="replace")
                    told = (
                        json.loads(text)["detail"]
                        if "problem+json" in error.headers.get("Content-Type", "")
                        else text
                    )
                    raise ServiceError(error.code, told) from error
                time.sleep(wait)
            except OSError as error:
                raise ServiceError(0, f"{self.url}: {getattr(error, 'reason', error)}") from error


def _part(edge: str, name: str, value: Any, is_file: bool) -> bytes:
    """Return a form field; the stem of a photo's file name becomes its name in the answer."""
    content = (
        value if isinstance(value, bytes) else Path(value).read_bytes() if is_file else str(value).encode()
    )
    told = Path(value).name if is_file and not isinstance(value, bytes) else name
    quoted = told.replace("\\", "\\\\").replace('"', "%22").replace("\r", "").replace("\n", "")
    file = f'; filename="{quoted}"' if is_file else ""
    return (
        f'--{edge}\r\nContent-Disposition: form-data; name="{name}"{file}\r\n\r\n'.encode()
        + content
        + b"\r\n"
    )
