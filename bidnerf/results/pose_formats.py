"""The formats of pose files, which the ending of a name selects; checking a name needs neither torch nor a writer."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

from bidnerf_core.errors import InputError, UsageError
from bidnerf_core.registry import Plugins, interface_defects

if TYPE_CHECKING:
    from bidnerf.results.pose_files import PosedImage

HEAD = "# written by bidnerf"
"""The beginning of the comments in files that stand beside others of a COLMAP model."""

PoseWriter: TypeAlias = "Callable[[Path, Sequence[PosedImage]], None]"
"""A function that writes poses to a file atomically.

If it takes ``refused`` as well, it also gets a line of text for each image without an accepted pose, for comments.
"""

POSE_WRITERS: Plugins[PoseWriter] = Plugins(
    "writers", partial(interface_defects, attributes=(), methods={"__call__": ("path", "images")})
)
"""Writers by file-name ending; if several match, the longest ending is used.

The first line of a writer's docstring describes its format in lists. ``list_plugins("writers")`` lists the endings without
importing the writers.
"""


def pose_format(path: Path) -> str:
    """Return the file-name ending that selects the format of a pose file.

    Raises ``UsageError`` for a name without a known ending.
    """
    ending = max((e for e in POSE_WRITERS if path.name.lower().endswith(e)), key=len, default=None)
    if ending is None:
        found = f"no format of poses has the ending {path.suffix}" if path.suffix else "has no ending"
        raise UsageError(found, where=path, expected=f"a name that ends with {', '.join(POSE_WRITERS)}")
    return ending


def check_pose_file(path: Path) -> None:
    """Check that a pose file may be written under this name, before any work is done.

    Raises ``UsageError`` for a name without the ending of a known format, and ``InputError`` for an
    images.txt next to another program's cameras.txt or points3D.txt, which would be overwritten.
    """
    if pose_format(path) != "images.txt":
        return
    for beside in (path.with_name("cameras.txt"), path.with_name("points3D.txt")):
        if beside.exists() and HEAD not in beside.read_text(errors="replace")[:100]:
            raise InputError(
                "would be replaced, since a COLMAP model has one;",
                where=beside,
                expected=f"{path.name} in a folder without another model",
            )


def refused_file(path: Path) -> Path:
    """Return the file beside a pose file that names the images without an accepted pose."""
    return path.with_name(f"{path.name[: -len(path.suffix)]}.refused.txt")
