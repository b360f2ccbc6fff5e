"""``bidnerf serve``."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import tyro

from bidnerf_core.cli.options import Device, option, parse, require
from bidnerf_core.cli.output import say
from bidnerf_core.errors import InputError, UsageError
from bidnerf_core.io import read_file, read_record
from bidnerf_core.service import LEAST_TOKEN, PORT, ServiceLimits
from bidnerf_core.service import serve as serve_maps

TOKEN = "BIDNERF_TOKEN"
"""The environment variable that may hold the token; a command-line argument would be visible to all users of
the machine."""


def run(arguments: list[str]) -> None:
    parse("serve", serve, arguments)


def serve(
    maps: Annotated[
        tuple[str, ...],
        tyro.conf.Positional,
        option(
            "MAP...",
            "folders of maps; NAME=MAP serves one under another name than its folder's (required)",
            "",
        ),
    ],
    *,
    host: Annotated[
        str | None,
        option(
            "ADDRESS",
            "listen on this address, such as 0.0.0.0; clients then need a token",
            "this machine only",
        ),
    ] = None,
    port: Annotated[int, option("N", "port to listen on; 0 picks a free one")] = PORT,
    token_file: Annotated[
        Path | None,
        option(
            "FILE",
            f"file with the token that clients must send, at least {LEAST_TOKEN} characters; or set {TOKEN} to the token",
            "none, but with --host one is generated and printed",
        ),
    ] = None,
    method: Annotated[str, option("NAME", "how poses are found, one of 'bidnerf plugins methods'")] = "auto",
    config: Annotated[
        Path | None,
        option(
            "FILE",
            "JSON object with settings of the method, as 'bidnerf localize --method NAME --help' lists them:"
            ' {"refine_steps": 20}',
            "the method's own",
        ),
    ] = None,
    device: Device = "cpu",
    limits: ServiceLimits = ServiceLimits(),
) -> None:
    """Serve localization over HTTP: photos in, the JSON of 'bidnerf localize' out. Ctrl-C stops it.

    A photo is sent as a form or as the body of a request, with its camera, depth image or start if known:
    curl -F photo=@photo.jpg -F hfov=68 http://127.0.0.1:8000/localize

    /openapi.json describes all paths, /health and /metrics are for monitoring, and /geopose implements the
    GeoPose Protocol. Each request is logged as a line of JSON on stderr.
    """
    require("--port", port, 0, 65535)
    if not maps:
        raise UsageError("no MAP", expected="folders of maps")
    given = _token(token_file)
    serve_maps(
        _named(maps), host=host, port=port, token=given, method=method, device=device, limits=limits,
        config=None if config is None else read_record(config).values,
        ready=lambda address, token: _announce(address, "TOKEN, the one that was given" if given else token),
    )  # fmt: skip


def _named(maps: tuple[str, ...]) -> dict[str, str | Path]:
    """Return the folders by name. An argument that is a folder is taken as one, even if its name contains an
    equals sign.
    """
    found = dict[str, str | Path]()
    for given in maps:
        name, equals, folder = given.partition("=")
        if not equals or Path(given).is_dir():
            name, folder = Path(given).resolve().name, given
        if name in found:
            raise UsageError(f"two maps are named {name!r}", expected="a different name for each: NAME=MAP")
        found[name] = folder
    return found


def _token(file: Path | None) -> str | None:
    if file is None:
        return os.environ.get(TOKEN)
    try:
        token = read_file(file, "a file with a token", 4096).decode().strip()
    except UnicodeDecodeError as error:
        raise InputError("is not text", where=file, expected="a token") from error
    if not token:
        raise InputError("is empty", where=file, expected="a token")
    return token


def _announce(address: str, token: str | None) -> None:
    """Print where the service is. ``token``: only a generated one, since a given token must not be logged."""
    say(f"serving at {address}; Ctrl-C ends")
    if token is not None:
        say(f"clients need the header  Authorization: Bearer {token}")
