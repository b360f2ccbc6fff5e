"""The HTTP service under load, under kills and under attack, asked over sockets as clients do.

    python benchmarks/service.py MAP:DATA [--seconds 60] [--workers 2] [--work FILE] [--part load kills malformed hostile schema]

- ``load``: 1, 4 and 16 clients ask for the poses of test images, with their depth, for some seconds each. Latency, memory (of all
  processes, shared pages counted once), and whether each answer is that of ``bidnerf localize``;
- ``kills``: 4 clients, while a worker is killed every other second: no request may be lost;
- ``malformed``: 1,000 requests whose bytes are drawn or changed at random, the head included: none may be answered with 5xx;
- ``hostile``: a slow client, clients that leave, bodies of 2 GB, idle connections, images that decode to gigabytes, paths outside,
  requests by other names of the host;
- ``schema`` (where Schemathesis is installed): requests that are drawn from the service's own OpenAPI description, valid ones and
  ones that contradict it, and photos in every way that it describes; without a token, and with one.

Finished parts are kept in the file of ``--work``, with the commit that they ran on, and not repeated.
"""

from __future__ import annotations

import contextlib
import http.client
import json
import os
import random
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
import zlib
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from urllib.parse import urlsplit

import _openapi
import numpy as np
import psutil
from _lab import Row, parser, record

from bidnerf.evaluation import provenance

FORM = "multipart/form-data; boundary=boundary"
CLIENTS = (1, 4, 16)
GIGABYTES = 2 * 10**9
TOKEN = "0123456789abcdef0123"
SCHEMA_PHOTOS, SCHEMA_EXAMPLES = 4, 40
"""Photos that Schemathesis sends, and the most requests that it draws for each operation."""


@dataclass(frozen=True)
class Photo:
    """A request, and the answer of the command line."""

    body: bytes
    expected: dict[str, Any]
    image: bytes = b""


class Server:
    """A running ``bidnerf serve``."""

    def __init__(self, folder: Path, *options: str) -> None:
        program = "import sys; from bidnerf.cli import main; sys.exit(main())"
        command = [sys.executable, "-c", program, "serve", str(folder), "--port", "0", *options]
        self.process = subprocess.Popen(
            command, stderr=subprocess.PIPE, text=True, env=os.environ | {"OMP_NUM_THREADS": "1"}
        )
        assert self.process.stderr is not None
        first = self.process.stderr.readline()
        self.address = urlsplit(first.split(" at ")[1].split(";")[0])
        self.log: list[str] = []
        threading.Thread(target=lambda: self.log.extend(self.process.stderr or []), daemon=True).start()

    def ask(
        self, method: str, path: str, body: bytes | None = None, kind: str = FORM, timeout: float = 120
    ) -> tuple[int, bytes]:
        connection = http.client.HTTPConnection(str(self.address.hostname), self.address.port, timeout=timeout)
        with contextlib.closing(connection):
            connection.request(method, path, body, {"Content-Type": kind})
            answer = connection.getresponse()
            return answer.status, answer.read()

    def raw(self, content: bytes, timeout: float = 30) -> bytes:
        """Send bytes, and return what comes back until the connection ends."""
        with socket.create_connection((self.address.hostname, self.address.port), timeout=timeout) as connection:
            with contextlib.suppress(OSError):
                connection.sendall(content)
                connection.shutdown(socket.SHUT_WR)
            found = b""
            with contextlib.suppress(ConnectionError):
                while part := connection.recv(65536):
                    found += part
            return found

    def metric(self, name: str) -> float:
        text = self.ask("GET", "/metrics")[1].decode()
        return sum(float(line.rpartition(" ")[2]) for line in text.splitlines() if line.startswith(f"bidnerf_{name}"))

    def processes(self) -> list[int]:
        """Return the service, the process with the maps, and the workers."""
        children = psutil.Process(self.process.pid).children(recursive=True)
        return [self.process.pid, *(child.pid for child in children)]

    def memory(self) -> float:
        """Return the memory of all processes in MiB, with each page that they share counted once."""
        total = 0
        for process in self.processes():
            with contextlib.suppress(OSError):
                lines = Path(f"/proc/{process}/smaps_rollup").read_text().splitlines()
                total += sum(int(line.split()[1]) for line in lines if line.startswith("Pss:"))
        return total / 1024

    def close(self) -> int:
        self.process.send_signal(signal.SIGTERM)
        return self.process.wait(30)


@contextlib.contextmanager
def serve_maps(folder: Path, workers: int, *options: str) -> Iterator[Server]:
    server = Server(folder, "--workers", str(workers), *options)
    try:
        yield server
    finally:
        assert server.close() == 0, "the service did not end as it should"
        faults = [line for line in server.log if "Traceback" in line or '"fault"' in line]
        assert not faults, faults[:3]


def photos(folder: Path, data: Path, count: int) -> list[Photo]:
    """Return test images with their depth and camera as requests, and the answers of ``bidnerf localize``, one process for all."""
    described = json.loads((data / "transforms_test.json").read_text())
    frames = described["frames"][:: max(1, len(described["frames"]) // count)][:count]
    camera = json.dumps({k: v for k, v in described.items() if k in ("w", "h", "fl_x", "fl_y", "cx", "cy")})
    images = [data / frame["file_path"] for frame in frames]
    depth = [data / frame["depth_file_path"] for frame in frames]
    with TemporaryDirectory() as place:
        (Path(place) / "camera.json").write_text(camera)
        program = "import sys; from bidnerf.cli import main; sys.exit(main())"
        words = [
            "localize",
            folder,
            *images,
            "--depth",
            *depth,
            "--depth-unit",
            "0.001",
            "--camera",
            f"{place}/camera.json",
        ]
        done = subprocess.run(
            [sys.executable, "-c", program, *map(str, words), "--json"],
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
            check=True,
            env=os.environ | {"OMP_NUM_THREADS": "1"},
        )
    answers = [json.loads(line) for line in done.stdout.splitlines()]
    unit, given = b"0.001", camera.encode()
    return [
        Photo(
            form(
                photo=image.read_bytes(),
                depth=d.read_bytes(),
                depth_unit=unit,
                camera=given,
                name=image.stem.encode(),
            ),
            answer,
            image.read_bytes(),
        )
        for image, d, answer in zip(images, depth, answers, strict=True)
    ]


def form(**parts: bytes) -> bytes:
    text = b""
    for name, content in parts.items():
        file = f'; filename="{name}"' if name in ("photo", "depth", "camera") else ""
        text += (
            f'--boundary\r\nContent-Disposition: form-data; name="{name}"{file}\r\n\r\n'.encode() + content + b"\r\n"
        )
    return text + b"--boundary--\r\n"


def difference(found: dict[str, Any], expected: dict[str, Any]) -> float:
    """Return the largest difference of the numbers of two answers, infinite where anything but numbers and times differs."""
    if found.keys() != expected.keys():
        return float("inf")
    worst = 0.0
    for key in found.keys() - {"seconds"}:
        a, b = found[key], expected[key]
        if key in ("T_world_camera", "covariance") and a is not None and b is not None:
            worst = max(worst, float(np.abs(np.subtract(a, b)).max()))
        elif isinstance(a, float) and isinstance(b, float):
            worst = max(worst, abs(a - b) / max(1.0, abs(b)))
        elif key != "intrinsics" and a != b:
            return float("inf")
    return worst


def run_clients(server: Server, given: list[Photo], clients: int, seconds: float) -> Row:
    """Let clients ask for some seconds; return latencies, statuses and how far answers differ from the expected ones."""
    until, taken, statuses, worst = time.monotonic() + seconds, list[float](), Counter[str](), list[float]()

    def ask(number: int) -> None:
        place = number
        while time.monotonic() < until:
            photo, began = given[place % len(given)], time.perf_counter()
            try:
                status, body = server.ask("POST", "/localize", photo.body)
            except OSError as error:
                statuses[type(error).__name__] += 1
                continue
            taken.append(time.perf_counter() - began)
            statuses[str(status)] += 1
            if status == 200:
                worst.append(difference(json.loads(body), photo.expected))
            place += clients

    threads = [threading.Thread(target=ask, args=[number]) for number in range(clients)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    p50, p95, p99 = map(float, np.percentile(taken, [50, 95, 99]))
    return {
        "clients": clients,
        "seconds": seconds,
        "requests": sum(statuses.values()),
        "statuses": dict(statuses),
        "latency_seconds": {"p50": p50, "p95": p95, "p99": p99},
        "per_second": len(taken) / seconds,
        "identical": sum(value == 0 for value in worst),
        "largest_difference": max(worst, default=0.0),
    }


def load(folder: Path, given: list[Photo], workers: int, seconds: float) -> Row:
    rows = []
    with serve_maps(folder, workers) as server:
        loaded = server.memory()
        run_clients(server, given, workers, 10)  # a worker's memory grows with its first requests
        for clients in CLIENTS:
            before = server.memory()
            row = run_clients(server, given, clients, seconds)
            rows.append(row | {"memory_MiB": {"before": before, "after": server.memory()}})
            print(rows[-1], flush=True)
        return {"memory_MiB_without_requests": loaded, "levels": rows}


def kills(folder: Path, given: list[Photo], workers: int, seconds: float) -> Row:
    drawn, killed = random.Random(0), 0
    with serve_maps(folder, workers) as server:
        done = threading.Event()

        def kill() -> None:
            nonlocal killed
            while not done.wait(2):
                workers_of = server.processes()[2:]
                if workers_of:
                    os.kill(drawn.choice(workers_of), signal.SIGKILL)
                    killed += 1

        killer = threading.Thread(target=kill)
        killer.start()
        row = run_clients(server, given, 4, seconds)
        done.set()
        killer.join()
        return row | {"killed": killed, "replaced": server.metric("worker_restarts_total")}


def malformed(folder: Path, given: list[Photo], workers: int, seconds: float) -> Row:
    """Send 1,000 requests that are wrong in the head, in the form, in the image or in the values."""
    drawn, statuses, slowest = random.Random(0), Counter[str](), 0.0
    small = form(photo=png(40, 30), focal=b"30", seed=b"1", start=b"[[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]")
    bodies = [
        (b"/localize", FORM, small),
        (b"/localize", FORM, given[0].body),
    ]
    bodies += [(b"/localize?focal=30", "image/png", png(40, 30)), (b"/maps/x/localize", FORM, small)]
    with serve_maps(folder, workers) as server:
        before = server.memory()
        for number in range(1000):
            path, kind, body = drawn.choice(bodies)
            head = b"POST %s HTTP/1.1\r\nHost: localhost\r\nContent-Type: %s\r\n" % (path, kind.encode())
            length = drawn.choice([len(body)] * 8 + [len(body) // 2, len(body) + 10, -1, 10**12])
            content = bytearray(head + b"Content-Length: %d\r\nConnection: close\r\n\r\n" % length + body)
            last = len(content) if number % 3 else len(head)
            for _ in range(drawn.randrange(1, 12)):
                at = drawn.randrange(last)
                content[at : at + drawn.randrange(5)] = drawn.randbytes(drawn.randrange(5))
            began = time.monotonic()
            answer = server.raw(bytes(content))
            slowest = max(slowest, time.monotonic() - began)
            statuses[answer[9:12].decode() if answer.startswith(b"HTTP/1.1 ") else "closed"] += 1
        alive = server.ask("POST", "/localize", given[0].body)[0]
        return {
            "requests": 1000,
            "statuses": dict(sorted(statuses.items())),
            "slowest_seconds": slowest,
            "memory_MiB": {"before": before, "after": server.memory()},
            "then": alive,
            "workers_ended": server.metric('worker_restarts_total{reason="died"}'),
        }


def png(width: int, height: int) -> bytes:
    """Return a PNG of one bit a pixel, all of which are black; a large one is cut short."""

    def chunk(kind: bytes, content: bytes) -> bytes:
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))

    head = struct.pack(">IIBBBBB", width, height, 1, 0, 0, 0, 0)
    rows = zlib.compress(bytes(((width + 7) // 8 + 1) * min(height, 4000)), 9)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", rows) + chunk(b"IEND", b"")


def hostile(folder: Path, given: list[Photo], workers: int, seconds: float) -> Row:
    found: Row = {}
    with serve_maps(folder, workers, "--upload-timeout", "5") as server:
        before = server.memory()
        found["2 GB announced"] = flood(server, chunked=False)
        found["2 GB in chunks"] = flood(server, chunked=True)
        found["slow client"] = beside(server, given, lambda: slow(server))
        found["50 clients that leave"] = beside(server, given, lambda: leave(server, given[0]))
        with contextlib.ExitStack() as open_ones:
            for _ in range(200):
                idle = socket.create_connection((server.address.hostname, server.address.port))
                open_ones.enter_context(idle)
            found["health beside 200 idle connections"] = server.ask("GET", "/health")[0]
        bomb = form(photo=png(60000, 60000), focal=b"30")
        found["image of 3.6 gigapixels"] = [server.ask("POST", "/localize", bomb)[0], len(bomb)]
        paths = (
            "/../../etc/passwd",
            "/maps/..%2f..%2fetc%2fpasswd",
            "/maps/%2fetc%2fpasswd",
            "//etc/passwd",
            "/maps/.%00",
        )
        found["paths outside"] = {
            p: status_of(server.raw(f"GET {p} HTTP/1.1\r\nHost: localhost\r\n\r\n".encode())) for p in paths
        }
        named = server.ask(
            "POST",
            "/localize",
            given[0].body.replace(given[0].expected["frame"].encode() + b"\r\n", b"<script>\r\n"),
        )
        found["a frame named <script>"] = [named[0], json.loads(named[1]).get("frame")]
        found["another host"] = status_of(server.raw(b"GET /maps HTTP/1.1\r\nHost: example.org\r\n\r\n"))
        origin = b"GET /maps HTTP/1.1\r\nHost: localhost\r\nOrigin: https://example.org\r\n\r\n"
        found["a page of another site"] = status_of(server.raw(origin))
        found["memory_MiB"] = {"before": before, "after": server.memory()}
    token = TemporaryDirectory()
    file = Path(token.name) / "token"
    file.write_text(TOKEN)
    with token, serve_maps(folder, workers, "--host", "0.0.0.0", "--token-file", str(file)) as server:
        asked_for = b"GET /maps HTTP/1.1\r\nHost: localhost\r\n"
        found["with --host, without the token"] = status_of(server.raw(asked_for + b"\r\n"))
        found["with --host and the token"] = status_of(
            server.raw(asked_for + f"Authorization: Bearer {TOKEN}\r\n\r\n".encode())
        )
    return found


def status_of(answer: bytes) -> int | str:
    return int(answer[9:12]) if answer.startswith(b"HTTP/1.1 ") else "closed"


def flood(server: Server, chunked: bool) -> Row:
    """Send a body of 2 GB; return how much was sent before the connection ended, and the most memory meanwhile."""
    length = "Transfer-Encoding: chunked" if chunked else f"Content-Length: {GIGABYTES}"
    sent, peak, answer, block = 0, 0.0, b"", bytes(2**20)
    with socket.create_connection((server.address.hostname, server.address.port), timeout=30) as connection:
        connection.sendall(f"POST /localize HTTP/1.1\r\nHost: localhost\r\n{length}\r\n\r\n".encode())
        try:
            while sent < GIGABYTES:
                connection.sendall(b"%x\r\n%s\r\n" % (len(block), block) if chunked else block)
                sent += len(block)
                peak = max(peak, server.memory())
        except OSError:
            pass
        with contextlib.suppress(OSError):
            answer = connection.recv(65536)
    return {"status": status_of(answer), "sent_MiB": sent / 2**20, "peak_MiB": peak}


def beside(server: Server, given: list[Photo], attack: Callable[[], Row]) -> Row:
    """Attack while two clients ask; return both."""
    results: Row = {}
    attacking = threading.Thread(target=lambda: results.update(attack()))
    attacking.start()
    row = run_clients(server, given, 2, 8)
    attacking.join()
    return results | {"others": {key: row[key] for key in ("statuses", "latency_seconds")}}


def slow(server: Server) -> Row:
    """Send a byte every 0.2 s; return what comes back, and when."""
    began = time.monotonic()
    with socket.create_connection((server.address.hostname, server.address.port), timeout=30) as connection:
        connection.sendall(b"POST /localize HTTP/1.1\r\nHost: localhost\r\nContent-Length: 100000\r\n\r\n")
        answer = b""
        with contextlib.suppress(OSError):
            while not answer and time.monotonic() - began < 30:
                connection.sendall(b"x")
                connection.settimeout(0.2)
                with contextlib.suppress(TimeoutError):
                    answer = connection.recv(65536) or b"closed"
    return {"status": status_of(answer), "seconds": time.monotonic() - began}


def leave(server: Server, photo: Photo) -> Row:
    """Send requests, and close the connections without waiting for the answers."""
    before = server.metric('worker_restarts_total{reason="cancelled"}')
    head = f"POST /localize HTTP/1.1\r\nHost: localhost\r\nContent-Type: {FORM}\r\nContent-Length: {len(photo.body)}\r\n\r\n"
    for number in range(50):
        with socket.create_connection((server.address.hostname, server.address.port), timeout=30) as connection:
            connection.sendall(head.encode() + photo.body[: len(photo.body) // (1 + number % 2)])
            time.sleep(0.1)
    return {"work_stopped": server.metric('worker_restarts_total{reason="cancelled"}') - before}


def schema(folder: Path, given: list[Photo], workers: int, seconds: float) -> Row:
    """Let Schemathesis ask a service without a token, and one with a token, which it also leaves out."""
    images = [photo.image for photo in given[:SCHEMA_PHOTOS]]
    found: Row = {"photos": len(images)}
    with TemporaryDirectory() as place:
        (Path(place) / "token").write_text(TOKEN)
        closed = ("--host", "0.0.0.0", "--token-file", f"{place}/token")
        for name, options, token, examples in (
            ("without a token", (), None, SCHEMA_EXAMPLES),
            ("with a token", closed, TOKEN, SCHEMA_EXAMPLES // 8),
        ):
            with serve_maps(folder, workers, *options) as server:
                before = server.memory()
                address = f"http://127.0.0.1:{server.address.port}"
                row = _openapi.run_schemathesis(address, folder.resolve().name, images, examples, token=token)
                print(row.pop("output"), file=sys.stderr)
                row["headers"] = sorted(set().union(*row["headers"].values()))
                ended = None if token else server.metric('worker_restarts_total{reason="died"}')
                found[name] = row | {
                    "memory_MiB": {"before": before, "after": server.memory()},
                    "workers_ended": ended,
                }
    return found


PARTS = {"load": load, "kills": kills, "malformed": malformed, "hostile": hostile}
if _openapi.is_installed():
    PARTS["schema"] = schema


def main() -> None:
    options = parser(__doc__, "service")
    options.add_argument(
        "scene", metavar="MAP:DATA", help="folder of a map, folder of its dataset with transforms_test.json"
    )
    options.add_argument("--seconds", type=float, default=60.0, help="of each level of load (default: %(default)s)")
    options.add_argument("--workers", type=int, default=2)
    options.add_argument("--photos", type=int, default=12, help="different test images (default: %(default)s)")
    options.add_argument("--part", nargs="+", choices=PARTS, default=list(PARTS))
    options.add_argument("--work", type=Path, help="file in which finished parts are kept")
    given = options.parse_args()
    folder, data = map(Path, given.scene.split(":", 1))
    done: Row = json.loads(given.work.read_text()) if given.work and given.work.exists() else {}
    missing = [part for part in given.part if part not in done]
    requests = photos(folder, data, given.photos) if missing else []
    for part in missing:
        run = provenance("", "")
        done[part] = PARTS[part](folder, requests, given.workers, given.seconds)
        done[part]["run"] = {"date": run.date, "commit": run.commit, "dirty": run.dirty}
        print(part, json.dumps(done[part]), flush=True)
        if given.work:
            given.work.write_text(json.dumps(done))
    if set(done) >= set(PARTS):
        record(
            given.name,
            {"scene": data.name, "workers": given.workers, "different_photos": given.photos, **done},
        )


if __name__ == "__main__":
    main()
