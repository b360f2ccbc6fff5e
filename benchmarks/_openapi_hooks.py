"""What Schemathesis loads beside the service's description: photos to send, and counts of what came back.

``PHOTOS`` names a folder of photos of the map ``MAP``, and ``COUNTS`` the file in which the counts are written when the program ends.
"""

from __future__ import annotations

import atexit
import base64
import json
import os
from collections import Counter
from pathlib import Path
from typing import Any

import schemathesis
from hypothesis import strategies as st
from schemathesis.transport.serialization import Binary

MAP = os.environ["MAP"]
PHOTOS = [file.read_bytes() for file in sorted(Path(os.environ["PHOTOS"]).iterdir())]
photos = st.sampled_from(PHOTOS)
damaged = st.builds(lambda photo, end: photo[:end], photos, st.integers(0, 5000))
content = st.one_of(photos, photos, damaged, st.binary(max_size=200))
schemathesis.openapi.format("binary", content)
for kind in ("image/*", "application/octet-stream"):
    schemathesis.openapi.media_type(kind, content)

statuses, headers, slowest = Counter[str](), dict[str, set[str]](), 0.0


@schemathesis.hook
def before_add_examples(context: Any, examples: list[Any]) -> None:
    """Add requests that can be answered to the examples of an operation: each photo in each way in which it can be sent."""
    operation = context.operation
    if operation.method.upper() != "POST":
        return
    places = {"map": MAP} if "{map}" in operation.path else {}
    for photo in PHOTOS:
        reading = {"imageBytes": base64.b64encode(photo).decode()}
        bodies = {"application/json": {"sensorReadings": {"cameraReadings": [reading]}}}
        if operation.path.endswith("/localize"):
            bodies = {
                "multipart/form-data": {"photo": Binary(photo)},
                "image/*": photo,
                "application/octet-stream": photo,
            }
        for kind, body in bodies.items():
            examples.append(operation.Case(path_parameters=places, body=body, media_type=kind))


@schemathesis.hook
def after_call(context: Any, case: Any, response: Any) -> None:
    """Count an answer."""
    global slowest
    statuses[f"{response.request.method} {case.path} {response.status_code}"] += 1
    headers.setdefault(str(response.status_code), set()).update(response.headers)
    slowest = max(slowest, response.elapsed)


@atexit.register
def write_counts() -> None:
    """Write the counts."""
    named = {status: sorted(names) for status, names in headers.items()}
    counts = {"statuses": statuses, "headers": named, "slowest_seconds": slowest}
    Path(os.environ["COUNTS"]).write_text(json.dumps(counts))
