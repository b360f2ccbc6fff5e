"""HTTP requests: read within limits, and parsed into a photo and what is known about it."""

from __future__ import annotations

import asyncio
import json
import math
import re
from collections.abc import AsyncGenerator, Callable, Mapping
from dataclasses import dataclass, field
from pathlib import PurePosixPath
from typing import Any

from starlette.datastructures import Headers, UploadFile
from starlette.formparsers import MultiPartException, MultiPartParser
from starlette.requests import ClientDisconnect, Request

from bidnerf_core.errors import InputError, spelling_hint
from bidnerf_core.io import parse_json
from bidnerf_core.service.settings import MEBIBYTE, ServiceLimits
from bidnerf_core.settings import LARGEST_SEED

LONGEST_NAME = 200
"""Characters of a name in an answer."""
FIELDS = 16
"""Largest number of parts of a form."""
NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)
"""A number as a program writes it; Python's ``float`` takes digits of every script and underscores too."""
FILES = ("photo", "depth", "camera", "start")
"""The parts of a form that contain files. ``camera`` and ``start`` may be query parameters as well."""
MULTIPART, JSON = "multipart/form-data", "application/json"


class Refused(Exception):
    """A request that is not passed on to a worker."""

    def __init__(self, status: int, detail: str, headers: Mapping[str, str] | None = None) -> None:
        super().__init__(detail)
        self.status, self.detail, self.headers = status, detail, dict(headers or {})


@dataclass(frozen=True)
class Query:
    """A photo to localize, and what is known about it."""

    parameters: dict[str, Any] = field(default_factory=dict)
    blocks: dict[str, bytes] = field(default_factory=dict)


def number(low: float, high: float) -> Callable[[str, str], float]:
    """Return a parser for a number in a range."""

    def parse(name: str, text: str) -> float:
        value = float(text) if NUMBER.fullmatch(text) else math.nan
        if not low <= value <= high:
            raise Refused(400, f"{name} is {_short(text)}, expected a number from {low:g} to {high:g}")
        return value

    return parse


def _seed(name: str, text: str) -> int:
    if not (text.isascii() and text.isdigit() and len(text) <= 10 and int(text) <= LARGEST_SEED):
        raise Refused(400, f"{name} is {_short(text)}, expected a whole number from 0 to {LARGEST_SEED}")
    return int(text)


def _name(name: str, text: str) -> str:
    if not 0 < len(text) <= LONGEST_NAME:
        raise Refused(400, f"{name} has {len(text)} characters, expected 1 to {LONGEST_NAME}")
    return text


def _same(name: str, text: str) -> str:
    return text


PARAMETERS: dict[str, Callable[[str, str], Any]] = {
    "map": _same, "name": _name, "focal": number(1e-3, 1e9), "hfov": number(1e-3, 179.999),
    "depth_unit": number(1e-9, 1e9), "seed": _seed, "camera": _same, "start": _same,
}  # fmt: skip
"""Parsers of the query parameters, which may be form fields as well."""


async def body_of(request: Request, limits: ServiceLimits) -> bytes:
    """Read the body of a request. Raises ``Refused`` for one that is too large or does not arrive in time."""
    close = {"Connection": "close"}  # the rest of the body is not read
    announced = request.headers.get("content-length", "0")
    most = f"expected at most {limits.max_megabytes:g} MiB"
    if not (announced.isascii() and announced.isdigit() and len(announced) <= 20):
        raise Refused(400, f"Content-Length is {_short(announced)}, expected a number", close)
    if int(announced) > limits.max_bytes:
        raise Refused(413, f"the request has {int(announced) / MEBIBYTE:,.0f} MiB, {most}", close)
    content = bytearray()
    try:
        async with asyncio.timeout(limits.upload_timeout):
            async for chunk in request.stream():
                content += chunk
                if len(content) > limits.max_bytes:
                    raise Refused(413, f"the request is too large, {most}", close)
    except TimeoutError as error:
        late = f"the request did not arrive within {limits.upload_timeout:g} s"
        raise Refused(408, late, close) from error
    except ClientDisconnect as error:
        raise Refused(499, "the client disconnected") from error
    return bytes(content)


async def query_of(request: Request, content: bytes) -> Query:
    """Parse a request: a form, or the bytes of a photo with query parameters. Raises ``Refused``."""
    query = Query()
    for name, text in request.query_params.multi_items():
        _add(query, name, text)
    kind = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    if kind == MULTIPART:
        await _add_form(query, request.headers, content)
    elif content:
        query.blocks["photo"] = content
    if not query.blocks.get("photo"):
        raise Refused(400, "no photo, expected its bytes as the body, or a form with a file 'photo'")
    return query


def _add(query: Query, name: str, text: str) -> None:
    if name not in PARAMETERS:
        raise Refused(400, f"unknown parameter {_short(name)}{spelling_hint(name, PARAMETERS, _known())}")
    if name in query.parameters or name in query.blocks:
        raise Refused(400, f"{name} is given twice, expected once")
    value = PARAMETERS[name](name, text)
    if name in FILES:
        query.blocks[name] = text.encode("utf-8", "replace")
    else:
        query.parameters[name] = value


def _known() -> str:
    return f", expected any of {', '.join(PARAMETERS)}, and the files photo and depth"


class _InMemory(MultiPartParser):
    """A parser that keeps files in memory, since their size is already limited, rather than on disk."""

    spool_max_size = 2**40


async def _add_form(query: Query, headers: Headers, content: bytes) -> None:
    async def once() -> AsyncGenerator[bytes, None]:
        yield content

    try:
        parser = _InMemory(headers, once(), max_files=FIELDS, max_fields=FIELDS, max_part_size=MEBIBYTE)
        form = await parser.parse()
    except (MultiPartException, KeyError, ValueError, LookupError) as error:
        reason = getattr(error, "message", None) or "no boundary, or a violation of RFC 7578"
        raise Refused(400, f"not a readable form: {reason}") from error
    try:
        for name, value in form.multi_items():
            if isinstance(value, UploadFile):
                await _add_file(query, name, value)
            else:
                _add(query, name, value)
        photo = form.get("photo")
        if isinstance(photo, UploadFile) and photo.filename:
            stem = PurePosixPath(photo.filename.replace("\\", "/")).stem[:LONGEST_NAME]
            if stem:  # text in the answer, never a file name; a given name takes precedence
                query.parameters.setdefault("name", stem)
    finally:
        await form.close()


async def _add_file(query: Query, name: str, file: UploadFile) -> None:
    if name not in FILES:
        raise Refused(400, f"unknown file {_short(name)}{spelling_hint(name, FILES, f', expected {FILES}')}")
    if name in query.blocks:
        raise Refused(400, f"{name} is given twice, expected once")
    query.blocks[name] = await file.read()


def json_of(content: bytes) -> dict[str, Any]:
    """Return the JSON object in a body. Raises ``Refused`` for anything else."""
    try:
        found = parse_json(content, "", "a request of the GeoPose Protocol")
    except InputError as error:
        raise Refused(400, str(error)) from error
    if not isinstance(found, dict):
        raise Refused(400, "the body is not a JSON object, expected a request of the GeoPose Protocol")
    return found


def _short(text: str) -> str:
    """Return text as JSON on one line, truncated if it is long."""
    shown = json.dumps(text)
    return shown if len(shown) <= 60 else shown[:57] + "..."
