"""Run the service: ``serve`` listens on a port until it is stopped."""

from __future__ import annotations

import asyncio
import os
import re
import secrets
import socket
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import is_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

from bidnerf.service.settings import ServiceLimits, check_token
from bidnerf_core.errors import InputError, UsageError
from bidnerf_core.installation import import_extra
from bidnerf_core.maps import read_description
from bidnerf_core.settings import to_flat

if TYPE_CHECKING:
    from bidnerf.service.web import Application

PORT = 8000


Scenes: TypeAlias = str | Path | Sequence[str | Path] | Mapping[str, str | Path]
"""The folders of maps. A map is named after its folder, unless ``NAME=MAP`` or a mapping from names to folders names it."""


def service_app(
    scenes: Scenes,
    *,
    method: str = "auto",
    config: Any = None,
    device: str = "cpu",
    limits: ServiceLimits | None = None,
    token: str | None = None,
) -> Application:
    """Return an ASGI application that serves the maps in the given folders, to run in your own server.

    ``method`` is the name of a localization method, which runs on ``device``. ``config`` holds the settings of the
    method, as an instance of its settings class or as a dictionary of the settings that differ from the defaults.

    The workers are single-threaded processes, started at ASGI startup and stopped at shutdown. Without a ``token``,
    only requests addressed to localhost are answered. Raises ``InputError`` for invalid names and settings, and if
    the extra ``serve`` is not installed. ASGI startup raises ``InputError`` if a map cannot be loaded.
    """
    import_extra("uvicorn", "serve", "the service")
    from bidnerf.service.app import application

    if config is not None and not isinstance(config, Mapping) and not is_dataclass(config):
        raise InputError(f"config is a {type(config).__name__}", expected=f"settings of {method}, or a dictionary")
    limits = limits or ServiceLimits()
    order = {
        "maps": maps_by_name(scenes),
        "method": method,
        "device": device,
        "max_pixels": limits.max_pixels,
        "config": dict(to_flat(config) if is_dataclass(config) else config or {}),
    }
    return application(order, limits, check_token(token))


def serve(
    scenes: Scenes,
    *,
    host: str | None = None,
    port: int = PORT,
    token: str | None = None,
    ready: Callable[[str, str | None], None] | None = None,
    stop: threading.Event | None = None,
    **options: Any,
) -> None:
    """Serve maps over HTTP until the process is interrupted, or ``stop`` is set.

    ``scenes`` is the folder of a map, a list of folders (``NAME=MAP`` serves the map in the folder ``MAP`` under the
    name ``NAME``), or a mapping from the names that clients use to folders. Only programs on this machine are answered
    unless a ``host``, such as 0.0.0.0, is given: clients then need the ``token``, which is generated if none is given.
    With ``port`` 0, a free port is picked. ``options`` are ``method``, ``config``, ``device`` and ``limits`` of
    ``service_app``. ``ready`` is called with the address and the token once the service answers requests. Raises
    ``InputError`` for maps and settings that cannot be served, and if the port is taken.
    """
    if not hasattr(os, "fork"):
        raise InputError("this system has no fork, but workers share the maps' memory by forking; use Linux or macOS")
    for folder in maps_by_name(scenes).values():
        read_description(folder)  # here rather than in the process that loads the maps, which imports torch first
    import_extra("uvicorn", "serve", "the service")
    token = choose_token(host, token)
    app = service_app(scenes, token=token, **options)
    run_app(app, host, port, lambda address: ready and ready(address, token), stop)


def choose_token(host: str | None, token: str | None) -> str | None:
    """Return the token that clients need: ``token`` if given, else None for a local ``host`` and a new token for others.

    Raises ``InputError`` if the token is too short.
    """
    from bidnerf.service.web import is_loopback

    is_local = host is None or is_loopback(host)
    return check_token(token or (None if is_local else secrets.token_urlsafe(24)))


def run_app(
    app: Application,
    host: str | None,
    port: int,
    ready: Callable[[str], Any],
    stop: threading.Event | None = None,
    grace: int = 10,
) -> None:
    """Run an application on a port until the process is interrupted, or ``stop`` is set.

    ``ready`` is called with the address once the port accepts connections. When the application stops, requests in
    progress have ``grace`` seconds to finish. Raises ``InputError`` if the port is taken.
    """
    import uvicorn

    async def run(bound: socket.socket) -> None:
        async with app.lifespan(app):
            name, number = bound.getsockname()[:2]
            ready(f"http://[{name}]:{number}" if ":" in name else f"http://{name}:{number}")  # connections wait by now
            watch = asyncio.create_task(exit_on_stop())
            await server.serve(sockets=[bound])
            watch.cancel()

    async def exit_on_stop() -> None:
        while stop is None or not stop.is_set():
            await asyncio.sleep(0.1)
        server.should_exit = True

    options = uvicorn.Config(
        app,
        http="h11",
        ws="none",
        loop="asyncio",
        lifespan="off",
        log_config=None,
        access_log=False,
        server_header=False,
        proxy_headers=False,
        timeout_keep_alive=15,
        timeout_graceful_shutdown=grace,
    )
    server, host = uvicorn.Server(options), host or "127.0.0.1"
    try:
        family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][0]
        listening = socket.create_server((host, port), family=family)
    except (OSError, OverflowError) as error:
        reason = getattr(error, "strerror", None) or error
        raise InputError(
            f"cannot listen there ({reason}); choose another port or address", where=f"{host}:{port}"
        ) from error
    with listening:
        try:
            asyncio.run(run(listening))
        except KeyboardInterrupt:
            if not server.started:
                raise


def maps_by_name(scenes: Scenes) -> dict[str, Path]:
    """Return the folders of maps by name; that of a link is the link's own. Raises ``UsageError`` for names that are invalid or not unique.

    ``bidnerf_core.maps.name_maps`` would make equal names unique by parent folders, but not into names for a URL.
    """
    pairs = list[tuple[str, str | Path]]()
    if isinstance(scenes, Mapping):
        pairs += scenes.items()
    else:
        for scene in map(str, [scenes] if isinstance(scenes, str | Path) else scenes):
            name, equals, path = scene.partition("=")
            is_named = equals and not Path(scene).is_dir()  # a folder's own name may contain an equals sign
            pairs.append((name, path) if is_named else (os.path.basename(os.path.abspath(scene)), scene))
    if not pairs:
        raise UsageError("no MAP", expected="folders of maps")
    names = [name for name, _ in pairs]
    for name, folder in pairs:
        if not re.fullmatch(r"[\w.-]{1,100}", name) or name in (".", "..") or names.count(name) > 1:
            raise UsageError(
                f"two maps are named {name!r}" if names.count(name) > 1 else f"its name is {name!r}",
                where=folder,
                expected="a name of its own for each, of letters, digits, '.', '-' and '_', given as NAME=MAP",
            )
    return {name: Path(folder) for name, folder in pairs}
