"""Attacks by what lies around: maps, answers, cameras and results from somebody else, the current folder, archives, and clients.

Beside a sound end, each case must leave the files of a folder that it was not given as they are, print nothing of them, and run
no code: neither a file that these make nor a module of the current folder.
"""

from __future__ import annotations

import contextlib
import json
import os
import pickle
import re
import shutil
import socket
import struct
import subprocess
import sys
import time
import warnings
import zipfile
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import psutil

import tiny
from attacks import MEMORY, SECONDS, send, served
from harness import AUTO, BAKED, QUICK, Check, Checks, command, defects, files_of, run, sound_folder

Edit = Callable[[Path], object]
SECRET = "SECRET-4711"
SCRIPT = "<script>alert(1)</script>\x1b[2J\n${x}$\\frac{1"
ROWS = "[[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]"
INFO = [["info", "{}/map"], ["info", "{}/map", "--json"], ["info", "{}/map", "--plot", "{}/plot.png"]]
LOCALIZE = ["localize", "{}/map", "{}/photo.png", "--hfov", "40", *AUTO]
STARTED = ["localize", "{}/map", "{}/photo.png", "--hfov", "40", "--start", "{}/pose.json", *QUICK]
REPORT = ["report", "{}/results.jsonl", "--out", "{}/new"]
OVERWRITE = ["train", "{}/data", "--out", "{}/map", "--overwrite", *tiny.options(2)]
BAKE = ["bake", "{}/map", "--data", "{}/data", *BAKED]
SCALE = ["scale", "{}/map", "--factor", "2"]
EXPORTS = [["export", "{}/map", "--to", kind, "--out", "{}/e"] for kind in ("ply", "colmap", "transforms.json")]
VIEW = ["view", "{}/map", "--save", "{}/view.html"]
RENDER = ["render", "{}/map", "{}/data", "--out", "{}/new"]


class Guarded:
    """Runs commands on copies of sound files, beside a folder that they were not given."""

    def __init__(self, work: Path, sound: Path) -> None:
        self.work, self.sound, self.owned = work, sound, work / "owned"
        self.victim = work / "victim"
        self.victim.mkdir()
        for name in ("keep.txt", "weights-00000006-aaaaaaaa.safetensors"):
            (self.victim / name).write_text(SECRET)

    def case(self, name: str, edit: Edit, *doors: list[str]) -> Checks:
        for door in doors:
            folder = Path(shutil.copytree(self.sound, self.work / "case", symlinks=True))
            edit(folder)
            before = files_of(folder)
            words = [word.replace("{}", str(folder)) for word in door]
            found = run(words, self.work / "log", SECONDS, memory=MEMORY, before=partial(os.chdir, folder))
            yield Check(f"{name}: {door[0]}", (*defects(found, folder, before), *self.harm(found.out + found.err)))
            shutil.rmtree(folder)

    def harm(self, said: str) -> Iterator[str]:
        """Yield what was executed, changed outside, or given away."""
        if self.owned.exists():
            yield f"executed: {self.owned.read_text()[:100]}"
            self.owned.unlink()
        if [file.read_text() for file in self.victim.iterdir()] != [SECRET] * 2:
            yield "changed outside"
        if SECRET in said:
            yield "read outside"


def guarded(work: Path) -> Guarded:
    """Return a runner in an empty folder, in which it writes the sound files."""
    return Guarded(work, sound_folder(work / "sound"))


def in_json(file: str, value: str, *keys: Any) -> Edit:
    """Put JSON text at ``keys`` of a file."""

    def edit(folder: Path) -> None:
        path = folder / file
        plain = part = json.loads(path.read_text())
        for key in keys[:-1]:
            part = part[key]
        part[keys[-1]] = "@here@"
        path.write_text(json.dumps(plain).replace('"@here@"', value) + "\n")

    return edit


def written(name: str, content: str | bytes) -> Edit:
    return lambda folder: (folder / name).write_bytes(content if isinstance(content, bytes) else content.encode())


# Maps.


def maps(guarded: Guarded) -> Checks:
    """Check maps whose description names or links to what is not theirs, and whose numbers no training writes."""
    plain = json.loads((guarded.sound / "map/map.json").read_text())
    for name in ("../victim/keep.txt", "/etc/passwd", "..", "a\\..\\b", "\0", "\x1b[2J", "x" * 300, "map.json"):
        for part in ("weights", "landmarks", "capture"):
            yield from guarded.case(
                f"{part} {name[:20]!r}", in_json("map/map.json", json.dumps(name), part), INFO[0], OVERWRITE, BAKE
            )

    def linked(folder: Path, part: str, to: str) -> None:
        (folder / "map" / plain[part]).unlink()
        (folder / "map" / plain[part]).symlink_to(to)

    def moved(folder: Path) -> None:
        shutil.move(folder / "map", folder / "elsewhere")
        (folder / "map").symlink_to("elsewhere")

    def swept(folder: Path) -> None:
        link = folder / "map/weights-00000099-aaaaaaaa.safetensors"
        link.symlink_to(guarded.victim / "weights-00000006-aaaaaaaa.safetensors")
        (folder / "map/surface-00000099-aaaaaaaa.safetensors").mkdir()

    for to in (guarded.victim / "keep.txt", "/dev/zero", "/dev/stdin", "/proc/kmsg", "/proc/self/mem", "nowhere"):
        for part in ("weights", "landmarks"):
            yield from guarded.case(
                f"link of {part} to {Path(to).name}", partial(linked, part=part, to=str(to)), INFO[0], OVERWRITE, BAKE
            )
    for name, edit in {"folder is a link": moved, "links left over": swept}.items():
        yield from guarded.case(name, edit, INFO[0], LOCALIZE, OVERWRITE, BAKE, SCALE)
    for part, other in (("weights", "landmarks"), ("landmarks", "weights"), ("landmarks", "surface")):
        copied = partial(lambda folder, a, b: shutil.copy(folder / "map" / b, folder / "map" / a), a=plain[part])
        yield from guarded.case(f"{other} as {part}", partial(copied, b=plain[other]), INFO[0], LOCALIZE)
    command("train", guarded.sound / "data", "--out", guarded.work / "other", *tiny.options(2), "--width", "8")
    others = guarded.work / "other" / json.loads((guarded.work / "other/map.json").read_text())["weights"]
    yield from guarded.case(
        "weights of another map",
        lambda folder: shutil.copy(others, folder / "map" / plain["weights"]),
        INFO[0],
        LOCALIZE,
    )
    for key, value in {
        "step": "9223372036854775807",
        "added": "999999999",
        "seconds": "1e308",
        "origin": "[1e308, 1e308, 1e308]",
        "gravity_up": "[0, 0, 0]",
        "colour_noise": "1e308",
        "config": '{"a":' * 3000 + "1" + "}" * 3000,
        "data": json.dumps(SCRIPT * 100_000),
        "landmark_features": '"../../x"',
        "backend": '"../../../etc"',
        "field_frame": '{"scale": 1e-300, "bounds": null}',
        "version": "99999999999999999999",
        SCRIPT: "1",
    }.items():
        doors = [*INFO, LOCALIZE, SCALE, VIEW, *EXPORTS]
        yield from guarded.case(f"{key[:20]!r} {value[:20]}", in_json("map/map.json", value, key), *doors)
    for name in (SCRIPT, "../../../x", "a\nb"):
        edit = in_json("map/map.json", json.dumps(name), "cameras", 0, "name")
        yield from guarded.case(f"camera {name[:10]!r}", edit, *INFO, VIEW, *EXPORTS)
    for value in (10**9, 1e308, 0):
        for key in ("samples_per_ray", "cells_per_pixel", "grid_resolution", "width"):
            edit = in_json("map/map.json", json.dumps(value), "config", key)
            yield from guarded.case(f"{key} {value}", edit, INFO[0], RENDER, LOCALIZE)


# Answers, results and cameras.


def repeated(count: int, change: Callable[[dict[str, Any], int], object]) -> Edit:
    """Repeat a result, each time with a change by its number."""

    def edit(folder: Path) -> None:
        path, rows = folder / "results.jsonl", list[str]()
        first = path.read_text().splitlines()[0]
        for number in range(count):
            row = json.loads(first)
            change(row, number)
            rows.append(json.dumps(row))
        path.write_text("\n".join([*rows, ""]))

    return edit


def results(guarded: Guarded) -> Checks:
    """Check results and poses that are read back."""
    row = json.loads((guarded.sound / "results.jsonl").read_text().splitlines()[0])
    for key in (key for key, value in row.items() if isinstance(value, str)):
        for text in (SCRIPT, "a" * 300_000, "../../etc/passwd"):
            yield from guarded.case(
                f"result: {key} {text[:9]!r}", in_json("results.jsonl", json.dumps(text), key), REPORT
            )
    for key in (key for key, value in row.items() if type(value) in (int, float)):
        for value in ("1e308", "-1", "9223372036854775807"):
            yield from guarded.case(f"result: {key} {value}", in_json("results.jsonl", value, key), REPORT)
    trace = {"translation": [1e308] * 100_000, "rotation_deg": [0.0] * 100_000}
    for name, edit in {
        "5,000 methods": repeated(5_000, lambda row, n: row.update(method=f"m{n}", seed=n)),
        "5,000 frames": repeated(5_000, lambda row, n: row.update(frame=f"m{n}", seed=n)),
        "100,000 steps beside a thousand trials": repeated(
            1_000, lambda row, n: row.update(seed=n, errors=row["errors"] if n else trace)
        ),
        "runs": written("results.meta.json", json.dumps({"runs": [{"date": SCRIPT, "command": SCRIPT}]})),
        "page is a link": lambda folder: (
            (folder / "new").mkdir(),
            (folder / "new/index.html").symlink_to(guarded.victim / "keep.txt"),
        ),
        "folder is a link": lambda folder: (folder / "new").symlink_to(guarded.victim),
    }.items():
        yield from guarded.case(f"results: {name}", edit, REPORT)
    row = {"frame": "a", "T_world_camera": json.loads(ROWS)}
    for name, text in {
        "nested": "[" * 5000 + "]" * 5000,
        "names": json.dumps([row | {"frame": f"{SCRIPT}{n}"} for n in range(20_000)]),
        "lines": "{}\n" * 500_000,
        "twice": json.dumps([row, row]),
        "far": ROWS.replace("0]", "1e308]", 1),
        "six axes": json.dumps([[[[[[1] * 9] * 9] * 9] * 9] * 9] * 9),
        "nan": ROWS.replace("1", "NaN", 1),
        "digits": ROWS.replace("1", "1" * 5000, 1),
        "object": '{"T_world_camera": {"0": [1]}}',
        "trajectory": "1 0 0 0 0 0 0 1\n",
    }.items():
        yield from guarded.case(f"start: {name}", written("pose.json", text), STARTED)


def cameras(guarded: Guarded) -> Checks:
    """Check files of cameras, by content and by each ending."""
    secret, owned = guarded.victim / "keep.txt", f"touch {guarded.owned}"
    for name, text in {
        "lines": "a\n" * 2_000_000,
        "list": "".join(f"{n}.png SIMPLE_RADIAL 24 24 32 12 12 0\n" for n in range(300_000)),
        "matrix": "1e308 0 1\n0 1e308 1\n0 0 1\n",
        "entities": '<!DOCTYPE a [<!ENTITY b "bb"><!ENTITY c "&b;&b;&b;">]><opencv_storage><a>&c;</a></opencv_storage>',
        "external entity": f'<!DOCTYPE a [<!ENTITY x SYSTEM "file://{secret}">]><calibration>&x;</calibration>',
        "deep": "<a>" * 200_000 + "</a>" * 200_000,
        "tag": f"%YAML:1.0\n---\ncamera_matrix: !!python/object/apply:os.system ['{owned}']\n",
        "tag alone": f"!!python/object/apply:os.system ['{owned}']\n",
        "include": f"!include {secret}\n",
        "answer": json.dumps(
            {"intrinsics": {"width": 10**9, "height": 1, "fx": 1e-300, "fy": 1, "cx": 1e308, "cy": 0}}
        ),
        "lens": json.dumps({"fl_x": 32, "fl_y": 32, "cx": 12, "cy": 12, "w": 24, "h": 24, "k1": 1e8, "k2": -1e8}),
        "numbers": "1 " * 3_000_000,
        "dots": "." * 3_000_000,
        "zeros": "\0" * 1_000_000,
    }.items():
        for ending in ("json", "txt", "yaml", "xml"):
            door = ["localize", "{}/map", "{}/photo.png", "--camera", f"{{}}/own.{ending}", *AUTO]
            yield from guarded.case(f"camera.{ending}: {name}", written(f"own.{ending}", text), door)


# Paths, archives and code.


class Owning:
    """An object whose pickle runs a command."""

    def __init__(self, file: Path) -> None:
        self.file = file

    def __reduce__(self) -> Any:
        return os.system, (f"touch {self.file}",)


def paths(guarded: Guarded) -> Checks:
    """Check paths of what is no file of the user in each place of the command line, and files that run code when they are loaded."""
    bad = ("/dev/zero", "/dev/stdin", "/proc/kmsg", "/proc/self/mem", "/", "", "-", "http://127.0.0.1:1/x", "s3://x/y")
    doors = [
        [*LOCALIZE[:4], "40", "--camera", "@"],
        ["localize", "{}/map", "@", *AUTO],
        ["localize", "@", "{}/photo.png", *AUTO],
        [*STARTED[:6], "@", *QUICK],
        [*LOCALIZE, "--depth", "@"],
        *(
            ["localize", "{}/map", "{}/data", option, "@", *AUTO]
            for option in ("--masks", "--images", "--register-depth")
        ),
        ["report", "@", "--out", "{}/new"],
        *([name, "@", "--out", "{}/new"] for name in ("import", "train", "poses")),
        ["track", "{}/map", "@", "--out", "{}/n.json"],
        ["info", "@"],
        ["serve", "@"],
        ["evaluate", "{}/map", "@", "--out", "{}/n.jsonl", "--trials", "1"],
    ]
    for path in bad:
        yield from guarded.case(
            f"path {path!r}", lambda folder: None, *([path if w == "@" else w for w in d] for d in doors)
        )
    owning = pickle.dumps(Owning(guarded.owned))
    loaded = np.empty(1, dtype=object)
    loaded[0] = Owning(guarded.owned)

    def archive(folder: Path, name: str, members: dict[str, bytes], twice: bool = False, link: bool = False) -> None:
        with zipfile.ZipFile(folder / name, "w") as made, warnings.catch_warnings():
            warnings.simplefilter("ignore")
            for member, content in members.items():
                facts = zipfile.ZipInfo(member)
                facts.external_attr = (0o120777 if link else 0o100644) << 16
                for _ in range(1 + twice):
                    made.writestr(facts, content)

    parts = {"a/data.pkl": owning, "a/version": b"3\n", "a/byteorder": b"little"}
    files: dict[str, Edit] = {
        "a.pt": partial(archive, name="a.pt", members=parts),
        "a.ckpt": written("a.ckpt", owning),
        "a.npy": lambda folder: np.save(folder / "a.npy", loaded, allow_pickle=True),
        "a.npz": lambda folder: np.savez(folder / "a.npz", points=loaded),
        "a.r3d": partial(archive, name="a.r3d", members={"metadata": b"{}", "../../victim/keep.txt": b"x"}, twice=True),
        "b.r3d": partial(
            archive, name="b.r3d", members={"metadata": b"/etc/passwd", "rgbd/0.jpg": b"/etc/passwd"}, link=True
        ),
        "config.yml": written("config.yml", f"!!python/object/apply:os.system ['touch {guarded.owned}']\n"),
        "a.mp4": written("a.mp4", f"#EXTM3U\n#EXTINF:1,\nfile://{guarded.victim}/keep.txt\nhttp://127.0.0.1:1/x\n"),
        "b.mp4": written("b.mp4", f"ffconcat version 1.0\nfile {guarded.victim}/keep.txt\n"),
        "a.svg": written("a.svg", f'<svg><image href="file://{guarded.victim}/keep.txt"/></svg>'),
        "a.jpg": written(
            "a.jpg", f"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n(%pipe%touch {guarded.owned}) (w) file\n"
        ),
        "images.txt": written("images.txt", "1 1 0 0 0 0 0 0 1 a\x1b[2J\u2028b ../../victim/keep.txt\n\n"),
        "groundtruth.txt": written("groundtruth.txt", "1e400 0 0 0 0 0 0 1\n-1e308 0 0 0 0 0 0 1\x1b[2J\n"),
    }
    for name, edit in files.items():
        own = f"{{}}/{name}"
        yield from guarded.case(
            name,
            edit,
            ["import", own, "--out", "{}/new"],
            ["train", own, "--out", "{}/new"],
            ["localize", "{}/map", own, "--hfov", "40", *AUTO],
            [*LOCALIZE, "--depth", own],
            ["train", "{}/data", "--out", "{}/new", "--depth-points", own, *tiny.options(2)],
        )


def current_folder(guarded: Guarded) -> Checks:
    """Check that programs in a folder of modules and settings with usual names import and heed none of them."""
    folder, sound = guarded.work / "current", guarded.sound
    folder.mkdir()
    evil = f"open({str(guarded.owned)!r}, 'a').write(__name__)\nraise SystemExit(9)\n"
    packages = ("torch", "numpy", "scipy", "bidnerf", "bidnerf_core", "sitecustomize", "psutil", "evil", "matplotlib")
    for name in (*sys.stdlib_module_names, *packages):
        (folder / f"{name}.py").write_text(evil)
    (folder / "matplotlibrc").write_text("text.usetex: True\nbackend: module://evil\nfigure.dpi: 1e9\n")
    for name, words in {
        "info": ["info", sound / "map", "--plot", guarded.work / "plot.png"],
        "report": ["report", sound / "results.jsonl", "--out", guarded.work / "report"],
        "evaluate": [
            *("evaluate", sound / "map", sound / "data", "--out", guarded.work / "e.jsonl"),
            *("--protocol", "none", "--trials", "2", "--workers", "2", *AUTO),
        ],
        "serve": ["serve", sound / "map", "--port", "0"],
    }.items():
        process = subprocess.Popen(
            [Path(sys.executable).with_name("bidnerf"), *map(str, words)],
            cwd=folder,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        lines = list[str]()
        assert process.stdout is not None
        for line in process.stdout:
            lines.append(line)
            if "http://" in line:
                process.terminate()
        ended = process.wait()
        sound_end = ended in (0, 143) and "Traceback" not in "".join(lines)
        yield Check(f"current folder: {name}", (*guarded.harm(""), *([] if sound_end else ["".join(lines)[-300:]])))


# Clients.


def clients(guarded: Guarded) -> Checks:
    """Check a service whose clients leave, whose map changes, and which gets bytes that are not quite requests."""
    folder = Path(shutil.copytree(guarded.sound / "map", guarded.work / "served"))
    photo = (guarded.sound / "photo.png").read_bytes()
    with served(folder, guarded.work / "site") as (port, process):
        path = "/localize?hfov=40&seed=1"
        first = json.loads(send(port, "POST", path, photo, "image/png")[1])

        def memory() -> int:
            own = psutil.Process(process.pid)
            return sum(each.memory_info().rss for each in (own, *own.children(True)))

        def healthy(name: str, before: int) -> Check:
            wrong, until = list[str](), time.monotonic() + 4 * SECONDS
            health, _, seconds = send(port, "GET", "/health")
            wrong += [] if health in (200, 503) and seconds < 5 else [f"health {health} after {seconds:.1f} s"]
            status, answer = 0, b""
            while status in (0, 429, 503) and time.monotonic() < until:
                status, answer, _ = send(port, "POST", path, photo, "image/png")
            same = status == 200 and json.loads(answer)["T_world_camera"] == first["T_world_camera"]
            wrong += [] if same else [f"status {status}: {answer[:100]!r}"]
            wrong += ["memory"] if memory() > before + MEMORY else []
            return Check(f"service: {name}", tuple(wrong))

        head = b"POST /localize?hfov=40 HTTP/1.1\r\nHost: localhost\r\n"
        length = b"Content-Length: %d\r\n\r\n" % len(photo)
        whole = head + length + photo

        def leave(number: int) -> None:
            """Send a part of a request, or all of it, and leave after a moment."""
            with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port)) as client:
                client.sendall(whole[: len(head) + 97 * number % (len(whole) - len(head))] if number % 2 else whole)
                time.sleep(0.01 * (number % 20))

        before = memory()
        for number in range(5):
            with ThreadPoolExecutor(20) as pool:
                list(pool.map(leave, range(20 * number, 20 * number + 40)))
            yield healthy(f"40 clients leave, {number}", before)
        raw = {
            "two lengths": head + b"Content-Length: 5\r\n" + length + photo,
            "length and chunks": head + b"Transfer-Encoding: chunked\r\n" + length + b"0\r\n\r\n",
            "negative length": head + b"Content-Length: -1\r\n\r\n",
            "endless chunk": head + b"Transfer-Encoding: chunked\r\n\r\nffffffffffffffff\r\nx",
            "endless head": head + b"X: y\r\n" * 200_000,
            "long line": b"GET /" + b"a" * 1_000_000 + b" HTTP/1.1\r\n\r\n",
            "no host": b"POST /localize HTTP/1.1\r\n" + length + photo,
            "up": b"GET /maps/../../etc/passwd HTTP/1.1\r\nHost: localhost\r\n\r\n",
            "up, escaped": b"GET /maps/..%2f..%2fetc%2fpasswd HTTP/1.1\r\nHost: localhost\r\n\r\n",
            "zero byte": b"GET /maps/%00\0 HTTP/1.1\r\nHost: localhost\r\n\r\n",
            "line break": b"GET /maps/a%0d%0aSet-Cookie:x HTTP/1.1\r\nHost: localhost\r\n\r\n",
            "upgrade": b"GET / HTTP/1.1\r\nHost: localhost\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n\r\n",
            "HTTP/2": b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n" + bytes(9000),
            "method": b"\x1b[2J / HTTP/1.1\r\nHost: localhost\r\n\r\n",
            "other host": head.replace(b"localhost", b"evil.example") + length + photo,
            "TLS": b"\x16\x03\x01\x02\x00\x01" + os.urandom(4096),
            "noise": os.urandom(100_000),
        }
        for name, content in raw.items():
            answer = b""
            with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port), timeout=2) as client:
                client.sendall(content)
                while chunk := client.recv(65536):
                    answer += chunk
            status = re.match(rb"HTTP/1.1 (\d+)", answer)
            ours = [] if status is None or int(status[1]) < 500 else [f"{answer[:60]!r}"]
            ours += ["split the answer"] if b"\r\nSet-Cookie" in answer else []
            checked = healthy(name, before)
            yield Check(checked.name, (*checked.wrong, *ours))
        parts = partial(form, photo=(b"a.png", photo))
        forms = {
            "twice": form(photo=(b"a.png", photo)) + parts(hfov=(None, b"40")),
            "5,000 parts": parts(**{f"a{n}": (None, b"1") for n in range(5000)}),
            "name of a file": form(photo=(b"../../\x1b[2J" + b"x" * 9000, photo), hfov=(None, b"40")),
            "name": parts(name=(None, SCRIPT.encode()), hfov=(None, b"40")),
            "map": parts(map=(None, b"../../etc"), hfov=(None, b"40")),
            "start": parts(start=(None, ROWS.replace("0]", "1e308]", 1).encode()), hfov=(None, b"40")),
            "camera": parts(camera=(None, b"a\n" * 400_000)),
            "entities": parts(camera=(None, b'<!DOCTYPE a [<!ENTITY b "c">]><opencv_storage>&b;</opencv_storage>')),
            "tag": parts(camera=(None, f"---\n!!python/object/apply:os.system ['touch {guarded.owned}']\n".encode())),
            "depth array": parts(depth=(b"d.npy", b"\x93NUMPY\1\0v\0" + b"{'descr':'O','shape':(9,)}".ljust(118))),
            "depth": parts(depth=(b"d.png", b"\x89PNG\r\n\x1a\n" + struct.pack(">I4s", 13, b"IHDR") + b"\xff" * 30)),
        }
        for name, content in forms.items():
            status, answer, _ = send(port, "POST", "/localize", content, "multipart/form-data; boundary=x")
            ours = [] if status < 500 else [f"status {status}: {answer[:100]!r}"]
            checked = healthy(f"form: {name}", before)
            yield Check(checked.name, (*checked.wrong, *ours, *guarded.harm(answer.decode(errors="replace"))))
        for name, change in {
            "another map": lambda: command(
                "train", guarded.sound / "data", "--out", folder, "--overwrite", *tiny.options(2)
            ),
            "damaged": lambda: (folder / "map.json").write_text("[" * 5000),
            "gone": lambda: shutil.rmtree(folder),
        }.items():
            change()
            yield healthy(f"the served map is {name}", before)
    log = (guarded.work / "site/log").read_text(errors="replace")
    odd = {character for character in log if not character.isprintable()} - {"\n"}
    yield Check("service: its log", tuple((["a traceback"] if "Traceback" in log else []) + sorted(odd)))


def form(**fields: tuple[bytes | None, bytes]) -> bytes:
    """Return the body of a form with the boundary x; a field is the name of its file, or None, and its value."""
    rows = []
    for name, (file, value) in fields.items():
        more = b"" if file is None else b'; filename="' + file + b'"'
        rows.append(
            b'--x\r\nContent-Disposition: form-data; name="' + name.encode() + b'"' + more + b"\r\n\r\n" + value
        )
    return b"\r\n".join([*rows, b"--x--\r\n"])
