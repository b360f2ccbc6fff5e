"""``bidnerf serve``."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

from bidnerf_core.cli.options import USUAL_METHOD, Device, Host, Method, Port
from bidnerf_core.cli.output import say
from bidnerf_core.cli.parser import Option
from bidnerf_core.errors import InputError, UsageError
from bidnerf_core.io import read_file, read_record
from bidnerf_core.service import LEAST_TOKEN, PORT, ServiceLimits
from bidnerf_core.service import serve as serve_maps

TOKEN = "BIDNERF_TOKEN"
"""The environment variable that may hold the token; a command-line argument would be visible to all users of
the machine."""


def run(
    maps: Annotated[
        tuple[str, ...],
        Option(
            "MAP...",
            "folders of maps; NAME=MAP serves one under another name than its folder's",
            positional=True,
        ),
    ] = (),
    host: Host = None,
    port: Port = PORT,
    token_file: Annotated[
        Path | None,
        Option(
            "FILE",
            f"file with the token that clients must send, at least {LEAST_TOKEN} characters; or set {TOKEN} to the token",
            "none, but with --host one is generated and printed",
        ),
    ] = None,
    method: Method = USUAL_METHOD,
    config: Annotated[
        Path | None,
        Option(
            "FILE",
            "JSON object with settings of the method, as 'bidnerf localize --method NAME --help-all' lists them:"
            ' {"refine_steps": 20}',
            "the method's own",
        ),
    ] = None,
    device: Device = "cpu",
    *,
    limits: ServiceLimits,
) -> None:
    """Serve localization over HTTP: photos in, the JSON of 'bidnerf localize' out. Ctrl-C stops it.

    A photo is sent as a form or as the body of a request, with its camera, depth image or start if known:
    curl -F photo=@photo.jpg -F hfov=68 http://127.0.0.1:8000/localize

    /docs describes all paths, as does /openapi.json, and /health and /metrics are for monitoring. Each request is logged as a line of
    JSON on stderr.
    """
    if not maps:
        raise UsageError("no MAP", expected="folders of maps")
    folders = dict[str, str | Path]()
    for given in maps:
        name, equals, folder = given.partition("=")
        if not equals or Path(given).is_dir():  # a folder's own name may contain an equals sign
            name, folder = Path(given).resolve().name, given
        if name in folders:
            raise UsageError(f"two maps are named {name!r}", expected="a different name for each: NAME=MAP")
        folders[name] = folder
    stated = os.environ.get(TOKEN)
    if token_file is not None:
        try:
            stated = read_file(token_file, "a file with a token", 4096).decode().strip()
        except UnicodeDecodeError as error:
            raise InputError("is not text", where=token_file, expected="a token") from error
        if not stated:
            raise InputError("is empty", where=token_file, expected="a token")

    def announce(address: str, token: str | None) -> None:
        """Print the address of the service and, if it was generated, the token; a token that the user gave must not be logged."""
        say(f"serving at {address}; Ctrl-C ends")
        if token is not None:
            shown = "TOKEN, the one that was given" if stated else token
            say(f"clients need the header  Authorization: Bearer {shown}")

    serve_maps(
        folders, host=host, port=port, token=stated, method=method, device=device, limits=limits,
        config=None if config is None else read_record(config).values, ready=announce,
    )  # fmt: skip
