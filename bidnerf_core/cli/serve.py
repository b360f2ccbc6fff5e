"""``bidnerf serve``."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from bidnerf_core.cli.options import USUAL_METHOD, Device, require
from bidnerf_core.cli.output import say
from bidnerf_core.cli.parser import Option, parse
from bidnerf_core.errors import InputError, UsageError
from bidnerf_core.io import read_file, read_record
from bidnerf_core.service import LEAST_TOKEN, PORT, ServiceLimits
from bidnerf_core.service import serve as serve_maps

TOKEN = "BIDNERF_TOKEN"
"""The environment variable that may hold the token; a command-line argument would be visible to all users of
the machine."""


@dataclass(frozen=True)
class Serve:
    """Serve localization over HTTP: photos in, the JSON of 'bidnerf localize' out. Ctrl-C stops it.

    A photo is sent as a form or as the body of a request, with its camera, depth image or start if known:
    curl -F photo=@photo.jpg -F hfov=68 http://127.0.0.1:8000/localize

    /docs describes all paths, as does /openapi.json, and /health and /metrics are for monitoring. Each request is logged as a line of
    JSON on stderr.
    """

    maps: Annotated[
        tuple[str, ...],
        Option(
            "MAP...",
            "folders of maps; NAME=MAP serves one under another name than its folder's",
            positional=True,
        ),
    ] = ()
    host: Annotated[
        str | None,
        Option(
            "ADDRESS",
            "listen on this address, such as 0.0.0.0; clients then need a token",
            "this machine only",
        ),
    ] = None
    port: Annotated[int, Option("N", "port to listen on; 0 picks a free one")] = PORT
    token_file: Annotated[
        Path | None,
        Option(
            "FILE",
            f"file with the token that clients must send, at least {LEAST_TOKEN} characters; or set {TOKEN} to the token",
            "none, but with --host one is generated and printed",
        ),
    ] = None
    method: Annotated[str, Option("NAME", "how poses are found, one of 'bidnerf plugins methods'")] = (
        USUAL_METHOD
    )
    config: Annotated[
        Path | None,
        Option(
            "FILE",
            "JSON object with settings of the method, as 'bidnerf localize --method NAME --help-all' lists them:"
            ' {"refine_steps": 20}',
            "the method's own",
        ),
    ] = None
    device: Device = "cpu"
    limits: ServiceLimits = ServiceLimits()

    def run(self) -> None:
        require("--port", self.port, 0, 65535)
        if not self.maps:
            raise UsageError("no MAP", expected="folders of maps")
        given = _token(self.token_file)

        def announce(address: str, token: str | None) -> None:
            """Print where the service is, and a token that was generated; a given one must not be logged."""
            say(f"serving at {address}; Ctrl-C ends")
            if token is not None:
                shown = "TOKEN, the one that was given" if given else token
                say(f"clients need the header  Authorization: Bearer {shown}")

        serve_maps(
            _named(self.maps), host=self.host, port=self.port, token=given, method=self.method, device=self.device,
            limits=self.limits, config=None if self.config is None else read_record(self.config).values, ready=announce,
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


def run(arguments: list[str]) -> None:
    parse("serve", Serve, arguments).run()
