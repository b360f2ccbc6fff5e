"""Access control: the service answers clients with its token or, without a token, programs on this machine."""

from __future__ import annotations

import hmac
import ipaddress
import json
from collections.abc import Callable, Mapping, MutableMapping
from typing import Any
from urllib.parse import urlsplit

from starlette.datastructures import Headers
from starlette.types import ASGIApp, Receive, Scope, Send

OPEN = "/health"
"""The path that needs no token: load balancers poll it, and it reveals nothing about the maps."""


SAFE = {
    "X-Content-Type-Options": "nosniff",
    "Content-Security-Policy": "default-src 'none'; frame-ancestors 'none'",
    "Cache-Control": "no-store",
}
"""Headers of every response: names in it are text, whatever a browser might make of them."""
PROBLEM = "application/problem+json"


class Access:
    """Passes on requests that carry the token, or that a program on this machine addresses to it.

    A web page in a browser may send requests to the loopback interface; these are detected by their
    ``Origin`` or, if another site's name resolves to this machine, by their ``Host``. ``refused`` is called
    with the scope and status of each rejected request.
    """

    def __init__(
        self, app: ASGIApp, token: str | None, refused: Callable[[Scope, int], None] = lambda *_: None
    ) -> None:
        self.app, self.token, self.refused = app, token, refused

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        refusal = None if scope["type"] != "http" else self._refusal(scope)
        if scope["type"] == "websocket":
            await send({"type": "websocket.close", "code": 1008})
        elif refusal is None:
            await self.app(scope, receive, send)
        else:
            self.refused(scope, refusal[0])
            await _refuse(send, *refusal)

    def _refusal(self, scope: MutableMapping[str, Any]) -> tuple[int, str] | None:
        headers = Headers(scope=scope)
        if self.token is not None:
            given = headers.get("authorization", "")
            if scope["path"] == OPEN or hmac.compare_digest(f"Bearer {self.token}".encode(), given.encode()):
                return None
            return 401, "expected the header 'Authorization: Bearer TOKEN' with the token of this service"
        if not is_loopback(_host_of(f"//{headers.get('host', '')}")):
            return 403, "without a token the service answers requests to localhost only"
        origin = headers.get("origin")
        if origin is not None and not is_loopback(_host_of(origin)):
            return 403, "requests from pages of other sites are rejected"
        return None


async def _refuse(send: Send, status: int, detail: str) -> None:
    more = {"www-authenticate": "Bearer"} if status == 401 else {}
    headers, body = closing_problem(status, "not allowed", detail, more)
    await send({"type": "http.response.start", "status": status, "headers": headers})
    await send({"type": "http.response.body", "body": body})


def closing_problem(
    status: int, title: str, detail: str, more: Mapping[str, str] | None = None
) -> tuple[list[tuple[bytes, bytes]], bytes]:
    """Return the headers and the body of an error response (RFC 9457) after which the connection is closed."""
    body = json.dumps({"title": title, "status": status, "detail": detail}).encode()
    length = {"content-type": PROBLEM, "content-length": str(len(body)), "connection": "close"}
    headers = length | SAFE | dict(more or {})
    return [(name.lower().encode(), value.encode()) for name, value in headers.items()], body


def _host_of(address: str) -> str | None:
    try:
        return urlsplit(address).hostname
    except ValueError:
        return None


def is_loopback(host: str | None) -> bool:
    """Return whether a name or address is a loopback one."""
    if host is None:
        return False
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost" or host.endswith(".localhost")


def describe_client(scope: MutableMapping[str, Any]) -> str | None:
    """Return the address of a request's sender."""
    client = scope.get("client")
    return None if client is None else f"{client[0]}:{client[1]}"
