"""``bidnerf info``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from bidnerf_core.captures.advice import sentences
from bidnerf_core.captures.cameras import pose_sentences
from bidnerf_core.captures.report import CaptureReport
from bidnerf_core.cli.options import Flag, MapFolder, option, parse
from bidnerf_core.cli.output import print_json, show
from bidnerf_core.cli.trial_progress import duration_text
from bidnerf_core.errors import InputError, amount
from bidnerf_core.evaluation.capture_figure import draw_capture
from bidnerf_core.fields.contract import SceneBounds, levels
from bidnerf_core.io.json import to_plain
from bidnerf_core.mapping.landmarks import LandmarkMap
from bidnerf_core.mapping.surface_map import SurfaceMap
from bidnerf_core.maps.files import load_capture
from bidnerf_core.maps.map import Map, load_map


def run(arguments: list[str]) -> None:
    parse("info", info, arguments)


def info(
    map: MapFolder,
    json: Annotated[Flag, option(None, "print one JSON object", "")] = False,
    draw: Annotated[
        Path | None, option("PNG", "picture of the capture from above, to be written", "no picture")
    ] = None,
) -> None:
    """Describe a map and the photos that it was made of. It is loaded whole, so that damage is found here."""
    stored = load_map(map)
    capture = None if stored.info.capture is None else load_capture(map / stored.info.capture)
    if draw is not None:
        _draw(map, stored, capture, draw)
    facts = describe(map, stored)
    if json:
        poses = [to_plain(camera.moved) for camera in stored.info.cameras if camera.moved is not None]
        print_json(facts | {"moved": poses, "capture": None if capture is None else to_plain(capture)})
        return
    for key, value in _lines(facts, stored).items():
        show(f"{key + ':':<12} {value}")
    refinement = stored.info.pose_refinement
    remarks = [] if refinement is None else pose_sentences(stored.info.cameras, refinement)
    for line in remarks if capture is None else [*remarks, *sentences(capture)]:
        show(f"- {line}")


def _draw(folder: Path, stored: Map, capture: CaptureReport | None, out: Path) -> None:
    """Draw the capture from above. Raises ``InputError`` if the map has no record of it."""
    if capture is None:
        raise InputError(
            f"{folder}: has no record of its photos to draw; 'bidnerf bake MAP --data DATA' makes one"
        )
    if out.suffix.lower() != ".png":
        raise InputError(f"{out}: expected the name of a PNG file")
    seen_by = None if stored.landmarks is None else stored.landmarks.views
    points = None if stored.landmarks is None else stored.landmarks.positions
    draw_capture(capture, points, seen_by, out)


def describe(folder: Path, stored: Map) -> dict[str, Any]:
    """Return what ``bidnerf info`` shows of the map in ``folder``, except the record of its photos."""
    info = stored.info
    parameters = sum(p.numel() for p in stored.field.parameters())  # type: ignore[attr-defined]
    return {
        "map": str(folder),
        "backend": info.backend,
        "data": info.data,
        "cameras": len(info.cameras),
        "distances": info.distances,
        "poses": None if info.pose_refinement is None else to_plain(info.pose_refinement),
        "step": info.step,
        "complete": info.complete,
        "seconds": round(info.seconds, 1),
        "levels": len(levels(stored.field)),
        "parameters": parameters,
        "surfels": 0 if stored.surface is None else len(stored.surface.surfels),
        "surface": None if stored.surface is None else _surface_facts(stored.surface),
        "landmarks": 0 if stored.landmarks is None else len(stored.landmarks),
        "trial": None if stored.landmarks is None else to_plain(stored.landmarks.trial),
        "bytes": sum(file.stat().st_size for file in folder.iterdir() if file.is_file()),
        "bounds": to_plain(info.bounds),
        "config": info.config,
        "bidnerf": info.bidnerf,
    }


def _surface_facts(surface: SurfaceMap) -> dict[str, Any]:
    """Return the side of a cell (metres), the number of cells that are stored, and the memory (MiB) of a surface."""
    return {"cell": surface.cell, "cells": surface.stored_cells, "MiB": round(surface.mebibytes, 1)}


def _lines(facts: dict[str, Any], stored: Map) -> dict[str, str]:
    """Return the most important facts about a map, one line for each of its parts; ``facts`` are from ``describe``."""
    info = stored.info
    photos = amount(len(info.cameras), "image") if info.cameras else "cameras not recorded"
    state = "complete" if info.complete else "not complete; 'bidnerf train --resume' goes on with it"
    time = duration_text(info.seconds)
    return {
        "map": f"{facts['map']}, {facts['bytes'] / 2**20:.1f} MiB, written by bidnerf {info.bidnerf}",
        "made from": f"{info.data or 'unnamed data'}, {photos}",
        "training": f"{info.step} steps of backend {info.backend} in {time}, {state}",
        "field": _field_line(facts, stored.colour_noise),
        "scene": _scene_line(info.bounds),
        "distances": "known" if info.distances else "not known, since all images were taken from one place",
        "surface": _surface_line(stored.surface),
        "landmarks": _landmarks_line(stored.landmarks),
        "settings": _shown(info.config),
    }


def _field_line(facts: dict[str, Any], noise: float | None) -> str:
    error = (
        "" if noise is None else f", off by {noise:.1%} of the range of colours on its training images (RMS)"
    )
    return f"{amount(facts['parameters'], 'parameter')} in {amount(facts['levels'], 'level')}{error}"


def _scene_line(bounds: SceneBounds) -> str:
    beyond = "more beyond it" if bounds.contracted else "nothing beyond it"
    box = f"a box of {' x '.join(f'{side:.3g}' for side in bounds.size)} from {_shown(list(bounds.lower))}, {beyond}"
    return f"{box}; seen from {bounds.near:.3g} to {bounds.far:.3g} away; background {_shown(list(bounds.background))}"


def _surface_line(surface: SurfaceMap | None) -> str:
    if surface is None:
        return "none; 'bidnerf bake MAP' makes one"
    cells = f"{amount(surface.stored_cells, 'cell')} with a side of {surface.cell:.3g}"
    return f"{amount(len(surface.surfels), 'surfel')}, indexed by {cells}, {surface.mebibytes:.1f} MiB"


def _landmarks_line(landmarks: LandmarkMap | None) -> str:
    if landmarks is None or len(landmarks) == 0:
        return "none; 'bidnerf bake MAP --data DATA' builds them"
    return str(len(landmarks))


def _shown(value: Any) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{key} {_shown(item)}" for key, item in value.items())
    if isinstance(value, list):
        return "(" + ", ".join(_shown(item) for item in value) + ")"
    return f"{value:.4g}" if isinstance(value, float) else str(value)
