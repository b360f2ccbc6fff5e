"""The summary of a map for users."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from torch import nn

from bidnerf_core.captures import (
    CaptureReport,
    MovedCamera,
    PoseRefinement,
    UpDirection,
    moved_cameras,
    pose_sentences,
    sentences,
)
from bidnerf_core.errors import amount
from bidnerf_core.fields import SceneBounds, levels
from bidnerf_core.geometry import LengthUnit
from bidnerf_core.io import to_plain
from bidnerf_core.mapping import HeldOutTrial
from bidnerf_core.progress import duration_text

if TYPE_CHECKING:
    from bidnerf_core.maps.map import Map


@dataclass(frozen=True)
class SurfaceSize:
    """The size of a map's surface."""

    cell: float  # metres: side of a cell of its index
    cells: int  # number of stored cells
    MiB: float


@dataclass(frozen=True)
class MapSummary:
    """The facts about a map. ``str()`` gives a human-readable description, ``plain()`` a JSON object."""

    map: str  # its folder; empty for a map in memory
    backend: str
    data: str  # name of the dataset's folder
    cameras: int
    added: int  # of these cameras, after training
    unit: LengthUnit  # of all lengths
    up: UpDirection | None  # the upward direction in the world, and its source
    distances: bool  # whether the training images determine distances
    poses: PoseRefinement | None  # the consistency of the given poses, if known
    step: int
    complete: bool
    seconds: float  # of training
    levels: int
    parameters: int
    surfels: int
    surface: SurfaceSize | None
    landmarks: int
    trial: HeldOutTrial | None
    bytes: int | None  # total size of the files in its folder
    bounds: SceneBounds  # relative to the origin, as all positions in the map
    origin: tuple[float, float, float]  # of the map's own coordinates, in the world
    config: dict[str, Any]
    bidnerf: str  # the version that wrote it
    moved: tuple[MovedCamera, ...]  # by the refinement of poses
    capture: CaptureReport | None  # the capture record, if there is one
    colour_noise: float | None  # root mean square error of rendered colours on training images
    remarks: tuple[str, ...]  # sentences about the poses and the photos

    @staticmethod
    def of(scene: Map) -> MapSummary:
        """Return the summary of a map."""
        info, field, surface, folder = scene.info, scene.field, scene.surface, scene.folder
        refinement, capture = info.pose_refinement, scene.capture
        remarks = [] if refinement is None else pose_sentences(info.cameras, refinement)
        if capture is not None:
            remarks += sentences(capture)
        size, files = None, None
        if surface is not None:
            size = SurfaceSize(surface.cell, surface.stored_cells, round(surface.mebibytes, 1))
        if folder is not None:
            files = sum(file.stat().st_size for file in folder.iterdir() if file.is_file())
        landmarks = scene.landmarks
        return MapSummary(
            map="" if folder is None else str(folder),
            cameras=len(info.cameras),
            up=scene.up,
            poses=refinement,
            seconds=round(info.seconds, 1),
            levels=len(levels(field)),
            parameters=sum(p.numel() for p in field.parameters()) if isinstance(field, nn.Module) else 0,
            surfels=0 if surface is None else len(surface.surfels),
            surface=size,
            landmarks=0 if landmarks is None else len(landmarks),
            trial=None if landmarks is None else landmarks.trial,
            bytes=files,
            moved=tuple(moved_cameras(info.cameras)),
            capture=capture,
            remarks=tuple(remarks),
            **{
                name: getattr(info, name)
                for name in (
                    "backend",
                    "data",
                    "added",
                    "unit",
                    "distances",
                    "step",
                    "complete",
                    "bounds",
                    "origin",
                    "config",
                    "bidnerf",
                    "colour_noise",
                )
            },
        )

    def plain(self) -> dict[str, Any]:
        """Return the facts as JSON-serializable values."""
        facts: dict[str, Any] = to_plain(replace(self, remarks=()))
        del facts["remarks"]
        return facts

    def __str__(self) -> str:
        rows = [f"{key + ':':<12} {value}" for key, value in self._lines().items()]
        return "\n".join([*rows, *(f"- {remark}" for remark in self.remarks)])

    def _lines(self) -> dict[str, str]:
        photos = amount(self.cameras, "image") if self.cameras else "cameras not recorded"
        added = f", {self.added} of which were added later" if self.added else ""
        state = "complete" if self.complete else "not complete; 'bidnerf train --resume' continues it"
        time = duration_text(self.seconds)
        place = f"{self.map}, {(self.bytes or 0) / 2**20:.1f} MiB" if self.map else "in memory"
        field, frame = (
            f"{amount(self.parameters, 'parameter')} in {amount(self.levels, 'level')}",
            "lengths in ",
        )
        if self.colour_noise is not None:
            field += f", off by {self.colour_noise:.1%} of the range of colours on its training images (RMS)"
        frame += (
            "metres" if self.unit == "metres" else "units of unknown length ('bidnerf scale' gives metres)"
        )
        if self.up is not None:
            sources = {"gravity": "gravity", "planes": "planes and cameras", "cameras": "the cameras"}
            up = _shown(tuple(round(x, 4) for x in self.up.direction))
            frame += f"; up is {up}, by {sources[self.up.source]}"
        training = f"{self.step} steps of backend {self.backend} in {time}, {state}"
        if not self.step:
            training = "none; 'bidnerf train DATA --out MAP' trains a field and builds a surface"
            field = "none; landmarks alone localize photos"
        surface = "none; 'bidnerf bake MAP' builds it" if self.step else "none"
        if self.surface is not None:
            cells = f"{amount(self.surface.cells, 'cell')} with a side of {self.surface.cell:.3g}"
            surface = f"{amount(self.surfels, 'surfel')}, indexed by {cells}, {self.surface.MiB:.1f} MiB"
        bounds, beyond = self.bounds, "more" if self.bounds.contracted else "nothing"
        box = f"a box of {' x '.join(f'{side:.3g}' for side in bounds.size)} from {_shown(bounds.lower)}, {beyond} beyond it"
        box += f"; seen from {bounds.near:.3g} to {bounds.far:.3g}"
        unknown = {"distances": "unknown, since all images were taken from one place"}
        origin = {"origin": f"{_shown(self.origin)}, to which positions are relative"}
        return {
            "map": f"{place}, written by bidnerf {self.bidnerf}",
            "made from": f"{self.data or 'views in memory'}, {photos}{added}",
            "training": training,
            "field": field,
            "scene": f"{box} away; background {_shown(bounds.background)}",
            **(origin if any(self.origin) else {}),
            **({} if self.distances else unknown),
            "frame": frame,
            "surface": surface,
            "landmarks": str(self.landmarks or "none; 'bidnerf bake MAP --data DATA' builds them"),
            **({"settings": _shown(self.config)} if self.config else {}),
        }


def _shown(value: Any) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{key} {_shown(item)}" for key, item in value.items())
    if isinstance(value, list | tuple):
        return "(" + ", ".join(_shown(item) for item in value) + ")"
    return f"{value:.4g}" if isinstance(value, float) else str(value)
