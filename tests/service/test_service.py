"""The HTTP service: its answers are those of the command line, its limits hold, and no request is lost or breaks it."""

from __future__ import annotations

import asyncio
import contextlib
import importlib
import json
import os
import random
import re
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from base64 import b64encode
from collections.abc import Awaitable, Iterator
from dataclasses import dataclass, field, replace
from email.utils import formatdate
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from queue import SimpleQueue
from typing import Any
from unittest.mock import AsyncMock
from urllib.error import HTTPError
from urllib.parse import urlsplit
from urllib.request import urlopen

import imageio.v3 as iio
import numpy as np
import PIL.Image
import psutil
import pytest

from optional import require

pytest.importorskip("starlette", reason="the extra 'serve' is not installed")
pytest.importorskip("uvicorn", reason="the extra 'serve' is not installed")

from starlette.responses import PlainTextResponse

from bidnerf import InputError, ServiceClient, ServiceError, open_dataset, serve
from bidnerf.service import Application, ServiceLimits, Upload, public_message, read_upload, run_app, service_app

# Inside: workers are killed, and the description is compared with the parameters that are read
from bidnerf.service.models import LocalizationBody, MapFacts, PhotoForm
from bidnerf.service.pool import Pool
from bidnerf.service.server import maps_by_name
from bidnerf.service.web import SAFE, Gate
from bidnerf_core.camera import WAYS, CameraSource
from bidnerf_core.localization import settings_of
from bidnerf_core.registry import _declared
from bombs import png_of
from commands import Run, assert_refused
from waiting import wait_until

QUICK = {"max_steps": 3, "rays": 64}
LIMITS = ServiceLimits(workers=1, queue=3, timeout=120.0, upload_timeout=0.5, max_megabytes=1.0, max_megapixels=1.0)
FORM = "multipart/form-data; boundary=xyz"
ECHO = '''"""A protocol that answers the JSON of a photo with its name."""
import base64
from pydantic import Base64Bytes, BaseModel

class Question(BaseModel):
    photo: Base64Bytes
    start: str

class Answer(BaseModel):
    frame: str
    cameras: int

class Echo:
    summary, request, response = "Return the name of a photo.", Question, Answer
    media_type = "application/vnd.echo+json;version=1"

    def answer(self, body, scene, localize):
        from bidnerf.service import Upload

        photo = Upload({"name": "echo", "focal": 32.0, "start": body["start"]}, {"photo": base64.b64decode(body["photo"])})
        answer, plain = localize(photo)
        return {"frame": plain["frame"], "cameras": len(scene.info.cameras)}

echo = Echo()
'''


@dataclass
class Reply:
    status: int = 0
    headers: dict[str, str] = field(default_factory=dict)
    body: bytes = b""

    @property
    def json(self) -> Any:
        return json.loads(self.body)


class Service:
    """An application that is served in an event loop, called without HTTP as its server would."""

    def __init__(self, app: Any, loop: asyncio.AbstractEventLoop, url: str) -> None:
        self.app, self.loop, self.url = app, loop, url
        self.pool: Pool = app.state.pool
        self.metric = self.pool.metric
        self.description = app.openapi()

    def run(self, work: Awaitable[Any]) -> Any:
        async def waited() -> Any:
            return await work

        return asyncio.run_coroutine_threadsafe(waited(), self.loop).result(60)

    def post(self, path: str, body: bytes = b"", kind: str = "image/png", **more: Any) -> Reply:
        return self.run(self.ask("POST", path, [body], {"content-type": kind}, **more))

    def get(self, path: str, method: str = "GET") -> Reply:
        return self.run(self.ask(method, path, []))

    async def ask(
        self,
        method: str,
        path: str,
        chunks: list[bytes],
        headers: dict[str, str] | None = None,
        leaving: asyncio.Event | None = None,
        stalls: bool = False,
    ) -> Reply:
        path, _, query = path.partition("?")
        given = {"host": "localhost", **(headers or {})}
        scope = {
            "type": "http",
            "asgi": {"version": "3.0"},
            "http_version": "1.1",
            "method": method,
            "path": path,
            "raw_path": path.encode(),
            "query_string": query.encode(),
            "root_path": "",
            "scheme": "http",
            "headers": [(k.encode(), v.encode("latin-1")) for k, v in given.items()],
            "client": ("127.0.0.1", 1),
            "server": ("localhost", 80),
            "state": {},
        }
        reply, parts = Reply(), list(chunks)

        async def receive() -> dict[str, Any]:
            if parts:
                part = parts.pop(0)
                return {"type": "http.request", "body": part, "more_body": bool(parts) or stalls}
            await (leaving or asyncio.Event()).wait()
            return {"type": "http.disconnect"}

        async def send(message: dict[str, Any]) -> None:
            if message["type"] == "http.response.start":
                reply.status = message["status"]
                reply.headers = {k.decode().lower(): v.decode() for k, v in message["headers"]}
            else:
                reply.body += message.get("body", b"")

        await self.app(scope, receive, send)
        # Every answer of every test has a status, a type and headers that the description promises.
        template = re.sub("^/maps/[^/]+", "/maps/{map}", path)
        operation = (self.description or {"paths": {}})["paths"].get(template, {}).get(method.lower())
        if operation is None or reply.status == 499:  # for which there is nobody to receive it
            return reply
        description = operation["responses"][str(reply.status)]
        kinds = {kind.partition(";")[0] for kind in description["content"]}
        assert reply.headers["content-type"].partition(";")[0] in kinds
        usual = {"x-request-id", "content-type", "content-length", "connection", *map(str.lower, SAFE)}
        assert set(reply.headers) - usual == {name.lower() for name in description.get("headers", ())} - usual
        assert reply.headers.keys() >= set(map(str.lower, SAFE))
        return reply

    description: dict[str, Any] | None = None  # of an application that describes itself


@dataclass(frozen=True)
class Inputs:
    folder: Path
    photo: bytes
    start: str


@pytest.fixture(scope="module")
def inputs(shared: Path, tmp_path_factory: pytest.TempPathFactory) -> Inputs:
    folder = tmp_path_factory.mktemp("service")
    (folder / "uploads").mkdir()
    (folder / "data").symlink_to(shared / "data")
    shutil.copytree(shared / "map", folder / "map")
    shutil.copytree(shared / "map", folder / "hall")
    anchor = {"latitude": 47.4, "longitude": 19.0, "height": 120.0, "position_sigma": 0.5}
    (folder / "hall/anchor.json").write_text(json.dumps(anchor))
    shutil.copy(folder / "data/images/t_0000.png", folder / "photo.png")
    pose = open_dataset(folder / "data").views("test")[0].T_ref_camera.matrix().tolist()
    (folder / "start.json").write_text(json.dumps({"T_world_camera": pose}))
    return Inputs(folder, (folder / "photo.png").read_bytes(), json.dumps(pose).replace(" ", ""))


@pytest.fixture(scope="module")
def service(inputs: Inputs) -> Iterator[Service]:
    """One service for all tests, on a port of its own: its start takes seconds."""
    ready, stop = SimpleQueue[tuple[str, None, asyncio.AbstractEventLoop]](), threading.Event()
    site = inputs.folder / "site"
    (site / "echo-1.0.dist-info").mkdir(parents=True)
    (site / "echo-1.0.dist-info/METADATA").write_text("Metadata-Version: 2.1\nName: echo\nVersion: 1.0\n")
    (site / "echo-1.0.dist-info/entry_points.txt").write_text("[bidnerf.services]\necho = strange_echo:echo\n")
    (site / "strange_echo.py").write_text(ECHO)
    with pytest.MonkeyPatch.context() as patch:  # also for the processes that replace those that tests kill
        patch.syspath_prepend(str(site))
        patch.setenv("PYTHONPATH", os.pathsep.join(filter(None, [str(site), os.environ.get("PYTHONPATH")])))
        patch.setattr(tempfile, "tempdir", str(inputs.folder / "uploads"))
        _declared.cache_clear()
        maps = [inputs.folder / "map", inputs.folder / "hall"]
        app = service_app(maps, method="bid", config=QUICK, limits=LIMITS)
        options = {"port": 0, "stop": stop, "ready": lambda *given: ready.put((*given, asyncio.get_running_loop()))}
        running = threading.Thread(target=serve, args=[maps], kwargs=options)
        try:
            with pytest.MonkeyPatch.context() as at_start:
                at_start.setattr("bidnerf.service.server.service_app", lambda *_, **__: app)
                running.start()
                url, token, loop = ready.get(timeout=60)
            assert token is None  # this machine only needs none
            yield Service(app, loop, url)
        finally:
            stop.set()
            running.join(30)
    _declared.cache_clear()
    with pytest.raises(ServiceError, match="refused"):
        ServiceClient(url).ask("/maps")


@pytest.fixture(scope="module")
def address(service: Service) -> tuple[str, int]:
    return "127.0.0.1", int(urlsplit(service.url).port or 0)


def form(**parts: bytes | str) -> bytes:
    """Return a form; bytes are files."""
    text = b""
    for name, value in parts.items():
        file = f'; filename="{name}.bin"' if isinstance(value, bytes) else ""
        head = f'--xyz\r\nContent-Disposition: form-data; name="{name}"{file}\r\n\r\n'
        text += head.encode() + (value if isinstance(value, bytes) else value.encode()) + b"\r\n"
    return text + b"--xyz--\r\n"


def test_answers_are_those_of_the_command_line(service: Service, inputs: Inputs, bidnerf: Run) -> None:
    options = [f"--{name.replace('_', '-')}={value}" for name, value in QUICK.items()]
    words = ["localize", inputs.folder / "map", inputs.folder / "photo.png", "--method=bid", *options]
    depth = inputs.folder / "data/depth/t_0000.png"
    words += ["--start", inputs.folder / "start.json", "--depth", depth, "--depth-unit=0.001"]
    expected = json.loads(bidnerf(*words, "--focal=32", "--seed=7", "--json").out)
    parts = {"photo": inputs.photo, "depth": depth.read_bytes(), "start": inputs.start}
    body = form(**parts, focal="32", depth_unit="0.001", seed="7")
    reply = service.post("/maps/map/localize", body, FORM)
    assert reply.status == 200
    assert list(reply.json) == list(expected)
    LocalizationBody.model_validate(reply.json)
    assert reply.json["loss"] == pytest.approx(expected["loss"], rel=1e-6)
    same = expected.keys() - {"seconds", "loss"}
    assert {key: reply.json[key] for key in same} == {key: expected[key] for key in same}


def test_a_photo_may_be_the_body(service: Service, inputs: Inputs) -> None:
    query = f"map=map&focal=32&name=%3Cscript%3E&start={inputs.start}"
    reply = service.post(f"/localize?{query}", inputs.photo)
    assert reply.status == 200
    assert reply.json["frame"] == "<script>"
    assert reply.headers["content-type"] == "application/json"
    assert reply.headers["x-content-type-options"] == "nosniff"


def test_a_registered_protocol_is_answered(service: Service, inputs: Inputs) -> None:
    """Both processes load the plugin: that which listens, and the worker."""
    question = {"photo": b64encode(inputs.photo).decode(), "start": inputs.start}
    for path in ("/echo?map=map", "/maps/hall/echo"):
        reply = service.post(path, json.dumps(question).encode(), "application/json")
        assert reply.json == {"frame": "echo", "cameras": service.get("/maps/hall").json["cameras"]}
    assert service.post("/echo", json.dumps(question).encode()).json["detail"].startswith("several maps")
    for body, status, part in (
        (b"{}", 400, "no 'photo'"),
        (b"{", 400, "not JSON"),
        (b"[" * 9000, 400, "not JSON"),
        (
            b'{"photo": [' + b"{}," * 10_001 + b"{}]}",
            400,
            "has 20,005 values, expected a JSON object of at most 10,000",
        ),
    ):
        refused = service.post("/maps/map/echo", body)
        assert (refused.status, part in refused.json["detail"]) == (status, True), refused.body
    assert service.get("/maps/map/echo").json == {"status": "running"}
    assert service.post("/echo?map=", json.dumps(question).encode()).status == 404
    refused = service.get("/echo", "PUT")
    assert (refused.status, refused.headers["allow"]) == (405, "GET, POST")


def test_names_are_text_and_never_files(service: Service, inputs: Inputs) -> None:
    part = b'--xyz\r\nContent-Disposition: form-data; name="photo"; filename="../../etc/pass wd.png"\r\n\r\n'
    body = part + inputs.photo + b"\r\n" + form(start=inputs.start, focal="32", map="map")
    assert service.post("/localize", body, FORM).json["frame"] == "pass wd"
    named = form(photo=inputs.photo, start=inputs.start, focal="32", map="map", name="<script>")
    assert service.post("/localize", named, FORM).json["frame"] == "<script>"
    for path in ("..%2f..%2fetc%2fpasswd", "../map.json", "map/map.json", ".", "../../etc/passwd"):
        assert service.get(f"/maps/{path}").status == 404, path
    assert service.get("/etc/passwd").status == 404
    for text in ("../map", "/etc/passwd", "map\0", "x" * 5000):
        reply = service.post("/localize", form(photo=inputs.photo, map=text), FORM)
        assert reply.status in (400, 404), text
    assert service.post("/localize?map=map&camera=/etc/passwd", inputs.photo).status == 422
    assert "passwd" not in service.get("/metrics").body.decode()
    assert list((inputs.folder / "uploads").iterdir()) == []


def test_limits_hold_before_anything_is_decoded(service: Service, inputs: Inputs) -> None:
    bomb = service.post("/localize?map=map&focal=32", png_of(9000, 9000))
    assert bomb.status == 422
    assert "9000x9000, expected at most 1 megapixels" in bomb.json["detail"]
    depth = form(photo=inputs.photo, depth=png_of(60000, 60000))
    assert service.post("/localize?map=map", depth, FORM).status == 422
    large = service.run(service.ask("POST", "/localize", [b"x"], {"content-length": str(2 * 10**9)}))
    assert large.status == 413
    assert large.headers["connection"] == "close"
    chunks = [bytes(2**18)] * 1000  # no length is announced
    endless = service.run(service.ask("POST", "/localize", chunks))
    assert endless.status == 413
    slow = service.run(service.ask("POST", "/localize?map=map", [b"x"], stalls=True))
    assert slow.status == 408


def test_malformed_requests_are_refused_with_a_reason(service: Service, inputs: Inputs) -> None:
    drawn = random.Random(0)
    forms = [FORM, "multipart/form-data", "multipart/form-data; boundary="]
    kinds = [*forms, "image/png", "text/html", "application/json", ""]
    seeds = [inputs.photo, form(photo=inputs.photo, focal="32"), b'{"photo": [{}]}', b"", png_of(9, 9)]
    paths = ["/localize", "/maps/map/localize", "/maps/\xff/localize"]
    found = set()
    for _ in range(250):
        body = bytearray(drawn.choice(seeds))
        for _ in range(drawn.randrange(8)):
            at = drawn.randrange(len(body) + 1)
            body[at : at + drawn.randrange(9)] = drawn.randbytes(drawn.randrange(9))
        values = ["", "nan", "-1", "1e999", "\0", "map", "32", "[[]]", "{", "9" * 400]
        query = "&".join(
            f"{drawn.choice([*PhotoForm.model_fields, 'x'])}={drawn.choice(values)}" for _ in range(drawn.randrange(4))
        )
        path = drawn.choice(paths)
        reply = service.post(f"{path}{'&' if '?' in path else '?'}{query}", bytes(body), drawn.choice(kinds))
        assert reply.status < 500, (path, query, bytes(body), reply.body)
        assert reply.json["detail"] if reply.status != 200 else reply.json["outcome"]
        found.add(reply.status)
    for length in ("one", "\xb2", "9" * 5000, ""):  # other servers may let them through
        headers = {"content-length": length}
        assert service.run(service.ask("POST", "/localize", [b"x"], headers)).status == 400
    assert found >= {400, 404, 422}
    assert service.metric("worker_restarts_total", reason="died") == 0


def test_what_is_missing_is_named(service: Service, inputs: Inputs) -> None:
    for query, *parts in (
        (f"focal=32&start={inputs.start}", "start was given without map", "map"),
        ("focal=32", "needs a start"),
        ("map=map&fcal=3", "did you mean 'focal'?"),
        ("map=map&focal=x", 'focal is "x"', "a number"),
        ("map=map&focal=1&focal=2", "focal is given twice"),
        ("map=map&depth_unit=1", "depth_unit was given without depth"),
        ("map=map&focal=32&hfov=60", "focal and hfov are given, expected one of"),
        ("map=map&camera=%25YAML:1.0", "YAML"),
        ("map=map&camera=---%0Aa: %26a [1]%0Ab: *a", "camera: is not YAML (aliases"),
        (f"map=map&focal={'9' * 5000}", "focal is", "a number up to"),
        (f"map=map&seed={'9' * 5000}", "seed is"),
        ("map=map&hfov=179.9", "expected a number up to 170"),
        ("map=map&hfov=1.18", "hfov is 1.18, expected degrees, more than 3", "(radians? then 67.61 degrees"),
        ("image=photo.png", 'unknown parameter "image", expected any of', "photo"),
        ("map=map&focal=0.001", "focal is 0.001 for 24 columns, expected at least 1.05"),
    ):
        detail = service.post(f"/localize?{query}", inputs.photo).json["detail"]
        assert [part for part in parts if part not in detail] == []
    assert service.post("/localize?map=map").json["detail"].startswith("no photo, expected")
    refused = service.get("/localize")
    assert (refused.status, refused.headers["allow"]) == (405, "POST")
    assert refused.json["detail"] == "/localize does not take GET, expected POST"
    misspelt = service.post("/localize", form(image=inputs.photo), FORM)
    assert misspelt.json["detail"].startswith('unknown parameter "image", expected any of map, name,')
    with pytest.raises(ServiceError, match="the address is '127\\.0\\.0\\.1:8765', expected http:// or"):
        ServiceClient("127.0.0.1:8765")
    for path in ("/nothing", "/maps/", "/maps/nothing", "/maps/nothing/localize/"):
        assert service.get(path).json["status"] == 404, path
    for number in ("1_0", "\u0663", " 5", "infinity", "0x10"):
        reply = service.post(f"/localize?map=map&focal={number}", inputs.photo)
        assert "expected a number" in reply.json["detail"]


def test_messages_name_the_parameters_of_requests(tmp_path: Path) -> None:
    error = InputError("no focal length", where=tmp_path / "photo", expected=f"a camera: {WAYS}")
    shown = public_message(error, tmp_path)
    assert shown == "photo: no focal length, expected a camera: camera (a file), focal (pixels) or hfov (degrees)"


def test_requests_beyond_the_bound_are_turned_away(service: Service, inputs: Inputs) -> None:
    with contextlib.ExitStack() as taken:
        for _ in range(service.pool.queue.slots):
            taken.enter_context(service.pool.queue.slot())
        reply = service.post("/localize?map=map", inputs.photo)
        assert reply.status == 429
        assert int(reply.headers["retry-after"]) >= 1
        assert service.get("/health").status == 200
    assert service.post("/localize?map=map", inputs.photo).status == 422


@contextlib.contextmanager
def pause_worker(service: Service) -> Iterator[int]:
    """Let the only worker stand still, as one does that computes for long."""
    wait_until(lambda: len(service.pool.workers) == 1)
    (worker,) = service.pool.workers
    os.kill(worker.pid, signal.SIGSTOP)
    yield worker.pid
    wait_until(lambda: service.pool.workers not in ([], [worker]))


def request(service: Service, inputs: Inputs, leaving: asyncio.Event | None = None) -> Any:
    path = f"/localize?map=map&focal=32&start={inputs.start}"
    return asyncio.run_coroutine_threadsafe(service.ask("POST", path, [inputs.photo], leaving=leaving), service.loop)


def test_nothing_is_lost_when_a_worker_is_killed(service: Service, inputs: Inputs) -> None:
    before = service.metric("worker_restarts_total", reason="died")
    with pause_worker(service) as process:
        waiting = [request(service, inputs) for _ in range(3)]
        wait_until(lambda: service.metric("queue_length") == 2)
        os.kill(process, signal.SIGKILL)
        assert [reply.result(60).status for reply in waiting] == [200] * 3
    assert service.metric("worker_restarts_total", reason="died") == before + 1


@pytest.mark.slow
def test_nothing_is_lost_when_the_process_with_the_maps_is_killed(service: Service, inputs: Inputs) -> None:
    maps = psutil.Process(require(service.pool._maps)[0].pid)  # from which workers are forked
    with pause_worker(service) as process:
        waiting = request(service, inputs)
        wait_until(lambda: service.metric("requests_in_progress") == 1)
        maps.kill()
        os.kill(process, signal.SIGKILL)
        assert waiting.result(150).status == 200


def test_a_process_with_the_maps_that_does_not_answer_is_replaced(monkeypatch: pytest.MonkeyPatch) -> None:
    pool, worker, (ours, theirs) = Pool({"maps": {}}, LIMITS), object(), socket.socketpair()
    silent = subprocess.Popen(["sleep", "60"])
    monkeypatch.setattr("bidnerf.service.pool.PAUSE", 0.0)
    monkeypatch.setattr("bidnerf.service.pool.FORK_SECONDS", 0.05)
    monkeypatch.setattr(pool, "_maps", (silent, ours))
    monkeypatch.setattr(
        pool, "_load", AsyncMock(side_effect=lambda: monkeypatch.setattr(pool, "_fork", AsyncMock(return_value=worker)))
    )
    with theirs:
        assert asyncio.run(pool._replacement()) is worker
    assert (silent.returncode, ours.fileno()) == (-signal.SIGKILL, -1)
    assert pool.metric("worker_restarts_total", reason="maps") == 1


def test_maps_are_kept_while_a_worker_cannot_begin(monkeypatch: pytest.MonkeyPatch) -> None:
    """An accelerator whose memory is full now is no reason to load the maps again."""
    pool, maps, worker, full = Pool({"maps": {}}, LIMITS), object(), object(), InputError("out of memory")
    monkeypatch.setattr("bidnerf.service.pool.PAUSE", 0.0)
    monkeypatch.setattr(pool, "_maps", maps)
    monkeypatch.setattr(pool, "_fork", AsyncMock(side_effect=[full, full, worker]))
    assert asyncio.run(pool._replacement()) is worker
    assert pool._maps is maps


def test_a_temporary_folder_that_is_removed_is_made_anew(service: Service, inputs: Inputs) -> None:
    (inputs.folder / "uploads").rmdir()
    assert service.get("/health").status == 200
    assert request(service, inputs).result(60).status == 200


def test_work_that_nobody_waits_for_is_stopped(service: Service, inputs: Inputs) -> None:
    leaving = asyncio.Event()
    with pause_worker(service):
        waiting = request(service, inputs, leaving)
        wait_until(lambda: service.metric("requests_in_progress") == 1)
        behind = request(service, inputs)
        wait_until(lambda: service.metric("queue_length") == 1)  # the worker has the other, all of it
        service.loop.call_soon_threadsafe(leaving.set)
        assert waiting.result(20).status == 499
        assert behind.result(60).status == 200
    assert service.metric("worker_restarts_total", reason="cancelled") == 1
    assert service.metric("requests_in_progress") == 0


def test_work_that_takes_too_long_is_stopped(service: Service, inputs: Inputs) -> None:
    service.app.state.limits = replace(LIMITS, timeout=0.2)
    try:
        with pause_worker(service):
            first, second = request(service, inputs), request(service, inputs)
            assert (first.result(20).status, second.result(20).status) == (504, 504)
    finally:
        service.app.state.limits = LIMITS
    assert service.metric("worker_restarts_total", reason="timeout") == 1
    assert request(service, inputs).result(60).status == 200


TOKEN = "0123456789abcdef"


@pytest.mark.parametrize(
    ("token", "status", "headers"),
    [
        *((None, 200, {"host": host}) for host in ("localhost:8000", "127.0.0.1", "[::1]:8000", "127.8.8.8")),
        *(
            (None, 403, {"host": host})
            for host in ("example.org", "192.168.1.5:8000", "localhost.example.org", "", "[")
        ),
        (None, 403, {"host": "127.0.0.1.nip.io"}),
        *(
            (None, 403, {"origin": f"http{end}", "host": "localhost:8000"})
            for end in ("s://example.org", "://localhost:3000")
        ),
        (None, 403, {"origin": "null", "host": "localhost:8000"}),
        (None, 200, {"origin": "http://localhost:8000", "host": "localhost:8000"}),
        (TOKEN, 401, {"host": "example.org"}),
        (TOKEN, 401, {"host": "localhost"}),
        *((TOKEN, 401, {"authorization": wrong}) for wrong in ("Bearer", "Bearer x", "Bearer \xe9", f"Basic {TOKEN}")),
        *((TOKEN, 401, {"authorization": wrong}) for wrong in (f"bearer{TOKEN}", f"Bearer {TOKEN}x")),
        (TOKEN, 200, {"host": "example.org", "authorization": f"Bearer {TOKEN}"}),
        (TOKEN, 200, {"host": "example.org", "path": "/health"}),
        (TOKEN, 200, {"host": "example.org", "cookie": f"cookie_80={TOKEN}"}),
        (TOKEN, 401, {"cookie": f"cookie_80={TOKEN}", "host": "localhost:8010", "origin": "http://localhost:3000"}),
    ],
)
def test_only_programs_on_this_machine_or_with_the_token_are_answered(
    token: str | None, status: int, headers: dict[str, str]
) -> None:
    reports, service = list[tuple[str, int]](), Service.__new__(Service)
    path, headers = headers.get("path", "/localize"), {name: headers[name] for name in headers if name != "path"}
    app = PlainTextResponse("let in")
    service.app = Gate(app, token, "cookie", lambda scope, status, *_: reports.append((scope["path"], status)))
    assert asyncio.run(service.ask("POST", path, [], headers)).status == status
    assert reports == [(path, status)]


def test_every_path_is_described(service: Service) -> None:
    description = service.get("/openapi.json").json
    assert set(description["paths"]) == {route.path for route in service.app.routes}
    protected = service_app(["map"], token="0123456789abcdef").openapi()
    assert (protected["security"], description["security"]) == ([{"token": []}], [])
    for path, operations in protected["paths"].items():
        for method, operation in operations.items():
            assert ("401" in operation["responses"], "403" in operation["responses"]) == (
                path != "/health",
                False,
            )
            assert "403" in description["paths"][path][method]["responses"]
    queried = {p["name"] for p in description["paths"]["/localize"]["post"]["parameters"]}
    assert queried == PhotoForm.model_fields.keys() - {"photo", "depth"}
    page = service.get("/docs")
    assert page.headers["content-type"].startswith("text/html")
    assert "script" not in page.headers["content-security-policy"]
    for part in ("POST /maps/{map}/localize", "horizontal field of view in degrees", "T_world_camera"):
        assert part in page.body.decode()
    assert not re.search(rb'(src|href)="(?![/#])', page.body)  # no other server is needed
    assert asyncio.run(service.ask("GET", "/maps", [], {"host": "example.org"})).status == 403
    text = service.get("/metrics").body.decode()
    for path, status in (("/localize", 200), ("refused", 403)):
        assert f'bidnerf_requests_total{{path="{path}",status="{status}"}}' in text
    assert "bidnerf_workers 1" in text
    maps = service.get("/maps").json
    assert set(maps) == {"map", "hall"}
    for facts in maps.values():
        MapFacts.model_validate(facts)
    assert service.get("/maps/hall").json["anchor"]["latitude"] == 47.4


def test_the_name_of_a_photo_in_place_of_its_content_is_told(tmp_path: Path) -> None:
    for content, expected in ((b"photo.png", "'curl -F photo=@FILE' sends it"), (b"\x89PNG", "a complete image file")):
        with pytest.raises(InputError, match="not readable as an image") as refused:
            read_upload(Upload({}, {"photo": content}), CameraSource(), tmp_path, 1e6)
        assert expected in str(refused.value)


def test_the_client_asks_a_server(inputs: Inputs, service: Service) -> None:
    client = ServiceClient(service.url, timeout=30)
    start = json.loads(inputs.start)
    found = client.localize(inputs.folder / "photo.png", map="map", focal=32, start=start)
    assert (found["frame"], found["method"]) == ("photo", "bid")
    pixels, depth = iio.imread(inputs.folder / "photo.png"), np.full((24, 24), 2.0, np.float32)
    again = client.localize(pixels, "map", focal=32, start=np.array(start), name="photo")
    assert again["T_world_camera"] == found["T_world_camera"]
    with PIL.Image.open(inputs.folder / "photo.png") as opened:
        assert client.localize(opened, "map", focal=32, start=start)["T_world_camera"] == found["T_world_camera"]
    assert client.localize(pixels[..., 0], "map", depth=depth, focal=32, start=start)["frame"] == "photo"
    with pytest.raises(ServiceError, match="float64"):
        client.localize(pixels / 2, "map")
    with pytest.raises(ServiceError, match=r"none.png: cannot be read \(No such .*\), expected the name of a file"):
        client.localize(inputs.folder / "none.png")
    for wrong in ({"start": object()}, {"camera": 7}, {"name": "\ud800"}):
        with pytest.raises(ServiceError, match="the request cannot be made: "):
            client.localize(**{"photo": b"", **wrong})
    assert set(client.maps()) == {"map", "hall"}
    assert client.health()["status"] == "ok"
    with pytest.raises(ServiceError, match="no map with that name") as refused:
        client.localize(inputs.photo, map="other")
    assert refused.value.status == 404


class Answering(BaseHTTPRequestHandler):
    """Answers each request with the next of the server's ``replies``: a status, headers and a body."""

    def do_GET(self) -> None:
        replies: list[tuple[int, dict[str, str], bytes]] = self.server.replies  # type: ignore[attr-defined]
        status, headers, body = replies.pop(0) if len(replies) > 1 else replies[0]
        self.send_response(status)
        for name, value in headers.items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *_: Any) -> None: ...


@pytest.fixture
def answering() -> Iterator[ThreadingHTTPServer]:
    with ThreadingHTTPServer(("127.0.0.1", 0), Answering) as server:
        thread = threading.Thread(target=server.serve_forever, args=[0.01])
        thread.start()
        yield server
        server.shutdown()
        thread.join()


PROBLEM = {"Content-Type": "application/problem+json"}


@pytest.mark.parametrize(
    ("status", "headers", "body", "expected"),
    [
        (200, {}, b"<html>login", r"^the answer is '<html>login', expected a JSON object"),
        (200, {}, b"[1]", "expected a JSON object"),
        (200, {"Content-Length": "100"}, b"{}", r"IncompleteRead\(2 bytes"),
        (500, {"Content-Length": "100"}, b"{}", r"IncompleteRead\(2 bytes"),
        (500, PROBLEM, b'{"title": "internal error"}', "^internal error$"),
        (500, PROBLEM, b"{", "^{$"),
        (404, {}, b"", "^the answer has the status 404$"),
        (503, {}, b"busy", "^busy$"),
    ],
)
def test_the_client_raises_the_same_error_for_every_bad_answer(
    answering: ThreadingHTTPServer, status: int, headers: dict[str, str], body: bytes, expected: str
) -> None:
    answering.replies = [(status, headers, body)]  # type: ignore[attr-defined]
    with pytest.raises(ServiceError, match=expected) as error:
        ServiceClient(f"http://127.0.0.1:{answering.server_port}", timeout=0.5).maps()
    assert error.value.status in (status, 0)


def test_the_client_pauses_before_it_asks_a_busy_service_again(
    answering: ThreadingHTTPServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    pauses = list[float]()
    monkeypatch.setattr(time, "sleep", pauses.append)
    stated = [formatdate(time.time() + 20, usegmt=True), formatdate(0, usegmt=True), "7", "0", "soon", "nan"]
    busy = [(503, {"Retry-After": value}, b"") for value in stated]
    answering.replies = [(429, {}, b""), *busy, (200, {}, b"{}")]  # type: ignore[attr-defined]
    assert ServiceClient(f"http://127.0.0.1:{answering.server_port}").health() == {}
    assert pauses == pytest.approx([1, 20, 1, 7, 1, 1, 1], abs=2.5)
    assert min(pauses) >= 1


def exchange(address: tuple[str, int], content: bytes) -> bytes:
    """Send bytes over a connection, and return what comes back until it ends."""
    with socket.create_connection(address, timeout=20) as connection:
        found = b""
        with contextlib.suppress(ConnectionError):
            connection.sendall(content)
            connection.shutdown(socket.SHUT_WR)
            while part := connection.recv(65536):
                found += part
        return found


def test_bytes_that_are_not_http_are_refused(inputs: Inputs, address: tuple[str, int]) -> None:
    drawn, body = random.Random(1), form(photo=inputs.photo, focal="32", start=inputs.start, map="map")
    head = f"POST /localize HTTP/1.1\r\nHost: localhost\r\nContent-Type: {FORM}\r\nConnection: close\r\n"
    statuses = set()
    for number in range(150):
        length = drawn.choice([len(body)] * 4 + [len(body) // 2, -1, 10**12])
        content = bytearray(f"{head}Content-Length: {length}\r\n\r\n".encode() + body)
        for _ in range(drawn.randrange(1, 9)):
            at = drawn.randrange(len(head) + 20 if number % 2 else len(content))
            content[at : at + drawn.randrange(5)] = drawn.randbytes(drawn.randrange(5))
        answer = exchange(address, bytes(content))
        statuses.add(answer[9:10] if answer.startswith(b"HTTP/1.1 ") else b"closed")
    assert statuses <= {b"2", b"4", b"closed"}
    endless = b"GET " + b"x" * 100_000 + b" HTTP/1.1\r\n\r\n"
    for content in (b"\x00\x01\r\n\r\n", b"GET / HTTP/9\r\n\r\n", endless):
        head = exchange(address, content)
        assert head.startswith(b"HTTP/1.1 400")
    for path in ("/../../etc/passwd", "//etc/passwd", "/maps/%2e%2e%2fmap.json", "/maps/%00"):
        question = f"GET {path} HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n"
        assert exchange(address, question.encode()).startswith(b"HTTP/1.1 404"), path
    head = exchange(address, b"HEAD / HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n")
    assert head.startswith(b"HTTP/1.1 200")
    assert head.endswith(b"\r\n\r\n")  # without a body
    assert exchange(address, b"GET /maps HTTP/1.1\r\nHost: example.org\r\n\r\n").startswith(b"HTTP/1.1 403")


def test_a_body_without_end_and_a_client_without_haste_are_cut_off(inputs: Inputs, address: tuple[str, int]) -> None:
    head = b"POST /localize HTTP/1.1\r\nHost: localhost\r\n"
    for length in (b"Content-Length: 2000000000", b"Transfer-Encoding: chunked"):
        sent, block = 0, bytes(2**16)
        with (
            socket.create_connection(address, timeout=20) as connection,
            contextlib.suppress(ConnectionError),
        ):
            connection.sendall(head + length + b"\r\n\r\n")
            while sent < 2 * 10**9:
                connection.sendall(b"%x\r\n%s\r\n" % (len(block), block) if b"chunked" in length else block)
                sent += len(block)
        # What the buffers of the system take, beside the megabyte that is allowed.
        assert sent < 3 * 10**7, length
    began = time.monotonic()
    with socket.create_connection(address, timeout=20) as connection:
        connection.sendall(head + b"Content-Length: 1000\r\n\r\nx")
        assert connection.recv(100).startswith(b"HTTP/1.1 408")
    assert time.monotonic() - began < 10
    for _ in range(5):  # clients that leave before the answer
        with socket.create_connection(address, timeout=20) as connection:
            body = form(photo=inputs.photo, focal="32", start=inputs.start, map="map")
            kind = f"Content-Type: {FORM}\r\nContent-Length: {len(body)}\r\n\r\n".encode()
            connection.sendall(head + kind + body)
    client = ServiceClient(f"http://{address[0]}:{address[1]}", timeout=30)
    assert client.localize(inputs.photo, map="map", focal=32, start=json.loads(inputs.start))["method"] == "bid"
    wait_until(lambda: client.ask("/health")["waiting"] == 0)


@pytest.mark.slow
def test_strangers_who_read_the_description_find_it_true(
    inputs: Inputs, address: tuple[str, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("schemathesis", reason="Schemathesis is not installed")
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2] / "benchmarks"))
    openapi = importlib.import_module("_openapi")
    # The protocols share the code of echo.
    found = openapi.run_schemathesis(f"http://{address[0]}:{address[1]}", "map", [inputs.photo], 1, without="geopose")
    assert (found["failures"], found["errors"]) == ({}, {}), found["output"]
    assert found["operations"] >= 8
    assert found["requests"] > 100


def test_a_token_that_is_given_is_not_shown(tmp_path: Path, bidnerf: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    def announced(maps: Any, *, token: str | None, ready: Any, **more: Any) -> None:
        ready("http://localhost:1", token or "made-up-0123456789")

    monkeypatch.setattr("bidnerf.cli.view.serve_maps", announced)
    (tmp_path / "token").write_text("secret-0123456789")
    given = bidnerf("serve", tmp_path, "--token-file", tmp_path / "token")
    assert "Bearer" in given.out + given.err
    assert "secret" not in given.out + given.err
    made_up = bidnerf("serve", tmp_path)
    assert "Bearer made-up-0123456789" in made_up.out + made_up.err


def test_maps_and_settings_that_cannot_be_served_are_refused(tmp_path: Path, bidnerf: Run) -> None:
    assert_refused(bidnerf("serve", tmp_path, "--port", 0), 1, tmp_path, "expected a map")
    assert maps_by_name({"a": "x"}) == maps_by_name(["a=x"]) == {"a": Path("x")}
    assert list(maps_by_name(["x/a", "b=y/a"])) == ["a", "b"]
    (tmp_path / "today").symlink_to(tmp_path)
    assert list(maps_by_name([tmp_path / "today"])) == ["today"]  # a link's own name, not its target's
    for maps, part in (
        ([], "no MAP"),
        ({"a/b": "x"}, "its name is 'a/b'"),
        (["x/a", "y/a"], "two maps are named 'a'"),
    ):
        with pytest.raises(InputError, match=part):
            maps_by_name(maps)
    with pytest.raises(InputError, match="expected at least 16"):
        service_app("MAP", token="short")
    assert service_app("MAP", method="bid", config=settings_of("bid", QUICK)) is not None
    with pytest.raises(InputError, match="int, expected settings of bid"):
        service_app("MAP", method="bid", config=5)


def test_an_internal_error_is_one_line_of_the_log(
    service: Service, inputs: Inputs, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    async def fail(*given: Any) -> Any:
        raise RuntimeError("/home/user/secret")

    monkeypatch.setattr(service.pool, "answer", fail)
    reply = service.post("/localize?map=map", inputs.photo)
    (line,) = (json.loads(record.message) for record in caplog.records if record.name == "bidnerf.service")
    detail = f"the service failed; its log names the cause under the id {line['id']}"
    assert (reply.status, reply.json["detail"]) == (500, detail)
    assert (line["status"], line["path"], line["fault"]) == (500, "/localize", "RuntimeError: /home/user/secret")
    assert "in fail" in line["traceback"]


def test_a_request_that_waits_while_the_server_is_stopped_may_be_repeated() -> None:
    """It is answered with 503, and reported, once the time that is left to it is over."""
    stop, addresses, reports = threading.Event(), SimpleQueue[str](), list[tuple[str, int]]()
    app = Application(
        "slow",
        None,
        report=lambda scope, status, *_: reports.append((scope["path"], status)),
        lifespan=lambda app: contextlib.nullcontext(),
    )

    @app.get("/slow")
    async def slow() -> None:
        stop.set()
        await asyncio.sleep(60)

    server = threading.Thread(target=run_app, args=[app, None, 0, addresses.put, stop, 1])
    server.start()
    with pytest.raises(HTTPError) as refused, urlopen(f"{addresses.get(timeout=30)}/slow", timeout=30):
        pass
    server.join(30)
    assert (refused.value.status, refused.value.headers["Retry-After"]) == (503, "5")
    assert "is being stopped" in json.load(refused.value)["detail"]
    assert reports == [("/slow", 503)]


def test_the_listening_process_does_not_load_torch() -> None:
    program = "import sys; from bidnerf.service import service_app; service_app('MAP').openapi(); print('torch' in sys.modules)"
    assert subprocess.check_output([sys.executable, "-c", program], text=True) == "False\n"


def test_what_is_no_map_is_refused_before_torch_is_imported() -> None:
    program = "import sys; from bidnerf.cli import main; print(main(['serve', 'nomap']), 'torch' in sys.modules)"
    found = subprocess.run([sys.executable, "-c", program], text=True, capture_output=True)
    assert found.stdout == "1 False\n"
    assert found.stderr.startswith("bidnerf serve: nomap: no such folder, expected a map")


def test_the_process_with_the_maps_imports_nothing_from_the_current_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "runpy.py").write_text("raise SystemExit(9)\n")
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match="no such folder"):  # not: the process died
        asyncio.run(service_app("nomap").state.pool.start())


def test_startup_of_another_server_starts_the_pool(monkeypatch: pytest.MonkeyPatch) -> None:
    """An ASGI server starts the workers and ends them by events, which are not requests and carry no token."""
    app, start, close, send = service_app("MAP", token="0123456789abcdef"), AsyncMock(), AsyncMock(), AsyncMock()
    monkeypatch.setattr(app.state.pool, "start", start)
    monkeypatch.setattr(app.state.pool, "close", close)
    receive = AsyncMock(side_effect=[{"type": "lifespan.startup"}, {"type": "lifespan.shutdown"}])
    asyncio.run(app({"type": "lifespan", "asgi": {"version": "3.0"}, "state": {}}, receive, send))
    answers = [call.args[0]["type"] for call in send.await_args_list]
    assert answers == ["lifespan.startup.complete", "lifespan.shutdown.complete"]
    assert (start.await_count, close.await_count) == (1, 1)
