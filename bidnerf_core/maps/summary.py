"""Summaries for users: the facts about a map, and how well it renders a photo."""

from __future__ import annotations

import textwrap
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

import torch
from jaxtyping import Float
from kornia.metrics import psnr
from torch import Tensor, nn

from bidnerf_core.captures import moved_cameras, pose_sentences, sentences
from bidnerf_core.errors import amount
from bidnerf_core.fields import RenderedImage, levels
from bidnerf_core.frames import Frame
from bidnerf_core.geometry import LengthUnit, symbol
from bidnerf_core.io import to_plain
from bidnerf_core.maps.description import MapInfo
from bidnerf_core.progress import duration_text

if TYPE_CHECKING:
    from bidnerf_core.maps.map import Map

DESCRIBED = (
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
"""The attributes of a map's description that its summary includes."""


@dataclass(frozen=True)
class MapSummary:
    """The facts about a map. ``str()`` gives a human-readable description, ``plain()`` a JSON object."""

    info: MapInfo
    facts: dict[str, Any]  # those that are not in the description
    remarks: tuple[str, ...]  # sentences about the poses and the photos

    @staticmethod
    def of(scene: Map) -> MapSummary:
        """Return the summary of a map."""
        info, field, surface, folder = scene.info, scene.field, scene.surface, scene.folder
        refinement, capture, landmarks = info.pose_refinement, scene.capture, scene.landmarks
        facts = {
            "map": "" if folder is None else str(folder),
            "cameras": len(info.cameras),
            "up": scene.up,
            "poses": refinement,
            "seconds": round(info.seconds, 1),
            "levels": len(levels(field)),
            "parameters": sum(p.numel() for p in field.parameters()) if isinstance(field, nn.Module) else 0,
            "surfels": 0 if surface is None else len(surface.surfels),
            "surface": None
            if surface is None
            else {
                "cell": surface.cell,  # side of a cell of its index
                "cells": len(surface.index.entries),  # one per cell near the surface, and one per several far from it
                "MiB": round(surface.mebibytes, 1),
            },
            "landmarks": 0 if landmarks is None else len(landmarks),
            "trial": None if landmarks is None else landmarks.trial,
            "bytes": None
            if folder is None
            else sum(file.stat().st_size for file in folder.iterdir() if file.is_file()),
            "moved": tuple(moved_cameras(info.cameras)),
            "capture": capture,
        }
        poses = [] if refinement is None else pose_sentences(info.cameras, refinement)
        return MapSummary(info, facts, (*poses, *([] if capture is None else sentences(capture, info.unit))))

    def plain(self) -> dict[str, Any]:
        """Return the facts as JSON-serializable values."""
        described = {name: getattr(self.info, name) for name in DESCRIBED} | {"backend": self.info.backend or None}
        return cast(dict[str, Any], to_plain(described | self.facts))

    def __str__(self) -> str:
        info, facts, bounds = self.info, self.facts, self.info.bounds
        up, surface = facts["up"], facts["surface"]
        is_rendered = info.landmark_source == "rendered images" and not info.seconds  # of a field trained elsewhere
        photos = (
            amount(len(info.cameras), "rendered image" if is_rendered else "image")
            if info.cameras
            else "cameras not recorded"
        )
        added = f", {info.added} of which were added later" if info.added else ""
        stored = f"{facts['map']}, {(facts['bytes'] or 0) / 2**20:.1f} MiB" if facts["map"] else "in memory"
        training = "none; 'bidnerf train DATA --out MAP' trains a field and builds a surface"
        field = "none; landmarks alone localize photos"
        built = "none"
        if info.step:
            state = (
                "complete" if info.complete else "not complete; 'bidnerf train DATA --out MAP --resume' continues it"
            )
            trained = f"{amount(info.step, 'step')} of backend {info.backend} in {duration_text(info.seconds)}, {state}"
            training = trained if info.seconds else f"none here: imported as a field of backend {info.backend}"
            field = f"{amount(facts['parameters'], 'parameter')} in {amount(facts['levels'], 'level')}"
            if info.colour_noise is not None:
                field += f", off by {info.colour_noise:.1%} of the range of colours on its training images (RMS)"
            built = "none; 'bidnerf bake MAP' builds it"
        if surface is not None:
            cells = f"{amount(surface['cells'], 'cell')} with a side of {surface['cell']:.3g}"
            built = f"{amount(facts['surfels'], 'surfel')}, indexed by {cells}, {surface['MiB']:.1f} MiB"
        unknown = "units of unknown length ('bidnerf scale' gives metres)"
        frame = f"lengths in {'metres' if info.unit == 'metres' else unknown}"
        if up is not None:
            sources = {"gravity": "gravity", "planes": "planes and cameras", "cameras": "the cameras"}
            frame += f"; up is {_shown(tuple(round(x, 4) for x in up.direction))}, by {sources[up.source]}"
        rows = {
            "map": f"{stored}, written by bidnerf {info.bidnerf}",
            "made from": f"{info.data or 'views in memory'}, {photos}{added}",
            "training": training,
            "field": field,
            "scene": f"a box of {' x '.join(f'{side:.3g}' for side in bounds.size)} from {_shown(bounds.lower)},"
            f" {'more' if bounds.contracted else 'nothing'} beyond it; seen from {bounds.near:.3g} to {bounds.far:.3g}"
            f" away; background {_shown(bounds.background)}",
            "origin": f"{_shown(info.origin)}, to which positions are relative" if any(info.origin) else "",
            "distances": "" if info.distances else "unknown, since all images were taken from one place",
            "frame": frame,
            "surface": built,
            "landmarks": str(facts["landmarks"] or "none; 'bidnerf bake MAP --data DATA' builds them"),
            "settings": f"\n{'':13}".join(textwrap.wrap(_shown(info.config), 100)),
        }
        lines = (f"{key + ':':<12} {value}" for key, value in rows.items() if value)
        return "\n".join([*lines, *(f"- {sentence}" for sentence in self.remarks)])


def _shown(value: Any) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{key} {_shown(item)}" for key, item in value.items())
    if isinstance(value, list | tuple):
        return "(" + ", ".join(_shown(item) for item in value) + ")"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


@dataclass(frozen=True, eq=False)
class RenderingScores:
    """The quality of a rendered image, compared with the photo from the same pose."""

    psnr: float  # dB
    depth_errors: Float[Tensor, "n"]  # absolute errors of planar z, at the pixels with measured depth
    unit: LengthUnit  # of the depth

    @property
    def depth_error(self) -> float | None:
        """The median absolute depth error; None without measured depth."""
        return float(self.depth_errors.median()) if len(self.depth_errors) else None

    def __str__(self) -> str:
        return (
            f"PSNR {self.psnr:.2f} dB  depth error"
            f" {'-' if self.depth_error is None else f'{self.depth_error:.4f}'} {symbol(self.unit)}"
        )


def rendering_scores(image: RenderedImage, frame: Frame, unit: LengthUnit = "units") -> RenderingScores:
    """Compare a rendered image with the visible colours and measured depth of a frame from the same pose.

    ``unit`` is the length unit of the map, used to print the depth error.
    """
    errors = torch.zeros(0) if frame.depth is None else (image.depth - frame.depth).abs()[frame.depth > 0]
    shown, seen = image.rgb, frame.rgb
    if frame.hidden is not None:
        shown, seen = shown[~frame.hidden], seen[~frame.hidden]
    return RenderingScores(float(psnr(shown, seen, 1.0)), errors, unit)
