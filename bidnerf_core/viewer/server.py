"""The viewer on a port: ``serve_view``, which runs until it is stopped."""

from __future__ import annotations

import secrets
import threading
from collections.abc import Callable
from dataclasses import replace

from bidnerf_core.camera import CameraSource
from bidnerf_core.datasets import QuerySource
from bidnerf_core.errors import InputError
from bidnerf_core.localization import Localizer
from bidnerf_core.maps import Map
from bidnerf_core.service import ServiceLimits, checked_token, run_app
from bidnerf_core.viewer.page_state import PageState
from bidnerf_core.viewer.scene import shown_map
from bidnerf_core.viewer.table import ShownRow
from bidnerf_core.viewer.trajectories import ShownTrajectory

PORT = 8010
GRACE = 1
"""Time (seconds) that requests in progress are given when the viewer is stopped."""
NEEDS = "the live viewer needs the extra 'viewer' (pip install 'bidnerf[viewer]'); --save writes a page without it"


def serve_view(
    localizer: Localizer,
    source: QuerySource | None = None,
    trajectory: ShownTrajectory | None = None,
    results: tuple[ShownRow, ...] = (),
    *,
    camera: CameraSource | None = None,
    host: str | None = None,
    port: int = PORT,
    token: str | None = None,
    limits: ServiceLimits | None = None,
    ready: Callable[[str], None] | None = None,
    stop: threading.Event | None = None,
) -> None:
    """Show a map in browsers, which may localize photos in it, until the process is interrupted or ``stop`` is set.

    ``source`` holds images that may be localized by choosing them. ``camera`` is that of other photos, by default that of EXIF or
    the map; the page shows its field of view, which can be changed there. Only browsers on this
    machine are answered, unless a ``host``, such as 0.0.0.0, is named: the address that ``ready`` is called with then holds a
    ``token``, which is made up where none is given. Raises ``InputError`` without the extra, and for a port that is taken.
    """
    try:
        import uvicorn  # noqa: F401

        from bidnerf_core.service import is_loopback
        from bidnerf_core.viewer.app import Shown, viewer_app
    except ImportError as error:
        raise InputError(NEEDS) from error
    scene = localizer.scene
    if not isinstance(scene, Map):
        raise InputError(f"the viewer shows a Map, got a {type(scene).__name__}")
    is_local = host is None or is_loopback(host)
    token = checked_token(token or (None if is_local else secrets.token_urlsafe(24)))
    names = () if source is None else tuple(source.names)
    usual = replace(camera or CameraSource(), assumed=localizer.assumed_cameras)
    others = replace(usual, hfov=None)  # the page sends the field of view
    state = PageState(
        shown_map(scene, thumbnails=0), live=True, queries=names, trajectory=trajectory, results=results,
        hfov=usual.hfov, camera_given=others.is_given,
    )  # fmt: skip

    def announce(address: str) -> None:
        if ready is not None:
            ready(address if token is None else f"{address}/?token={token}")

    run_app(
        viewer_app(Shown(localizer, source, state, others), token, limits),
        host,
        port,
        announce,
        stop,
        grace=GRACE,
    )
