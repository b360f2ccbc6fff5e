"""Storage of maps as JSON and safetensors files, which cannot execute code when read.

``map.json`` describes the map and names the files of its parts. Parts are first written under new names, and
``map.json`` is replaced atomically at the end, so that an interruption always leaves one complete map in the
folder.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import math
import os
import re
import secrets
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, cast

import torch
from safetensors.torch import save as tensors_to_bytes
from torch import Tensor, nn

from bidnerf_core.backend import UpgradingField, load_backend
from bidnerf_core.captures import CaptureReport, StoredCamera
from bidnerf_core.errors import InputError, amount, errors_in
from bidnerf_core.fields import NoField, RadianceField, ScaledField, SceneBounds, trained_field
from bidnerf_core.io import (
    from_plain,
    load_part,
    output_folder,
    pack_tensors,
    read_json,
    read_tensors,
    to_plain,
    write_file,
)
from bidnerf_core.mapping import (
    LandmarkMap,
    SurfaceMap,
    landmark_tensors,
    landmarks_from_tensors,
    surface_from_tensors,
    surface_tensors,
)
from bidnerf_core.maps.description import ANCHOR, PART_NAMES, MapInfo, load_info
from bidnerf_core.maps.description_file import DESCRIPTION
from bidnerf_core.progress import Progress, current_job, log
from bidnerf_core.registry import PluginError
from bidnerf_core.training import TrainingState, TrainingStep

NEEDED = "a safetensors file, without which the map is incomplete; copy its folder again"
BAKED = "a safetensors file, which 'bidnerf bake' can recreate"
_NAMES = r"((weights|training|surface|landmarks)-\d{8,}-[0-9a-f]{8}\.safetensors|capture-\d{8,}-[0-9a-f]{8}\.json)"
OURS = re.compile(rf"{_NAMES}|\.({_NAMES}|map\.json)\.[0-9a-f]{{8}}")
"""Pattern of the names of files that saving, also by earlier versions, may leave behind. Other files are never removed."""


USUAL_SECONDS = 60.0
"""Time between checkpoints (seconds)."""
MATCHES = "training-000000000-*.safetensors"
"""Pattern of the file with the tracks of a training that has not written the description of its map yet."""
MATCHES_STAY = "the matches of its keypoints are kept, and the same command goes on from there"


@dataclass(frozen=True)
class PartFile:
    """How one kind of map part is written to its file and read from it."""

    encode: Callable[[Any], bytes]
    read: Callable[[Path], Any]
    ending: str = "safetensors"


def _json(value: Any) -> bytes:
    return json.dumps(to_plain(value), indent=1, allow_nan=False).encode()


_STATE = PartFile(lambda tensors: tensors_to_bytes(pack_tensors(tensors)), lambda path: read_tensors(path, NEEDED))
STORED_PARTS = {
    "weights": _STATE,
    "training": _STATE,
    "surface": PartFile(
        lambda surface: tensors_to_bytes(surface_tensors(surface)),
        lambda path: load_part(path, surface_from_tensors, "a baked surface", BAKED),
    ),
    "landmarks": PartFile(
        lambda landmarks: tensors_to_bytes(landmark_tensors(landmarks)),
        lambda path: load_part(path, landmarks_from_tensors, "landmarks", BAKED),
    ),
    "capture": PartFile(
        _json,
        lambda path: from_plain(
            CaptureReport,
            read_json(path, "a capture record, which 'bidnerf bake' with the dataset (`data`) can recreate"),
            str(path),
        ),
        "json",
    ),
}
"""The parts of a map, by the keys of ``map.json`` that name their files."""


def write_parts(
    folder: Path,
    info: MapInfo,
    state: TrainingState | None = None,
    surface: SurfaceMap | None = None,
    landmarks: LandmarkMap | None = None,
    capture: CaptureReport | None = None,
    keep: bool = False,
) -> MapInfo:
    """Write parts of the map described by ``info``, and return the description with their file names.

    With ``state``, the parts form a complete map that replaces the map in the folder. Parts that are not given,
    such as a surface baked from earlier weights, are then dropped; with ``keep``, the landmarks named by
    ``info`` stay, since landmarks do not depend on the weights. Without ``state``, the parts are added to the
    map in the folder and replace its existing parts of the same kind; from ``info``, only the source of the
    landmarks (with landmarks) and the colour error (with landmarks or a capture record) are stored. The caller
    must hold the folder's lock.

    Raises ``InputError`` for landmarks whose detector has no name, so that queries could not use it, and if the
    map was retrained while a part was built.
    """
    if landmarks is not None and not landmarks.features:
        raise InputError("the landmarks' detector has no name;", where=folder, expected="a registered one")
    given: dict[str, Any] = {
        "surface": surface,
        "landmarks": landmarks,
        "capture": capture,
        "weights": None if state is None else state.field,
        "training": None if state is None or info.complete else state.optimizer,
    }
    contents = {part: content for part, content in given.items() if content is not None}
    if state is not None and info.complete:
        _drop_matches(folder)  # the disk may have no place for both
    names: dict[str, Any] = {
        part: f"{part}-{info.step:08d}-{secrets.token_hex(4)}.{STORED_PARTS[part].ending}" for part in contents
    }
    if state is not None:
        names = dict.fromkeys(PART_NAMES) | ({"landmarks": info.landmarks} if keep else {}) | names
    else:
        stored = load_info(folder)
        if stored.weights != info.weights:
            raise InputError(f"was retrained while its {next(iter(contents))} was built; bake it again", where=folder)
        if landmarks is not None:
            names |= {"landmark_features": landmarks.features, "landmark_source": info.landmark_source}
        if landmarks is not None or capture is not None:
            names |= {"colour_noise": info.colour_noise}
        info = stored
    if state is not None and names["landmarks"] is None:
        names |= {"landmark_source": None, "colour_noise": None}
    info = replace(info, **names)
    description = _json(info)
    folder.mkdir(parents=True, exist_ok=True)
    # The content of a user-written ``anchor.json`` moves into the description of the map in the folder. Even if writing
    # is then interrupted, the anchor never ends up next to the description of another map.
    if (folder / ANCHOR).exists():
        with contextlib.suppress(InputError):  # no map to which the anchor could belong, or a damaged one
            write_file(folder / DESCRIPTION, _json(load_info(folder)))
            (folder / ANCHOR).unlink()
    try:
        for part, content in contents.items():
            write_file(folder / names[part], STORED_PARTS[part].encode(content))
        write_file(folder / DESCRIPTION, description)
    finally:
        _sweep(folder)
    return info


class Checkpoints:
    """The ``Report`` of a training run, which saves checkpoints.

    States are saved to ``folder``, or not at all if that is None; ``info`` describes the last saved state.
    Progress is reported to the current job, which may also stop the training. ``state`` is the training state
    to resume from, ``seconds`` is the time between checkpoints, ``landmarks`` are stored with the first
    checkpoint if they are not in the folder yet, and ``beside`` with the state of each.
    """

    def __init__(
        self,
        info: MapInfo,
        folder: Path | None = None,
        state: TrainingState | None = None,
        seconds: float = USUAL_SECONDS,
        landmarks: LandmarkMap | None = None,
        beside: Mapping[str, Tensor] = MappingProxyType({}),
    ) -> None:
        self.info, self.folder, self._beside = info, folder, beside
        self._state, self._seconds, self._job = state, seconds, current_job()
        self._step = self._total = info.step
        self._landmarks = landmarks
        self._earlier, self._began = info.seconds, time.monotonic()
        self._saved = self._began

    @property
    def stopping(self) -> bool:
        return self._job.cancel is not None and self._job.cancel()

    def resume(self) -> TrainingState | None:
        return self._state

    def step(self, progress: TrainingStep) -> None:
        self._state = None  # free it: it is as large as the field and its optimizer
        self._step, self._total = progress.step, progress.total
        if self._job.progress is not None:
            figures = f"loss {progress.loss:.5f}  PSNR {progress.psnr:.2f} dB"
            if not math.isnan(progress.samples_per_ray):  # not every recipe reports it
                figures += f"  {progress.samples_per_ray:.1f} samples per ray"
            self._job.progress(Progress("training", progress.step, progress.total, "steps", figures))

    def due(self, step: int) -> bool:
        return step == self._total or (self.folder is not None and time.monotonic() - self._saved > self._seconds)

    def save(self, state: TrainingState) -> None:
        seconds = self._earlier + time.monotonic() - self._began
        info = replace(self.info, step=state.step, complete=state.step >= self._total, seconds=seconds)
        if self.folder is not None:
            if info.weights:  # the first save may replace another map, whose anchor does not count
                info = replace(info, anchor=load_info(self.folder).anchor)
            state = replace(state, optimizer={**state.optimizer, **self._beside})
            info = write_parts(self.folder, info, state, landmarks=self._landmarks, keep=True)
            self._landmarks = None
        self.info = info
        self._saved = time.monotonic()

    def finish(self, field: RadianceField) -> None:
        """Save the trained field if the backend ended without saving a complete state."""
        if not self.info.complete and isinstance(field, nn.Module):
            self._total = self._step
            self.save(TrainingState(self._step, field.state_dict(), {}))


def load_state(
    folder: Path, info: MapInfo, field: RadianceField, optimizer: dict[str, Tensor] | None = None
) -> TrainingState:
    """Return the state from which to resume the training of ``field``, reading that of the ``optimizer`` unless it is given.

    Raises ``InputError`` if training is complete.
    """
    if info.training is None:
        raise InputError(f"training is complete ({amount(info.step, 'step')}), nothing to resume", where=folder)
    weights = check_weights(trained_field(field), read_part(folder, info, "weights"), folder / info.weights)
    return TrainingState(info.step, weights, optimizer or read_part(folder, info, "training"))


def read_part(folder: Path, info: MapInfo, part: str) -> Any:
    """Return a part of the map that ``info`` describes: its "surface", "landmarks", "capture" record and so on.

    The result is None if the map has no such part. Raises ``InputError`` if its file is damaged.
    """
    name = getattr(info, part)
    found = STORED_PARTS[part].read(folder / name) if name else None
    return with_images(found, info) if part == "landmarks" and found is not None else found


def with_images(landmarks: LandmarkMap, info: MapInfo) -> LandmarkMap:
    """Return the landmarks with the cameras and the detector name that the map's description records."""
    return replace(
        landmarks, cameras=tuple(camera.intrinsics for camera in info.cameras), features=info.landmark_features
    )


def with_tracks_in(info: MapInfo, landmarks: LandmarkMap, names: Sequence[str]) -> LandmarkMap:
    """Return landmarks that were built from the images ``names``, with tracks renumbered to the images of the map."""
    if landmarks.tracks is None:
        return landmarks
    numbers = {camera.name: number for number, camera in enumerate(info.cameras)}
    return replace(
        landmarks, tracks=landmarks.tracks.renumber(images=torch.tensor([numbers.get(name, -1) for name in names]))
    )


def check_weights(field: RadianceField, tensors: dict[str, Tensor], path: Path) -> dict[str, Tensor]:
    """Check the tensors of a field from a file, after upgrading those of earlier versions, and return them.

    Names, shapes and values are checked against the field here, since torch's own error message would take many
    lines.
    """
    if isinstance(field, UpgradingField):
        with errors_in(path):
            tensors = field.upgraded_state(tensors)
    module = cast(nn.Module, field)
    expected, trained = module.state_dict(), {name for name, _ in module.named_parameters()}
    for name, value in expected.items():
        if name not in tensors:
            raise InputError(f"no tensor {name!r}", where=path, expected=f"one of shape {list(value.shape)}")
        found = tensors[name]
        if (found.shape, found.is_floating_point()) != (value.shape, value.is_floating_point()):
            kinds = [f"dtype {t.dtype}, shape {list(t.shape)}".replace("torch.", "") for t in (found, value)]
            raise InputError(f"tensor {name!r} has {kinds[0]}", where=path, expected=kinds[1])
        # Products of larger weights would overflow in float32; trained weights are far smaller.
        largest = 1e9 if name in trained else math.inf
        if found.is_floating_point() and not bool((found.abs() <= largest).all()):
            raise InputError(
                f"tensor {name!r} holds NaN" + (f" or numbers above {largest:g}" if name in trained else ""),
                where=path,
                expected="trained weights",
            )
    if surplus := sorted(tensors.keys() - expected.keys()):
        raise InputError(f"tensor {surplus[0]!r} is not part of the field that map.json describes", where=path)
    return tensors


def build_frozen_field(info: MapInfo, tensors: dict[str, Tensor], folder: Path | None = None) -> RadianceField:
    """Build the field described by ``info`` with the weights ``tensors``; no parameter requires a gradient.

    ``folder`` is the map's folder, for error messages. Raises ``InputError`` if the backend cannot build the
    field, or the weights do not match it.
    """
    if not info.step:
        return info.in_map_unit(NoField())
    where, path, checked = str((folder or Path()) / DESCRIPTION), (folder or Path()) / info.weights, False
    # The backend is loaded outside the context below, in which the tensors of its module would have no
    # values.
    load_backend(info.backend, where)
    try:  # only the shapes, before memory is allocated for a field of whatever size map.json describes
        with torch.device("meta"):
            outline = build_field(info, where)
    except InputError:
        raise
    except Exception:  # a backend may raise anything for missing values
        log.debug("%s: backend %r needs real tensors to build its field", where, info.backend)
    else:
        tensors, checked = check_weights(outline, tensors, path), True
    field = build_field(info, where)
    if not checked:
        tensors = check_weights(field, tensors, path)
    cast(nn.Module, field).load_state_dict(tensors)
    cast(nn.Module, field).requires_grad_(False).eval()
    return info.in_map_unit(field)


def build_field(info: MapInfo, where: str) -> RadianceField:
    """Build the untrained field (an ``nn.Module``) that ``info`` describes.

    Raises ``InputError`` as ``build_frozen_field`` does.
    """
    backend = load_backend(info.backend, where)
    config: Any = from_plain(backend.config_type, info.config, f"{where}: config")
    try:
        field = backend.build(config, info.bounds if info.field_frame is None else info.field_frame.bounds)
    except ValueError as error:
        raise InputError(f"backend {info.backend!r} rejects its config: {error}", where=where) from error
    if not (isinstance(field, nn.Module) and isinstance(field, RadianceField)):
        raise InputError(
            f"backend {info.backend!r} built a {type(field).__name__}",
            where=where,
            expected="an nn.Module with query and sampler",
        )
    return field


def check_backend(backend: str, config: dict[str, Any], where: str) -> None:
    """Raise ``InputError`` unless a backend builds a field whose values have the right shapes, for some bounds."""
    bounds = SceneBounds((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0), 0.1, 6.0)
    values = build_field(MapInfo(backend, config, bounds, 0, False), where).query(torch.zeros(2, 3), torch.eye(3)[:2])
    shapes = tuple(values.density.shape), tuple(values.rgb.shape)
    if shapes != ((2,), (2, 3)):
        raise PluginError(
            f"the field of backend {backend!r} returned density and rgb of shapes {shapes[0]} and {shapes[1]} at 2 points",
            expected="(2,) and (2, 3), see FieldValues",
        )


def matches_file(folder: Path, cameras: Sequence[StoredCamera], features: str) -> Path:
    """Return the file in which a training keeps the tracks of these images' keypoints until its map has a description."""
    digest = hashlib.blake2b(repr((cameras, features)).encode(), digest_size=4).hexdigest()
    return folder / MATCHES.replace("*", digest)


def content_digest(field: RadianceField, surface: SurfaceMap | None, landmarks: LandmarkMap | None) -> str:
    """Return a hexadecimal digest of the content of a map: the weights of its field, its surface and its landmarks."""
    trained, hashed = trained_field(field), hashlib.blake2b(digest_size=8)
    if isinstance(field, ScaledField):
        hashed.update(repr(field.scale).encode())
    weights = trained.state_dict() if isinstance(trained, nn.Module) else None
    for part, content in (("weights", weights), ("surface", surface), ("landmarks", landmarks)):
        if content is not None:
            hashed.update(STORED_PARTS[part].encode(content))
    return hashed.hexdigest()


@contextlib.contextmanager
def map_folder(out: Path, overwrite: bool) -> Iterator[None]:
    """Prepare a folder for a map and hold its lock within the context, see ``output_folder``; an error leaves no matches there."""

    def describe(folder: Path) -> str | None:
        try:
            stopped = load_info(folder).interruption
        except InputError:
            return None
        return None if stopped is None else f"holds a map, and {stopped}"

    def is_leftover(file: Path) -> bool:  # of a process that was killed before the map had a description
        return OURS.fullmatch(file.name) is not None and not (out / DESCRIPTION).exists()

    with output_folder(out, overwrite, is_leftover, describe):
        try:
            yield
        except (InputError, OSError):
            _drop_matches(out)
            raise


def _drop_matches(folder: Path) -> None:
    """Remove the tracks of a training that needs them no more."""
    for file in folder.glob(MATCHES):
        file.unlink()


def _sweep(folder: Path) -> None:
    """Remove files of earlier and interrupted saves that ``map.json`` does not name; none if ``map.json`` is damaged."""
    path = folder / DESCRIPTION
    try:
        found = read_json(path, "the description of a map") if os.path.lexists(path) else {}
        listed = {name for part in PART_NAMES if isinstance(name := found.get(part), str)}
    except (InputError, AttributeError):
        return
    for file in list(folder.iterdir()):
        if OURS.fullmatch(file.name) and file.name not in listed:
            with contextlib.suppress(OSError):  # a left-over file does no harm
                file.unlink()
