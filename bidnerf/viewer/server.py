"""Run the live viewer: ``serve_view`` serves the page until it is stopped."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import TYPE_CHECKING

from bidnerf.service import ServiceLimits, choose_token, run_app
from bidnerf_core.installation import import_extra

if TYPE_CHECKING:
    from bidnerf.viewer.app import LiveView

VIEWER_PORT = 8010


def require_viewer() -> None:
    """Raise ``InputError`` if the extra ``viewer`` is not installed; callers need not load a map before they know."""
    import_extra("uvicorn", "viewer", "the live viewer", otherwise="; `save` writes a page without it")


def serve_view(
    live: LiveView,
    *,
    host: str | None = None,
    port: int = VIEWER_PORT,
    token: str | None = None,
    limits: ServiceLimits | None = None,
    ready: Callable[[str], None] | None = None,
    stop: threading.Event | None = None,
) -> None:
    """Serve a page that shows a map and localizes photos in it, until the process is interrupted or ``stop`` is set.

    Only browsers on this machine are answered unless a ``host``, such as 0.0.0.0, is given: the address passed to
    ``ready`` then contains a ``token``, which is generated if none is given. ``limits`` apply to uploads. Raises
    ``InputError`` if the extra ``viewer`` is not installed, and if the port is taken.
    """
    require_viewer()
    from bidnerf.viewer.app import viewer_app

    token = choose_token(host, token)

    query = "" if token is None else f"/?token={token}"
    run_app(
        viewer_app(live, token, limits), host, port, lambda address: ready and ready(address + query), stop, grace=1
    )
