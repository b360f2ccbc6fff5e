"""The page as one file: style, scripts and state within it, so that it opens without a server or a network."""

from __future__ import annotations

import base64
import hashlib
import re
from functools import cache
from importlib.resources import files
from pathlib import Path

from bidnerf_core.errors import InputError
from bidnerf_core.io import write_file
from bidnerf_core.viewer.page_state import PageState

MODULES = ("data", "space", "compare", "panel", "table", "track", "live", "main")
"""The modules of the page, each after those that it imports. They share one scope, so their names must differ."""
IMPORT = re.compile(r'^import \{[^}]*\} from "\./\w+\.js";\n', re.MULTILINE)


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
        "state": state.json(),
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
