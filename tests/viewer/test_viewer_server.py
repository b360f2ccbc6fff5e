"""The live viewer: photos in, answers out, and nothing else that can be asked for."""

from __future__ import annotations

import asyncio
import contextlib
import io
import json
import tempfile
import time
from collections.abc import Iterator
from http.client import HTTPConnection
from pathlib import Path
from typing import Any
from unittest.mock import Mock
from urllib.parse import quote

import pytest

from optional import require

pytest.importorskip("starlette", reason="the extra 'viewer' is not installed")
pytest.importorskip("uvicorn", reason="the extra 'viewer' is not installed")

from PIL import Image

import viewed
from bidnerf import Localizer, Map

# Inside: the queue of localizations, of which requests show only the results
from bidnerf.viewer.app import SLOTS, Jobs, ShownJob
from bidnerf_core.camera import CameraSource
from bidnerf_core.localization import settings_of
from bombs import png_of
from photo_room import CAMERA
from viewer_client import Client, serving
from waiting import wait_until

TOKEN = "a-token-of-enough-characters"
VIEW = {"pose": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1], "fov": 60, "width": 32, "height": 24}


@pytest.fixture(scope="module")
def client(room: Map) -> Iterator[Client]:
    with serving(room) as found:
        yield found


def answer_of(client: Client, reply: Any) -> Any:
    """Wait for the answer that a reply promises."""
    assert reply.status_code == 202, reply.text
    job = f"/api/job/{reply.json()['job']}"
    wait_until(lambda: client.get(job).json()["state"] == "done")
    return client.get(job).json()["answer"]


def test_a_photo_that_is_uploaded_is_localized_in_the_background(client: Client, tmp_path: Path) -> None:
    before = set(Path(tempfile.gettempdir()).glob("bidnerf-view-*"))
    content = viewed.photo_file(tmp_path).read_bytes()
    began = time.perf_counter()
    reply = client.post(f"/api/photo?name={quote(viewed.HOSTILE)}", content)
    assert time.perf_counter() - began < 1
    answer = answer_of(client, reply)
    assert answer["accepted"], answer["reason"]
    assert answer["name"] == viewed.HOSTILE
    assert answer["rendered"]["url"].startswith("data:image/jpeg")
    assert set(Path(tempfile.gettempdir()).glob("bidnerf-view-*")) == before


def test_the_camera_that_the_viewer_was_started_with_is_that_of_photos_without_another(
    room: Map, tmp_path: Path
) -> None:
    content = viewed.photo_file(tmp_path).read_bytes()
    with serving(room, camera=CameraSource(focal=CAMERA.fx)) as client:
        assert b'"hfov":null,"camera_given":true' in client.get("/").content
        said = answer_of(client, client.post("/api/photo", content))
        assert said["camera"].startswith(f"focal length {CAMERA.fx:g} px, as given")
        said = answer_of(client, client.post("/api/photo?hfov=58.19", content))
        assert said["camera"].startswith("horizontal field of view 58.19 deg")


def test_bad_uploads_are_refused_with_the_reason(client: Client) -> None:
    assert client.post("/api/photo", headers={"Content-Length": str(2 * 2**20)}).status_code == 413
    assert client.post("/api/photo").status_code == 400
    for side, most in ((1500, "1 megapixels"), (20_000, "178 megapixels")):
        answer = answer_of(client, client.post("/api/photo", png_of(side, side)))
        assert answer["outcome"] == "bad input"
        assert f"expected at most {most}" in answer["reason"]
        assert tempfile.gettempdir() not in answer["reason"]
    answer = answer_of(client, client.post("/api/photo", b"no image"))
    assert answer["outcome"] == "bad input"


@pytest.mark.parametrize(
    "path",
    [
        "/map.json",
        "/../../etc/passwd",
        "/%2e%2e/%2e%2e/etc/passwd",
        "/api/thumbnail/..%2f..%2fetc%2fpasswd",
        "/api/thumbnail/-1",
        "/api/thumbnail/8",
        "/api/thumbnail/../../map.json",
        "/api/job/..%2f..%2fetc%2fpasswd",
        "/api/query/0/..%2f..",
        "//etc/passwd",
        "/api/thumbnail/1e1",
        f"/api/thumbnail/{'9' * 5000}",
        f"/api/query/{'9' * 5000}",
    ],
)
def test_no_file_can_be_asked_for(client: Client, path: str) -> None:
    for method in ("GET", "POST"):
        assert client.request(method, path).status_code in (404, 405)


def test_images_are_chosen_by_number_among_those_given(client: Client) -> None:
    assert client.post("/api/query/1").status_code == 404
    answer = answer_of(client, client.post("/api/query/0"))
    assert answer["name"] == "photo"
    assert answer["accepted"]


def test_the_start_and_the_seed_of_a_photo_are_used(room: Map, tmp_path: Path) -> None:
    content = viewed.photo_file(tmp_path).read_bytes()
    start = json.dumps(viewed.walk(15)[5].matrix().tolist())
    with serving(room, method="bid", config=settings_of("bid", {"max_steps": 3, "rays": 64})) as client:
        assert "needs a start" in answer_of(client, client.post("/api/photo?hfov=58.19", content))["reason"]
        path = f"/api/photo?hfov=58.19&seed=3&start={quote(start)}"
        assert answer_of(client, client.post(path, content))["method"] == "bid"
        assert "bad input" in answer_of(client, client.post(f"{path[:-5]}", content))["outcome"]
        assert client.post("/api/photo?map=other", content).status_code == 400


def test_internal_errors_are_for_the_log_alone(
    room: Map, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("bidnerf.viewer.app.answer_query", Mock(side_effect=RuntimeError("/home/user/secret")))
    with serving(room) as client:
        answer = answer_of(client, client.post("/api/query/0"))
    assert answer["outcome"] == "fault"
    assert "secret" not in json.dumps(answer)
    assert "secret" in caplog.text


def test_photos_beyond_the_bound_are_refused_before_they_are_read(room: Map) -> None:
    with serving(room) as client, contextlib.ExitStack() as uploads:
        for _ in range(SLOTS):
            connection = HTTPConnection("127.0.0.1", client.port)
            uploads.callback(connection.close)
            connection.putrequest("POST", "/api/photo")
            connection.putheader("Content-Length", "1000")
            connection.endheaders(b"x")
        wait_until(lambda: client.post("/api/photo", b"x").status_code == 429)
        assert client.get("/health").status_code == 200


def test_closing_ends_the_localization_at_work(room: Map) -> None:
    localizer = Localizer(room, "bid", {"max_steps": 100_000}, warm_up=False)  # which would take hours
    start = viewed.walk(15)[6]

    async def close_at_work() -> tuple[ShownJob, ShownJob]:
        jobs = Jobs(localizer)
        running, waiting = (
            jobs.start(name, lambda name=name: (viewed.query(name), start, 0), contextlib.ExitStack()) for name in "ab"
        )
        while running.state != "searching":
            await asyncio.sleep(0.02)
        await asyncio.sleep(0.3)
        jobs.close()
        return running, waiting

    running, waiting = asyncio.run(close_at_work())
    began = time.monotonic()
    wait_until(lambda: running.state == "done")
    assert time.monotonic() - began < 20  # of hours; a busy machine takes seconds to end a step
    assert (require(running.answer)["outcome"], waiting.state) == ("stopped", "waiting")


def test_thumbnails_and_renderings_are_images_of_the_size_asked_for(client: Client) -> None:
    reply = client.get("/api/thumbnail/3")
    assert max(Image.open(io.BytesIO(reply.content)).size) == 80
    for quick in (True, False):
        reply = client.post("/api/view", json.dumps(VIEW | {"quick": quick}).encode())
        assert Image.open(io.BytesIO(reply.content)).size == (32, 24)


@pytest.mark.parametrize(
    "wrong",
    [
        {"width": 100_000},
        {"height": 0},
        {"fov": 1e9},
        {"pose": [1, 2]},
        {"pose": ["x"] * 16},
        {"quick": None, "pose": None},
        {"pose": [2, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]},
        {"width": "1e400"},
        {"pose": [float("nan")] * 16},
    ],
)
def test_cameras_that_are_none_are_refused(client: Client, wrong: dict[str, Any]) -> None:
    assert client.post("/api/view", json.dumps(VIEW | {"quick": True} | wrong).encode()).status_code == 400


def test_a_number_of_thousands_of_digits_is_refused(client: Client) -> None:
    body = json.dumps(VIEW | {"quick": True}).replace("32", "9" * 5000).encode()
    assert client.post("/api/view", body).status_code == 400


def test_the_viewer_describes_itself(client: Client) -> None:
    paths = client.get("/openapi.json").json()["paths"]
    assert {"/", "/api/photo", "/api/view", "/docs"} <= set(paths)
    assert b"degrees from top to bottom" in client.get("/docs").content


def test_without_a_token_only_pages_of_this_machine_are_answered(client: Client) -> None:
    assert client.get("/", Host="evil.example").status_code == 403
    for origin in ("https://evil.example", f"http://127.0.0.1:{client.port + 1}"):
        assert client.post("/api/query/0", headers={"Origin": origin}).status_code == 403
    assert client.get("/").status_code == 200


def test_a_token_in_the_address_becomes_a_cookie_that_scripts_cannot_read(room: Map) -> None:
    with serving(room, TOKEN) as client:
        for path in ("/", "/?token=wrong", "/api/thumbnail/0", f"/api/thumbnail/0?token={TOKEN}"):
            assert client.get(path).status_code == 401
        reply = client.get(f"/?token={TOKEN}")
        assert reply.status_code == 303
        assert reply.headers["location"] == "/"
        cookie = reply.headers["set-cookie"]
        assert "httponly" in cookie.lower()
        assert "samesite=strict" in cookie.lower()
        assert "secure" not in cookie.lower()
        assert cookie.startswith(f"bidnerf_token_{client.port}=")
        behind_tls = client.get(f"/?token={TOKEN}", **{"X-Forwarded-Proto": "https"})
        assert "secure" in behind_tls.headers["set-cookie"].lower()
        assert client.get("/", Cookie=cookie.partition(";")[0]).status_code == 200
        assert client.get("/", Cookie=f"bidnerf_token_{client.port}=other").status_code == 401
