"""Reading the baked parts of a map, each from a file of its own."""

from __future__ import annotations

import json
from pathlib import Path

from bidnerf_core.captures.report import CaptureReport
from bidnerf_core.errors import InputError
from bidnerf_core.io.serialization import from_plain
from bidnerf_core.mapping import SurfaceMap, surface_from_tensors
from bidnerf_core.mapping.landmark_tensors import landmarks_from_tensors
from bidnerf_core.mapping.landmarks import LandmarkMap
from bidnerf_core.maps.tensors import load_part


def load_surface(path: Path) -> SurfaceMap:
    """Return the baked surface of a map. Raises ``InputError`` where the file does not hold the tensors of one."""
    return load_part(path, surface_from_tensors, "a baked surface")


def load_landmarks(path: Path) -> LandmarkMap:
    """Return the landmarks of a map. Raises ``InputError`` where the file does not hold the tensors of landmarks."""
    return load_part(path, landmarks_from_tensors, "landmarks")


def load_capture(path: Path) -> CaptureReport:
    """Return the record of a capture. Raises ``InputError`` where the file does not hold one."""
    try:
        found = json.loads(path.read_bytes())
    except FileNotFoundError as error:
        raise InputError(
            f"{path}: missing, although the map names it; bake the map again with --data"
        ) from error
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(
            f"{path}: not JSON ({error}), expected the record of a capture; bake the map again with --data"
        ) from error
    return from_plain(CaptureReport, found, str(path))
