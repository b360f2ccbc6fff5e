"""The complete content of a page, as JSON."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any

from bidnerf_core.io import to_plain
from bidnerf_core.viewer.answer import ShownAnswer
from bidnerf_core.viewer.scene import ShownMap
from bidnerf_core.viewer.table import ShownRow
from bidnerf_core.viewer.trajectories import ShownTrajectory

ESCAPED = str.maketrans({c: f"\\u{ord(c):04x}" for c in "<>&\u2028\u2029"})
"""JSON escapes of the characters that could end a script in a page or begin markup."""


@dataclass(frozen=True)
class PageState:
    """A map, and the localizations in it."""

    map: ShownMap
    answers: tuple[ShownAnswer, ...] = ()
    title: str = ""
    live: bool = False  # whether a server answers
    queries: tuple[str, ...] = ()  # names of images that the server can localize
    trajectory: ShownTrajectory | None = None
    results: tuple[ShownRow, ...] = ()
    hfov: float | None = None  # horizontal field of view (degrees) with which the page's field is filled in
    camera_given: bool = (
        False  # whether photos without a field of view have a given camera, not that of EXIF or the map
    )

    def json(self) -> str:
        """Return the state as JSON that is safe to embed in a script element."""
        return escaped_json(self)


def escaped_json(value: Any) -> str:
    """Return JSON without characters that could end a script element in which it is embedded."""
    return json.dumps(to_plain(value), allow_nan=False, separators=(",", ":")).translate(ESCAPED)
