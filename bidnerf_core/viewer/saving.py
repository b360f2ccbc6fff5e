"""The page as one file: style, scripts and state within it, so that it opens without a server or a network."""

from __future__ import annotations

import base64
import hashlib
import html
import json
import re
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from pathlib import Path

from bidnerf_core.errors import InputError, amount
from bidnerf_core.io import to_plain, write_file
from bidnerf_core.viewer.packing import Json

MODULES = ("data", "space", "compare", "panel", "table", "track", "live", "main")
"""The modules of the page, each after those that it imports. They share one scope, so their names must differ."""
IMPORT = re.compile(r'^import \{[^}]*\} from "\./\w+\.js";\n', re.MULTILINE)

ESCAPED = str.maketrans({c: f"\\u{ord(c):04x}" for c in "<>&\u2028\u2029"})
"""JSON escapes of the characters that could end a script in a page or begin markup."""


@dataclass(frozen=True, eq=False)
class MapView:
    """The page of a map and of localizations in it, which a notebook shows and ``save`` writes to a file."""

    map: Json
    answers: tuple[Json, ...] = ()
    title: str = ""
    live: bool = False  # whether a server answers
    queries: tuple[str, ...] = ()  # names of images that the server can localize
    trajectory: Json | None = None
    results: tuple[Json, ...] = ()
    hfov: float | None = None  # horizontal field of view (degrees) with which the page's field is filled in
    # whether photos without a field of view have a given camera, not that of EXIF or the map
    camera_given: bool = False

    def __repr__(self) -> str:
        """Return a one-line description, without the content of the page."""
        return f"<MapView of {self.map['name']} with {amount(len(self.answers), 'localization')}>"

    def _repr_html_(self) -> str:
        """Return the page in an iframe, as notebooks show it."""
        page = html.escape(self.html(), quote=True)
        return f'<iframe srcdoc="{page}" style="width:100%;height:620px;border:0" sandbox="allow-scripts"></iframe>'

    def html(self) -> str:
        """Return the whole page. Its content security policy allows only its own scripts and, if live, its own server."""
        library, scripts = _part("three.min.js"), _scripts()
        server = "'self'" if self.live else "'none'"
        policy = (
            f"default-src 'none'; img-src data: blob: 'self'; style-src 'unsafe-inline'; "
            f"script-src {_digest(library)} {_digest(scripts)}; connect-src {server}; base-uri 'none'; form-action 'none'"
        )
        parts = {
            "policy": f'<meta http-equiv="Content-Security-Policy" content="{policy}">',
            "style": f"<style>{_part('style.css')}</style>",
            "state": json.dumps(to_plain(self), allow_nan=False, separators=(",", ":")).translate(ESCAPED),
            "scripts": f'<script>{library}</script>\n<script type="module">{scripts}</script>',
        }
        return re.sub(r"<!-- (\w+) -->", lambda found: parts[found[1]], _part("index.html"))

    def save(self, path: str | Path) -> Path:
        """Write the page to a file that opens without a server or a network, in one atomic step.

        Raises ``InputError`` for a file extension other than .html or .htm, and for a file that cannot be written.
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
def _scripts() -> str:
    """Return the modules of the page, joined into one script."""
    texts = (IMPORT.sub("", _part(f"{name}.js")).replace("\nexport ", "\n") for name in MODULES)
    return "\n".join(texts)


@cache
def _digest(text: str) -> str:
    """Return the hash by which a content security policy identifies a script or style."""
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"
