"""A worker: reads a photo from the bytes of a request, localizes it in a map, and returns the JSON of
``bidnerf localize``.
"""

from __future__ import annotations

import os
import shutil
import socket
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bidnerf_core.camera import CameraSource
from bidnerf_core.errors import InputError
from bidnerf_core.io import to_plain
from bidnerf_core.localization import Localizer, settings_of
from bidnerf_core.maps import Map, MapCollection, load_map
from bidnerf_core.results import Answer, localize_each
from bidnerf_core.service import geopose, wire
from bidnerf_core.service.settings import ChosenMethod
from bidnerf_core.service.upload import Upload

OK, UNUSABLE, FAULT = 200, 422, 500
TOLD = ("backend", "cameras", "landmarks", "surfels", "unit", "distances", "bounds", "complete", "bidnerf")
"""The facts about a map that clients may see. The others name photos and folders."""


@dataclass(frozen=True)
class Served:
    """A map that is served, ready to localize."""

    scene: Map
    localizer: Localizer

    @property
    def described(self) -> dict[str, Any]:
        """Facts about the map that clients may see."""
        facts = self.scene.describe().plain()
        return {key: facts[key] for key in TOLD} | {
            "anchor": None if self.scene.anchor is None else to_plain(self.scene.anchor)
        }


@dataclass(frozen=True)
class Worker:
    """Everything needed to answer requests, loaded before workers are forked."""

    maps: Mapping[str, Served]
    together: MapCollection | None  # several maps, for photos whose map is not known
    max_pixels: float
    folder: Path  # where request files are stored, each request in its own folder
    device: str

    @staticmethod
    def load(maps: Mapping[str, Path], method: ChosenMethod, max_pixels: float, folder: Path) -> Worker:
        """Load maps by name. Raises ``InputError`` if one cannot be served.

        On devices other than the CPU, each worker creates its own localizer: no accelerator survives a fork.
        """
        config = settings_of(method.name, dict(method.config))
        served = dict[str, Served]()
        for name, place in maps.items():
            scene = load_map(place)
            localizer = Localizer(scene, method.name, config, warm_up=method.device == "cpu")
            served[name] = Served(scene, localizer)
        return Worker(served, _together(served), max_pixels, folder, method.device)

    @property
    def described(self) -> dict[str, Any]:
        """The description of each map by its name."""
        return {name: served.described for name, served in self.maps.items()}

    def serve(self, connection: socket.socket) -> None:
        """Answer requests until the connection ends."""
        try:
            ready = self._on_device()
        except (InputError, RuntimeError) as error:
            wire.send(connection, {"error": str(error)})
            return
        wire.send(connection, {"pid": os.getpid()})
        while (message := wire.receive(connection)) is not None:
            wire.send(connection, ready.answer(*message))

    def _on_device(self) -> Worker:
        if self.device == "cpu":
            return self
        moved = {
            name: Served(s.scene, Localizer(s.scene, s.localizer.method, s.localizer.config, self.device))
            for name, s in self.maps.items()
        }
        return Worker(moved, _together(moved), self.max_pixels, self.folder, self.device)

    def answer(self, request: dict[str, Any], blocks: Mapping[str, bytes]) -> dict[str, Any]:
        """Return the status and body of the response to a request."""
        folder = self.folder / request["id"]
        try:
            folder.mkdir(mode=0o700)
            upload = Upload(request["parameters"], blocks)
            if request["map"] is None and self.together is not None:
                answer, plain = self._placed(self.together, upload, folder)
                return {"status": OK, "body": plain, "outcome": str(answer.found.outcome)}
            served = self.maps[request["map"]]
            if request["kind"] == "geopose":
                return geopose.answer(
                    served.scene.anchor, request["body"], lambda query: self._localize(served, query, folder)
                )
            answer, plain = self._localize(served, upload, folder)
            return {"status": OK, "body": plain, "outcome": str(answer.found.outcome)}
        except InputError as error:
            return {"status": UNUSABLE, "detail": str(error).replace(f"{folder}{os.sep}", "")}
        except (
            Exception
        ) as error:  # an internal error: the worker continues, and the log states what happened
            return {"status": FAULT, "detail": "internal error", "fault": f"{type(error).__name__}: {error}"}
        finally:
            shutil.rmtree(folder, ignore_errors=True)

    def _localize(self, served: Served, upload: Upload, folder: Path) -> tuple[Answer, dict[str, Any]]:
        """Localize a photo; return the answer, and its JSON values as printed by ``bidnerf localize --json``."""
        usual, background = (
            CameraSource(assumed=served.localizer.assumed_cameras),
            served.scene.bounds.background,
        )
        photos, start = upload.read(usual, background, folder, self.max_pixels)
        answers = localize_each(served.localizer, photos, start=lambda _: start, seed=upload.seed)
        (answer,) = answers.answers
        return answer, {**answers.plain(answer), "frame": upload.name}

    def _placed(self, maps: MapCollection, upload: Upload, folder: Path) -> tuple[Answer, dict[str, Any]]:
        """Localize a photo in the map that it shows; return the answer and its JSON values, with that map."""
        photos, start = upload.read(CameraSource(assumed=maps.cameras), None, folder, self.max_pixels)
        if start is not None:
            raise InputError("start was given without map", expected=f"map as one of {', '.join(self.maps)}")
        answers = localize_each(maps, photos, seed=upload.seed)
        (answer,) = answers.answers
        return answer, {**answers.plain(answer), "frame": upload.name}


def _together(maps: Mapping[str, Served]) -> MapCollection | None:
    """Return several maps as a collection that uses their localizers; None for a single one."""
    if len(maps) == 1:
        return None
    first = next(iter(maps.values())).localizer
    localizers = {name: served.localizer for name, served in maps.items()}
    scenes = {name: served.scene for name, served in maps.items()}
    return MapCollection(scenes, first.method, first.config, localizers=localizers)
