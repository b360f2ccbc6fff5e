"""``bidnerf info``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from bidnerf_core.cli.folders import check_output
from bidnerf_core.cli.options import Json, MapFolder
from bidnerf_core.cli.output import print_json, say, show
from bidnerf_core.cli.parser import Option
from bidnerf_core.errors import InputError


def run(
    map: MapFolder,
    json: Json = False,
    draw: Annotated[
        Path | None, Option("PNG", "file for a picture of the capture from above", "no picture")
    ] = None,
) -> None:
    """Describe a map and the photos it was built from. The whole map is loaded, so that damage is detected."""
    from bidnerf_core.maps import load_map
    from bidnerf_core.results import draw_capture

    if draw is not None:
        if draw.suffix.lower() != ".png":
            raise InputError(where=draw, expected="the name of a PNG file")
        check_output(draw, ())
    scene = load_map(map)
    summary = scene.describe()
    if draw is not None:
        if scene.capture is None:
            raise InputError(
                "has no record of its photos to draw; 'bidnerf bake MAP --data DATA' creates one", where=map
            )
        seen_by = None if scene.landmarks is None else scene.landmarks.views
        points = None if scene.landmarks is None else scene.landmarks.positions
        draw_capture(scene.capture, points, seen_by, draw, scene.unit)
        say(f"{draw}: written")
    if json:
        print_json(summary.plain())
        return
    for line in str(summary).splitlines():
        show(line)
