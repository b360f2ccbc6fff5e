"""Access control: the service answers clients with its token or, without a token, programs on this machine."""

from __future__ import annotations

import contextlib
import hmac
import ipaddress
from http.cookies import SimpleCookie
from urllib.parse import urlsplit

from starlette.datastructures import Headers
from starlette.types import Scope

OPEN = "/health"
"""The path that needs no token: load balancers poll it, and it reveals nothing about the maps."""


def refusal(scope: Scope, token: str | None, cookie: str | None = None) -> tuple[int, str] | None:
    """Return the status and the reason for which a request is refused; None if it is passed on.

    A web page in a browser may send requests to any address: these are detected by their ``Origin``, which is not the
    address that they ask, or, if another site's name resolves to this machine, by their ``Host``. ``cookie`` is the name
    of a cookie that may hold the token.
    """
    headers = Headers(scope=scope)
    host, origin = headers.get("host", ""), headers.get("origin")
    is_own_page = origin is None or urlsplit_or_none(origin, "netloc") == host
    if token is not None:
        given = headers.get("authorization", "")
        if scope["path"] == OPEN or hmac.compare_digest(f"Bearer {token}".encode(), given.encode()):
            return None
        if cookie is not None and is_own_page and _has_cookie(headers, cookie, token):
            return None
        return 401, "expected the header 'Authorization: Bearer TOKEN' with the token of this service"
    if not is_loopback(urlsplit_or_none(f"//{host}", "hostname")):
        return 403, "without a token the service answers requests to localhost only"
    if not is_own_page:
        return 403, "requests from pages of other sites are rejected"
    return None


def _has_cookie(headers: Headers, name: str, token: str) -> bool:
    with contextlib.suppress(Exception):  # a malformed cookie is none
        found = SimpleCookie("; ".join(headers.getlist("cookie"))).get(name)
        return found is not None and hmac.compare_digest(found.value.encode(), token.encode())
    return False


def urlsplit_or_none(address: str, part: str) -> str | None:
    """Return a part of an address; None if it is not an address."""
    try:
        return getattr(urlsplit(address), part)
    except ValueError:
        return None


def is_loopback(host: str | None) -> bool:
    """Return whether a name or address is a loopback one."""
    try:
        return host is not None and ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost" or str(host).endswith(".localhost")
