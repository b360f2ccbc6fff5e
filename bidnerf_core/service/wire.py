"""Messages between the processes of the service: a JSON object and some blocks of bytes, over a local socket."""

from __future__ import annotations

import asyncio
import json
import socket
import struct
from collections.abc import Mapping
from typing import Any, TypeAlias

Message: TypeAlias = tuple[dict[str, Any], dict[str, bytes]]
"""A JSON object, and blocks of bytes by name."""
LENGTH = struct.Struct(">Q")
SIZES = "sizes"
ANOTHER = b"w"
"""The byte that requests a worker; it comes with the socket that the worker will serve."""


def packed(head: Mapping[str, Any], blocks: Mapping[str, bytes] | None = None) -> list[bytes]:
    """Return the parts of a message in sending order."""
    blocks = blocks or {}
    sizes = {name: len(block) for name, block in blocks.items()}
    text = json.dumps({**head, SIZES: sizes}).encode()
    return [LENGTH.pack(len(text)), text, *blocks.values()]


def send(connection: socket.socket, head: Mapping[str, Any]) -> None:
    """Send a message without blocks."""
    for part in packed(head):
        connection.sendall(part)


def receive(connection: socket.socket) -> Message | None:
    """Wait for a message; return None if the other process has closed the connection."""
    prefix = _exactly(connection, LENGTH.size)
    if prefix is None:
        return None
    text = _exactly(connection, LENGTH.unpack(prefix)[0])
    if text is None:
        return None
    head = json.loads(text)
    blocks = dict[str, bytes]()
    for name, size in head.pop(SIZES).items():
        block = _exactly(connection, size)
        if block is None:
            return None
        blocks[name] = block
    return head, blocks


def _exactly(connection: socket.socket, count: int) -> bytes | None:
    """Return the next ``count`` bytes, or None if the connection ends before them."""
    found, view = bytearray(count), 0
    while view < count:
        try:
            got = connection.recv_into(memoryview(found)[view:])
        except ConnectionError:
            return None
        if not got:
            return None
        view += got
    return bytes(found)


async def read(reader: asyncio.StreamReader) -> dict[str, Any]:
    """Read a message without blocks. Raises ``EOFError`` or ``ConnectionError`` if the connection ends."""
    (length,) = LENGTH.unpack(await reader.readexactly(LENGTH.size))
    head: dict[str, Any] = json.loads(await reader.readexactly(length))
    head.pop(SIZES)
    return head
