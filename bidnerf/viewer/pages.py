"""The page that shows a map and localizations in it, for notebooks, for the live viewer, and as a file that needs no server."""

from __future__ import annotations

import base64
import hashlib
import html
import json
import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

from bidnerf.results import BAD_INPUT
from bidnerf.viewer.answer import add_renderings, answer_json, no_answer
from bidnerf.viewer.pictures import JsonObject
from bidnerf.viewer.scene import map_json, trajectory_json
from bidnerf_core.datasets import Query, QuerySource
from bidnerf_core.errors import InputError, amount
from bidnerf_core.frames import Frame, View
from bidnerf_core.geometry import SE3
from bidnerf_core.io import to_plain, write_file
from bidnerf_core.localization import Localization, SearchRecord, record_search
from bidnerf_core.maps import Localizer, Map
from bidnerf_core.progress import counter, log


@dataclass(frozen=True, eq=False)
class MapView:
    """A page that shows a map and localizations in it; a notebook displays the page, and ``save`` writes it to a file."""

    map: JsonObject
    answers: tuple[JsonObject, ...] = ()
    title: str = ""
    live: bool = False  # whether a server answers
    queries: tuple[str, ...] = ()  # names of images that the server can localize
    trajectory: JsonObject | None = None
    results: tuple[JsonObject, ...] = ()
    hfov: float | None = None  # horizontal field of view (degrees) that the page's input field shows at first
    # whether photos without a field of view have a given camera, rather than that of EXIF or the map
    camera_given: bool = False

    def __repr__(self) -> str:
        """Return a one-line description that leaves out the page's content."""
        return f"<MapView of {self.map['name']} with {amount(len(self.answers), 'localization')}>"

    def _repr_html_(self) -> str:
        """Return the page in an iframe, as notebooks show it."""
        page = html.escape(self.html(), quote=True)
        return f'<iframe srcdoc="{page}" style="width:100%;height:620px;border:0" sandbox="allow-scripts"></iframe>'

    def html(self) -> str:
        """Return the whole page, whose content security policy allows only its own scripts and, if live, its own server."""
        # The characters that could end a script in a page or begin markup.
        escapes = str.maketrans({c: f"\\u{ord(c):04x}" for c in "<>&\u2028\u2029"})
        library, scripts = _part("three.min.js"), _part("page.min.js")
        server = "'self'" if self.live else "'none'"
        policy = (
            f"default-src 'none'; img-src data: blob: 'self'; style-src 'unsafe-inline'; "
            f"script-src {_digest(library)} {_digest(scripts)}; connect-src {server}; base-uri 'none'; form-action 'none'"
        )
        parts = {
            "policy": f'<meta http-equiv="Content-Security-Policy" content="{policy}">',
            "style": f"<style>{_part('style.css')}</style>",
            "state": json.dumps(to_plain(self), allow_nan=False, separators=(",", ":")).translate(escapes),
            "scripts": f'<script>{library}</script>\n<script type="module">{scripts}</script>',
        }
        return re.sub(r"<!-- (\w+) -->", lambda comment: parts[comment[1]], _part("index.html"))

    def save(self, path: str | Path) -> Path:
        """Write the page atomically to a file that opens without a server or a network.

        Raises ``InputError`` for a file extension other than .html or .htm, and if the file cannot be written.
        """
        path = Path(path)
        if path.suffix.lower() not in (".html", ".htm"):
            raise InputError("a page", where=path, expected="a name that ends with .html")
        write_file(path, self.html().encode())
        return path


@cache
def _part(name: str) -> str:
    return files(__package__).joinpath("page", name).read_text(encoding="utf-8")


@cache
def _digest(text: str) -> str:
    """Return the hash by which a content security policy identifies a script or style."""
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"


def view(
    scene: Map | Localizer,
    localization: Localization | None = None,
    frame: Frame | None = None,
    *,
    trajectory: str | Path | None = None,
    title: str = "",
) -> MapView:
    """Return a page that shows a map and a localization in it.

    If the ``frame`` that was localized is given, the page compares it with the map as rendered from the pose. A frame
    without a ``localization`` is localized first, and the page then shows the search too. ``scene`` is a map, or a
    localizer with its own settings, and ``trajectory`` is a file of poses. Raises ``InputError`` if ``scene`` is
    neither a map nor a localizer, and for a frame that cannot be localized at all.
    """
    scene_map = single_map(scene)
    answers = list[JsonObject]()
    if localization is not None:
        answer = answer_json(scene_map, "localization" if frame is None else frame.name, localization, frame)
        answers.append(answer if frame is None else add_renderings(answer, scene_map, localization, frame))
    elif frame is not None:
        answers.append(
            answer_query(
                scene if isinstance(scene, Localizer) else Localizer(scene_map),
                Query(frame.name, (View(frame, SE3.identity()),)),
            )
        )
    return MapView(
        map_json(scene_map),
        tuple(answers),
        title,
        trajectory=None if trajectory is None else trajectory_json(Path(trajectory), scene_map.unit, scene_map.origin),
    )


def single_map(scene: object) -> Map:
    """Return the given map, or the map of a localizer. Raises ``InputError`` for anything else."""
    scene = scene.scene if isinstance(scene, Localizer) else scene
    if not isinstance(scene, Map):
        raise InputError(f"scene is a {type(scene).__name__}", where="view", expected="a Map, such as load_map returns")
    return scene


def answer_query(
    localizer: Localizer,
    query: Query,
    start: SE3 | None = None,
    seed: int = 0,
    follow: Callable[[SearchRecord, JsonObject | None], None] | None = None,
) -> JsonObject:
    """Localize a query, and return the page's JSON values of the answer and its search. Raises ``InputError`` if it cannot be used.

    ``follow`` is called twice: before the search with its record, and before the field is rendered with the record
    and an answer whose pictures show the surface.
    """
    scene, frame = localizer.scene, query.frame
    with record_search() as record:
        if follow is not None:
            follow(record, None)
        localization = localizer(query.views, start, seed=seed)
    answer = answer_json(scene, query.name, localization, frame, record, query.truth)
    if follow is not None:
        follow(record, add_renderings(answer, scene, localization, frame, quick=True))
    return add_renderings(answer, scene, localization, frame)


def answer_all(localizer: Localizer, source: QuerySource) -> tuple[JsonObject, ...]:
    """Localize all queries of a source; if a query cannot be used, its answer states why. Raises ``InputError`` if none can be."""
    answers, count, total = list[JsonObject](), counter("localizing and rendering", "images"), len(source.names)
    for number, name in enumerate(source.names):
        try:
            answers.append(answer_query(localizer, source.read(number)))
        except InputError as error:
            log.info("%s: %s", name, error)
            answers.append(no_answer(name, BAD_INPUT, str(error)))
        count(number + 1, total)
    if answers and all(answer["outcome"] == BAD_INPUT for answer in answers):
        raise InputError(answers[0]["reason"])
    return tuple(answers)


def row_json(row: Any) -> JsonObject:
    """Return the JSON values of a row in the page's table, from a result of an evaluation.

    In ``row``, the pose and the covariance are lists of matrix rows. In the result, ``error`` holds the position
    error and the orientation error (degrees), ``sigma`` is the standard deviation of the position, and ``pose`` is
    the 16 numbers of T_world_camera in row-major order. Lengths are in the unit of the row.
    """
    variance = math.nan if row.covariance is None else sum(row.covariance[i][i] for i in range(3))
    return {
        "frame": row.frame,
        "method": row.method,
        "outcome": row.outcome,
        "accepted": row.converged,
        "reason": row.reason,
        "confidence": row.confidence,
        "error": None if row.error is None else (row.error.translation, row.error.rotation_deg),
        "sigma": math.sqrt(variance) if 0 <= variance < math.inf else None,
        "pose": None if row.T_world_camera is None else [float(value) for each in row.T_world_camera for value in each],
    }
