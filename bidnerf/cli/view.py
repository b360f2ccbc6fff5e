"""``bidnerf view`` and ``bidnerf serve``: localization in the browser, and over HTTP for other programs."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from bidnerf import service, viewer
from bidnerf.cli.options import (
    Device,
    Host,
    MapFolder,
    MethodName,
    Overwrite,
    Port,
    Queries,
    QueryImages,
    existing,
    require_device,
)
from bidnerf.cli.output import check_output, console, say, show
from bidnerf.cli.parameters import Group, Option, Without
from bidnerf.cli.running import display_progress
from bidnerf.service import LEAST_TOKEN, ServiceLimits, check_token
from bidnerf.service import serve as serve_maps
from bidnerf_core.errors import UsageError, errors_in
from bidnerf_core.installation import import_extra
from bidnerf_core.io import read_file
from bidnerf_core.registry import USUAL_METHOD
from bidnerf_core.settings import EXPERT


@dataclass(frozen=True)
class PageOptions:
    """What the page shows beside the map and the images, and whether it is a file."""

    save: Annotated[
        Path | None, Option("PAGE.html", "write a page that opens without a server or a network, and exit")
    ] = None
    overwrite: Overwrite = False
    results: Annotated[
        Path | None,
        Option("FILE", "results of 'bidnerf evaluate', as a table with links to their frames"),
        existing("lines as written by 'bidnerf evaluate'"),
    ] = None
    trajectory: Annotated[
        Path | None,
        Option("FILE", "poses from 'bidnerf track', or in the format of TUM, EuRoC or KITTI"),
        existing("a trajectory"),
    ] = None


@dataclass(frozen=True)
class ServerOptions:
    """The server of the page."""

    host: Host = None
    port: Port = viewer.VIEWER_PORT
    device: Device = "cpu"
    method: Annotated[MethodName, EXPERT] = USUAL_METHOD


def run_view(
    map: MapFolder,
    query: Annotated[
        tuple[Path, ...],
        Option("[QUERY...]", "photos, folders of photos, or one dataset, to localize and show", positional=True),
        existing("photos or a dataset"),
    ] = (),
    *,
    page: Annotated[PageOptions, Group("page", "What the page shows beside the map, and whether it is a file.")],
    server: Annotated[ServerOptions, Group("server", "The server of the page, and how photos are localized there.")],
    queries: Annotated[Queries, Without("rig", "window")],
    images: QueryImages,
) -> None:
    """View a map, and localizations in it, in a browser.

    The page shows how and why each pose was accepted or refused, including those of photos dropped on it. Ctrl-C stops it. The photos and
    frames of QUERY can be selected there. Photos dropped on the page take the camera given here, whose field of view can be changed
    there. With --save, QUERY is localized immediately, and the saved page shows the same without a server.
    """
    if queries.frame and not query:
        raise UsageError("--frame names frames of a dataset", expected="the dataset as QUERY")
    if page.save is not None:
        inputs = (*query, *queries.depth, page.results, page.trajectory)
        check_output(page.save, inputs, page.overwrite, (".html", ".htm"))
    else:
        viewer.require_viewer()
    opener = queries.opener(query, images) if query else None
    say(f"loading {map}")

    from bidnerf.evaluation import read_results
    from bidnerf.viewer import MapView, answer_all, map_json, row_json, trajectory_json
    from bidnerf_core.camera import CameraSource
    from bidnerf_core.datasets import DatasetFrames
    from bidnerf_core.maps import Localizer, load_info, load_map

    require_device(server.device)
    info = load_info(map)
    path = None if page.trajectory is None else trajectory_json(page.trajectory, info.unit, info.origin)
    rows = () if page.results is None else tuple(row_json(row) for row in read_results([page.results]))
    scene = load_map(map, server.device)
    localizer = Localizer(scene, server.method, warm_up=page.save is None)
    assumed = localizer.assumed_cameras
    source = None if opener is None else opener(assumed, scene.bounds.background)
    if source is not None and page.save is not None and not queries.frame:  # at most 24 images, spread over all
        source = source.select(range(0, len(source.names), -(-len(source.names) // 24)))
    own = isinstance(source, DatasetFrames)
    camera = CameraSource() if own else queries.camera.source(images.camera, assumed)
    if page.save is None:
        viewer.serve_view(
            viewer.LiveView(localizer, source, path, rows, camera),
            host=server.host,
            port=server.port,
            ready=lambda address: say(f"look at {address}; Ctrl-C ends"),
        )
        return
    with display_progress():
        answers = () if source is None else answer_all(localizer, source)
    with console.status("drawing the map"):
        MapView(map_json(scene), answers, trajectory=path, results=rows).save(page.save)
    show(f"look at {page.save}")


TOKEN = "BIDNERF_TOKEN"
"""The environment variable that may hold the token; a command-line argument would be visible to all users of
the machine."""


def run_serve(
    maps: Annotated[
        tuple[str, ...],
        Option(
            "MAP...",
            "one or more map folders; NAME=MAP serves one under a name other than its folder's",
            positional=True,
        ),
    ],
    host: Host = None,
    port: Port = service.PORT,
    token_file: Annotated[
        Path | None,
        Option(
            "FILE",
            f"file with the token that clients must send, at least {LEAST_TOKEN} characters; or set {TOKEN} to the token",
            "none, but with --host one is generated and printed",
        ),
    ] = None,
    method: MethodName = USUAL_METHOD,
    device: Device = "cpu",
    *,
    limits: Annotated[ServiceLimits, Group("limits", "Limits on requests and workers.")],
) -> None:
    """Serve localization over HTTP: photos in, poses out.

    Answers are the JSON of 'bidnerf localize'. Ctrl-C stops the service. A photo is sent as a form or as the body of a request, with its
    camera, depth image or start if known:

    curl -F photo=@photo.jpg -F hfov=68 http://127.0.0.1:8000/localize

    /docs describes all paths, as does /openapi.json, and /health and /metrics are for monitoring. Each request is logged as a line of
    JSON on stderr.
    """
    import_extra("uvicorn", "serve", "the service")
    require_device(device)
    stated = os.environ.get(TOKEN)
    if token_file is not None:
        stated = read_file(token_file, "a file with a token", 4096).decode(errors="replace").strip()
        with errors_in(token_file):
            check_token(stated)

    def announce(address: str, token: str | None) -> None:
        """Print the address of the service and, if it was generated, the token; a token that the user gave must not be logged."""
        say(f"serving at {address}; Ctrl-C ends")
        if token is not None:
            shown = "TOKEN, the one that was given" if stated else token
            say(f"clients need the header  Authorization: Bearer {shown}")

    serve_maps(
        maps,
        host=host,
        port=port,
        token=stated,
        method=method,
        device=device,
        limits=limits,
        ready=announce,
    )
