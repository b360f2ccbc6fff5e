"""The file ``map.json`` of a map, as JSON; finding and reading it needs no torch."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from bidnerf_core.errors import InputError
from bidnerf_core.installation import with_writer
from bidnerf_core.io import read_json

VERSION = 1
DESCRIPTION = "map.json"


def read_description(folder: Path) -> dict[str, Any]:
    """Return the values in the ``map.json`` of a map. Raises ``InputError`` unless it is that of a map of this version."""
    path = folder / DESCRIPTION
    if not folder.is_dir():
        raise InputError(
            "is a file" if folder.exists() else "no such folder",
            where=folder,
            expected="a map: a folder as written by 'bidnerf train'",
        )
    if not path.exists():
        inside = "".join(f", such as {map} in it" for map in maps_in(folder)[:1])
        raise InputError(
            f"no {DESCRIPTION} found", where=folder, expected=f"a map as written by 'bidnerf train'{inside}"
        )
    found = read_json(path, "the description of a map")
    if not isinstance(found, dict) or found.get("format") != "bidnerf map":
        raise InputError("not the description of a map", where=path, expected='"format": "bidnerf map"')
    if found.get("version") != VERSION:
        newer = isinstance(found.get("version"), int) and found["version"] > VERSION
        expected = f"{VERSION}; {'it was written by a newer bidnerf; upgrade bidnerf' if newer else 'retrain the map'}"
        raise with_writer(
            InputError(f"version {found.get('version')!r}", where=path, expected=expected), found.get("bidnerf")
        )
    return found


def maps_in(folder: Path) -> list[Path]:
    """Return the folder itself if it is a map, else its subfolders that are maps, by name."""
    if (folder / DESCRIPTION).exists():
        return [folder]
    return sorted(path.parent for path in folder.glob(f"*/{DESCRIPTION}"))
