"""``bidnerf-import-nerf-pytorch``: conversion of a checkpoint to a map without surface and landmarks."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

import tyro

from bidnerf_core.errors import InputError
from bidnerf_core.io import to_plain
from bidnerf_core.maps import UNMOVED, MapInfo, map_folder, write_parts
from bidnerf_core.training import TrainingState
from bidnerf_nerf_pytorch.importer import Box, ImportSettings, importer

NAME = "bidnerf-import-nerf-pytorch"
DONE, BAD_INPUT, INTERRUPTED = 0, 1, 130


def import_checkpoint(
    checkpoint: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="CHECKPOINT")],
    out: Annotated[Path, tyro.conf.arg(metavar="MAP")],
    near: float = 2.0,
    far: float = 6.0,
    background: Literal["white", "black"] = "white",
    box: Box = (-1.5, -1.5, -1.5, 1.5, 1.5, 1.5),
    coarse_samples: int = 64,
    fine_samples: int = 64,
    octaves: bool = True,
    overwrite: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False,
) -> None:
    """Turn a checkpoint of krrish94/nerf-pytorch into a map.

    'bidnerf import' does so too, and bakes the surface and the landmarks. The map's world is the one that the networks were trained in: for Blender's scenes that of transforms_*.json.

    Args:
        checkpoint: file that nerf-pytorch wrote (checkpoint*.ckpt)
        out: folder for the map
        near: distance along a ray before which there is nothing, in the scene's unit
        far: distance along a ray beyond which there is nothing
        background: colour where a ray meets nothing
        box: lower and upper corner of the scene; nothing outside is rendered
        coarse_samples: places on a ray at which the coarse network is evaluated
        fine_samples: further places at which the fine network is evaluated
        octaves: whether frequencies double (nerf-pytorch's log_sampling), which no weight shows
        overwrite: replace the map in --out
    """
    settings = ImportSettings(near, far, background, box, coarse_samples, fine_samples, octaves)
    found = importer.read(checkpoint, settings, UNMOVED)
    plain = to_plain(found.config, "config")
    info = MapInfo(found.backend, plain, found.bounds, found.steps, True, checkpoint.name)
    with map_folder(out, overwrite):
        write_parts(out, info, TrainingState(found.steps, found.tensors, {}))
    print(f"{out}: {'; '.join(found.found)}", file=sys.stderr)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return 0, 1 (with one line on stderr) for bad input, or 2 for wrong usage."""
    try:
        tyro.cli(import_checkpoint, args=arguments, prog=NAME)
    except SystemExit as stopped:  # the parser has printed its message
        return stopped.code if isinstance(stopped.code, int) else DONE
    except KeyboardInterrupt:
        return _failed("interrupted", INTERRUPTED)
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        return _failed(f"{where}{error.strerror or error}", BAD_INPUT)
    except InputError as error:
        return _failed(str(error), BAD_INPUT)
    return DONE


def _failed(message: str, status: int) -> int:
    print(f"{NAME}: {' '.join(message.splitlines())}", file=sys.stderr)
    return status
