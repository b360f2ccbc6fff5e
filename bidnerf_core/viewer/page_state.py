"""All that a page shows, as JSON."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any

from bidnerf_core.io.json import to_plain
from bidnerf_core.viewer.answer import ShownAnswer
from bidnerf_core.viewer.scene import ShownMap
from bidnerf_core.viewer.table import ShownRow
from bidnerf_core.viewer.trajectories import ShownTrajectory

ESCAPED = str.maketrans({c: f"\\u{ord(c):04x}" for c in "<>&\u2028\u2029"})
"""Characters that could end a script in a page or begin markup, as JSON writes them in other words."""


@dataclass(frozen=True)
class PageState:
    """A map, and what was localized in it."""

    map: ShownMap
    answers: tuple[ShownAnswer, ...] = ()
    title: str = ""
    live: bool = False  # whether a server answers
    queries: tuple[str, ...] = ()  # names of images that the server can localize
    trajectory: ShownTrajectory | None = None
    results: tuple[ShownRow, ...] = ()

    def json(self) -> str:
        """Return the state as JSON that may stand inside of a script of a page."""
        return escaped_json(self)


def escaped_json(value: Any) -> str:
    """Return JSON in which no character can end the script that it stands in."""
    return json.dumps(to_plain(value), allow_nan=False, separators=(",", ":")).translate(ESCAPED)
