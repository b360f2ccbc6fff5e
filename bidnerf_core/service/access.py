"""Access control: the service answers clients with its token or, without a token, programs on this machine."""

from __future__ import annotations

import contextlib
import hmac
import ipaddress
from urllib.parse import urlsplit

from starlette.requests import HTTPConnection
from starlette.types import Scope

OPEN = "/health"
"""The path that needs no token: load balancers poll it, and it reveals nothing about the maps."""


def refusal(scope: Scope, token: str | None, cookie: str | None = None) -> tuple[int, str] | None:
    """Return the status and the reason for which a request is refused; None if it is passed on.

    A web page in a browser may send requests to any address: these are detected by their ``Origin``, which is not the
    address that they ask, or, if another site's name resolves to this machine, by their ``Host``. ``cookie`` is the name
    of a cookie that may hold the token.
    """
    request = HTTPConnection(scope)
    host, origin = request.headers.get("host", ""), request.headers.get("origin")
    try:
        is_local = is_loopback(urlsplit(f"//{host}").hostname)
        is_own_page = origin is None or urlsplit(origin).netloc == host
    except ValueError:  # the headers hold no valid addresses
        is_local = is_own_page = False
    if token is not None:
        given = [(f"Bearer {token}", request.headers.get("authorization", ""))]
        if cookie is not None and is_own_page:
            given.append((token, request.cookies.get(cookie, "")))
        if scope["path"] == OPEN or any(hmac.compare_digest(a.encode(), b.encode()) for a, b in given):
            return None
        return 401, "expected the header 'Authorization: Bearer TOKEN' with the token of this service"
    if not is_local:
        return 403, "without a token the service answers requests to localhost only"
    return None if is_own_page else (403, "requests from pages of other sites are rejected")


def is_loopback(host: str | None) -> bool:
    """Return whether a name or address is a loopback one."""
    with contextlib.suppress(ValueError):
        return ipaddress.ip_address(host or "").is_loopback
    return host == "localhost" or str(host).endswith(".localhost")
