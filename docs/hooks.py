"""MkDocs hook: what the documentation takes from the code and the README, so that it cannot contradict them.

The first page of the site is the README, and the page of all measurements is that of ``benchmarks/results``. In a page, ``<!-- settings of METHOD -->`` becomes the table of that method's settings,
and ``<!-- names of bidnerf -->`` the reference of all names that can be imported from ``bidnerf`` itself.
"""

from __future__ import annotations

import ast
import dataclasses
import inspect
import io
import math
import re
import textwrap
import tokenize
import typing
from pathlib import Path
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

import bidnerf
import bidnerf_core
from bidnerf_core.localization import METHODS
from bidnerf_core.settings import EXPERT, Above, OneOf, Range

SETTINGS = re.compile(r"^<!-- settings of ([a-z-]+) -->$", re.MULTILINE)
NAMES = "<!-- names of bidnerf -->"
HEAD = "| setting | default | values | meaning |\n| --- | --- | --- | --- |\n"
ROOT = Path(__file__).parents[1]
LINK = re.compile(r"\[([^\]]+)\]\((?!https?:)([^)]+)\)")


def on_files(files: Files, *, config: MkDocsConfig) -> Files:
    """Add the README as the first page, and the measurements that are kept beside the records."""
    for name, file in {"index.md": "README.md", "measurements.md": "benchmarks/results/README.md"}.items():
        files.append(File.generated(config, name, content=page_of_site((ROOT / file).read_text(encoding="utf-8"))))
    return files


def page_of_site(text: str) -> str:
    """Return a file from outside of the documentation as a page of the site; links to what is not in the site lose their target."""

    def link(found: re.Match[str]) -> str:
        text, target = found.groups()
        inside = target.removeprefix("../../").removeprefix("docs/")
        return f"[{text}]({inside})" if "docs/" in target else text

    return LINK.sub(link, text)


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Replace the markers of a page, and the link to the measurements by that to their page."""
    markdown = markdown.replace("](../benchmarks/results/README.md", "](measurements.md")
    return SETTINGS.sub(lambda found: settings_table(found[1]), markdown).replace(NAMES, public_names())


def public_homes() -> dict[str, str]:
    """Return the package or module that offers each public name, as the stub of ``bidnerf`` and ``backend`` state it."""
    found = {"RecipeBackend": "bidnerf_core.backend", "load_backend": "bidnerf_core.backend"}
    for stub in (
        Path(bidnerf.__file__).with_suffix(".pyi"),
        Path(bidnerf_core.__file__).with_name("backend.py"),
    ):
        for node in ast.parse(stub.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.ImportFrom):
                package = str(node.module)
                found |= {name.name: package for name in node.names if name.asname == name.name}
    return found


def public_names() -> str:
    """Return the directives that document the public names, under the package that defines them."""
    by_package: dict[str, list[str]] = {}
    for name, package in public_homes().items():
        by_package.setdefault(package, []).append(f"::: {package}.{name}\n")
    return "\n".join(
        f"### {package.rpartition('.')[2].capitalize()}\n\n" + "\n".join(directives)
        for package, directives in sorted(by_package.items())
    )


def settings_table(method: str) -> str:
    """Return the settings of a method, in the order of the code; those for experts are marked with an asterisk."""
    return HEAD + "\n".join(_rows(METHODS[method].config_type()))


def _rows(settings: Any, inside_expert: bool = False) -> typing.Iterator[str]:
    """Yield a row for each setting, those of nested groups in their place."""
    kind = type(settings)
    comments, hints = field_comments(kind), typing.get_type_hints(kind, include_extras=True)
    for field in dataclasses.fields(settings):
        value = getattr(settings, field.name)
        expert = inside_expert or EXPERT in getattr(hints[field.name], "__metadata__", ())
        if dataclasses.is_dataclass(value):
            yield from _rows(value, expert)
            continue
        shown = f"`{field.name}`" + (" \\*" if expert else "")
        cells = (shown, f"`{value}`", _allowed(hints[field.name]), comments.get(field.name, ""))
        yield "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


def _allowed(hint: Any) -> str:
    """Return the values that an annotation allows, in words."""
    for note in getattr(hint, "__metadata__", ()):
        if isinstance(note, OneOf):
            return ", ".join(note.table)
        if isinstance(note, Range):
            return _interval(note)
    for part in (hint, *typing.get_args(hint)):
        if typing.get_origin(part) is typing.Literal:
            return ", ".join(typing.get_args(part))
    return {bool: "true or false"}.get(hint, "")


def _interval(allowed: Range) -> str:
    least, most = f"{allowed.least:,g}", f"{allowed.most:,.0f}" if allowed.most >= 1 else f"{allowed.most:g}"
    if isinstance(allowed, Above):
        return f"above {least}"
    return f"{least} or more" if math.isinf(allowed.most) else f"{least} to {most}"


def field_comments(kind: type) -> dict[str, str]:
    """Return the comments on the lines of each field of a dataclass, or else those in the lines right above it."""
    source = textwrap.dedent(inspect.getsource(kind))
    comments = {
        token.start[0]: token.string.lstrip("# ").strip()
        for token in tokenize.generate_tokens(io.StringIO(source).readline)
        if token.type == tokenize.COMMENT
    }
    body = typing.cast(ast.ClassDef, ast.parse(source).body[0]).body
    fields = [node for node in body if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name)]
    return {typing.cast(ast.Name, node.target).id: _comment(node, source.splitlines(), comments) for node in fields}


def _comment(field: ast.AnnAssign, lines: list[str], comments: dict[int, str]) -> str:
    beside = range(field.lineno, (field.end_lineno or field.lineno) + 1)
    first = field.lineno
    while lines[first - 2].lstrip().startswith("#"):
        first -= 1
    found = [comments[line] for line in beside if line in comments]
    return " ".join(found or [comments[line] for line in range(first, field.lineno)])
