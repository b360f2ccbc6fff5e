"""The page as one file: style, scripts and state within it, so that it opens without a server or a network."""

from __future__ import annotations

import base64
import hashlib
import json
import re
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from pathlib import Path

from bidnerf_core.errors import InputError
from bidnerf_core.io import to_plain, write_file
from bidnerf_core.viewer.answer import ShownAnswer
from bidnerf_core.viewer.packing import Json

MODULES = ("data", "space", "compare", "panel", "table", "track", "live", "main")
"""The modules of the page, each after those that it imports. They share one scope, so their names must differ."""
IMPORT = re.compile(r'^import \{[^}]*\} from "\./\w+\.js";\n', re.MULTILINE)

ESCAPED = str.maketrans({c: f"\\u{ord(c):04x}" for c in "<>&\u2028\u2029"})
"""JSON escapes of the characters that could end a script in a page or begin markup."""


@dataclass(frozen=True)
class PageState:
    """A map, and the localizations in it."""

    map: Json
    answers: tuple[ShownAnswer, ...] = ()
    title: str = ""
    live: bool = False  # whether a server answers
    queries: tuple[str, ...] = ()  # names of images that the server can localize
    trajectory: Json | None = None
    results: tuple[Json, ...] = ()
    hfov: float | None = None  # horizontal field of view (degrees) with which the page's field is filled in
    camera_given: bool = (
        False  # whether photos without a field of view have a given camera, not that of EXIF or the map
    )


def page_html(state: PageState) -> str:
    """Return the whole page. Its content security policy allows only its own scripts and, if live, its own server."""
    style, library, scripts = _part("style.css"), _part("three.min.js"), _scripts()
    server = "'self'" if state.live else "'none'"
    policy = (
        f"default-src 'none'; img-src data: blob: 'self'; style-src 'unsafe-inline'; "
        f"script-src {_digest(library)} {_digest(scripts)}; connect-src {server}; base-uri 'none'; form-action 'none'"
    )
    parts = {
        "policy": f'<meta http-equiv="Content-Security-Policy" content="{policy}">',
        "style": f"<style>{style}</style>",
        "state": json.dumps(to_plain(state), allow_nan=False, separators=(",", ":")).translate(ESCAPED),
        "scripts": f'<script>{library}</script>\n<script type="module">{scripts}</script>',
    }
    return re.sub(r"<!-- (\w+) -->", lambda found: parts[found[1]], _part("index.html"))


def save_page(state: PageState, path: str | Path) -> Path:
    """Write the page to a file atomically. Raises ``InputError`` for a file extension other than .html or .htm."""
    path = Path(path)
    if path.suffix.lower() not in (".html", ".htm"):
        raise InputError("a page", where=path, expected="a name that ends with .html")
    write_file(path, page_html(state).encode())
    return path


@cache
def _part(name: str) -> str:
    return files(__package__).joinpath("page", name).read_text(encoding="utf-8")


@cache
def _scripts() -> str:
    """Return the modules of the page, joined into one script."""
    texts = (IMPORT.sub("", _part(f"{name}.js")).replace("\nexport ", "\n") for name in MODULES)
    return "\n".join(texts)


@cache
def _digest(text: str) -> str:
    """Return the hash by which a content security policy identifies a script or style."""
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"
