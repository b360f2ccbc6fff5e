"""Files and requests made to harm: numbers that no camera has, text without end, files that expand, in every place that is read.

Every number of every text file of every layout is replaced in turn; files of other programs' databases, archives, splats and
tensors hold or declare far more than their size; a service gets the same as requests.
"""

from __future__ import annotations

import contextlib
import gzip
import http.client
import json
import os
import random
import re
import shutil
import sqlite3
import struct
import subprocess
import sys
import time
import zipfile
from collections.abc import Callable, Iterator
from functools import partial
from importlib.metadata import entry_points
from pathlib import Path

import numpy as np
import psutil
import torch

from bidnerf import import_map
from bidnerf_core.camera import read_camera
from bidnerf_core.datasets import stored_keypoints
from bidnerf_core.io import Archive, read_array, read_image, read_ply, read_saved, read_tensors_and_metadata
from bidnerf_core.maps import load_map
from bombs import png_of
from damage import zeros_png
from harness import Check, Checks, defects, instead, run, sound_folder
from scan_layouts import LAYOUTS, every_frame, read_all, small_views

SECONDS, MEMORY = 30.0, 2**30
"""Limits of a case: wall time, and address space beyond that of the process and the size of the file."""
NUMBER = re.compile(rb"-?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")
DIGITS = b"9" * 5000
WORDS = (b"nan", b"inf", b"-inf", b"1e308", b"1e-320", b"0", b"-1", b"1e30", b"1.5", DIGITS, b"9223372036854775808")
WORDS += (b"", b"x", b"[[]]", b"null", b"\xff\xfe")
Edit = Callable[[Path], object]


def with_word(place: int, word: bytes, file: Path) -> None:
    """Replace a number of a text file, counted in 64ths of all of them."""
    content = file.read_bytes()
    if found := list(NUMBER.finditer(content)):
        start, end = found[place * (len(found) - 1) // 64].span()
        file.write_bytes(content[:start] + word + content[end:])


def content(change: Callable[[bytes], bytes]) -> Edit:
    return lambda file: file.write_bytes(change(file.read_bytes()))


WHOLE: dict[str, Edit] = {
    "empty": content(lambda old: b""),
    "cut": content(lambda old: old[: len(old) // 2]),
    "zeros": content(lambda old: bytes(len(old))),
    "lines before it": content(lambda old: b"\n" * 200_000 + old),
    "spaces before it": content(lambda old: b" " * 1_000_000 + old),
    "a million times": content(lambda old: old + old[: 1 + len(old) // 20] * (20_000_000 // len(old))),
    "brackets": content(lambda old: b"[" * 2_000_000 + old),
    "tags": content(lambda old: old.replace(b"<chunk", b"<a>" * 300_000 + b"<chunk", 1) + b"<a/>" * 5_000_000),
    "objects": content(lambda old: b"[" + b'{"a":1},' * 3_000_000 + b"1]"),
    "UTF-16": content(lambda old: old.decode("latin-1").encode("utf-16")),
    "document type": content(lambda old: b"<!DOCTYPE a [<!ENTITY b 'c'>]>" + old),
    "no end of line": content(lambda old: old.replace(b"\n", b"") * 1000),
    "pipe": partial(instead, os.mkfifo),
    "folder": partial(instead, Path.mkdir),
    "endless link": partial(instead, lambda file: file.symlink_to("/dev/zero")),
    "of names": content(lambda old: re.sub(rb"[\w/.-]+\.(png|jpg)", b"../" * 900 + b"etc/passwd", old)),
}


def text_files(folder: Path) -> list[Path]:
    """Return one of each kind of text files in a folder; the numbers in their names do not matter."""
    texts = (file for file in sorted(folder.rglob("*")) if file.is_file() and b"\0" not in file.read_bytes()[:4096])
    return list(
        {re.sub(r"\d+", "0", f"{file.relative_to(folder)}"): file.relative_to(folder) for file in texts}.values()
    )


def readers(work: Path, count: int) -> Checks:
    """Check a sample of all attacks on all text files of all layouts."""
    sound, attacks = work / "sound", list[tuple[str, Path, Path, str, Edit]]()
    for kind, layout in LAYOUTS.items():
        root = sound / kind.replace(", ", "-")
        root.mkdir(parents=True)
        folder = layout.write(root, small_views(4))
        if folder.is_file():
            continue
        for file in text_files(root):
            edits = WHOLE | {
                f"number {place}: {word[:20]!r}": partial(with_word, place, word)
                for place in (0, 9, 30, 55, 64)
                for word in WORDS
            }
            attacks += [(kind, folder.relative_to(root), file, name, edit) for name, edit in edits.items()]
    for number, (kind, below, file, name, edit) in enumerate(
        random.Random(0).sample(attacks, min(count, len(attacks)))
    ):
        root = Path(shutil.copytree(sound / kind.replace(", ", "-"), work / f"case{number}", symlinks=True))
        edit(root / file)
        read = every_frame if number % 4 == 0 else read_all
        yield check(f"{kind}: {file}: {name}", partial(read, root / below, **LAYOUTS[kind].options), root / file)
        shutil.rmtree(root)


def check(name: str, door: Callable[[], object], file: Path) -> Check:
    size = file.stat().st_size if file.is_file() and file.resolve().is_file() else 0
    log = file.parent.parent / "attack.log"
    return Check(name, tuple(defects(run(door, log, SECONDS, memory=MEMORY + size))))


# Files that expand.


def database(script: str, file: Path) -> None:
    file.unlink(missing_ok=True)
    with contextlib.closing(sqlite3.connect(file)) as opened:
        opened.executescript(f"BEGIN; {script} COMMIT;")


TABLE = (
    "CREATE TABLE {}(image_id, rows, cols, data); INSERT INTO {} VALUES (1, 1, 4, x'00000000000000000000000000000000');"
)
OTHERS = TABLE.replace("{}", "keypoints") + TABLE.replace("{}", "descriptors")
LOOP = "WITH RECURSIVE c(n) AS (SELECT 1 UNION ALL SELECT n + 1 FROM c)"
DATABASES = {
    "endless view": f"{OTHERS} CREATE VIEW images AS {LOOP} SELECT 1 image_id, 'a' || n name FROM c;",
    "endless view without rows": f"{OTHERS} CREATE VIEW images AS {LOOP} SELECT 1 image_id, 'a' name FROM c WHERE n < 0;",
    "zeroblob": "CREATE TABLE images(image_id, name); INSERT INTO images VALUES (1, 'a');"
    + "".join(
        f"CREATE VIEW {t} AS SELECT 1 image_id, 1 rows, 4 cols, zeroblob(900000000) data;"
        for t in ("keypoints", "descriptors")
    ),
    "generated": f"{OTHERS} CREATE TABLE images(image_id, name AS (hex(zeroblob(400000000)))); INSERT INTO images VALUES (1);",
    "cross join": f"{OTHERS} CREATE TABLE t(a); INSERT INTO t VALUES (1), (2), (3); CREATE VIEW images AS SELECT 1 image_id, 'a' name"
    f" FROM {', '.join(f't t{n}' for n in range(30))};",
    "types": "CREATE TABLE images(image_id, name); INSERT INTO images VALUES (1, 'a'), (x'00', 'a'), (NULL, 1e999);"
    "CREATE TABLE keypoints(image_id, rows, cols, data); INSERT INTO keypoints VALUES (1, 'x', -1, 5);"
    "CREATE TABLE descriptors(image_id, rows, cols, data); INSERT INTO descriptors VALUES (1, 1e300, 128, 'text');",
    "equal numbers": "CREATE TABLE images(image_id, name); CREATE TABLE keypoints(image_id, rows, cols, data);"
    "CREATE TABLE descriptors(image_id, rows, cols, data);"
    + "INSERT INTO images VALUES (1, 'a');" * 2000
    + "INSERT INTO keypoints VALUES (1, 1, 4, x'00000000000000000000000000000000');" * 2000
    + "INSERT INTO descriptors VALUES (1, 1, 4, x'00000000');" * 2000,
}


def features(change: Callable[..., object], file: Path) -> None:
    import h5py

    with h5py.File(file, "w") as opened:
        group = opened.create_group("a")
        group["keypoints"], group["descriptors"] = np.zeros((9, 2), "f4"), np.zeros((128, 9), "f4")
        change(h5py, opened, group)


def replaced(name: str, **options: object) -> Callable[..., object]:
    def change(h5py: object, opened: object, group: dict[str, object]) -> None:
        del group[name]
        group.create_dataset(name, **options)  # type: ignore[attr-defined]

    return change


def nested(h5py: object, opened: object, group: object) -> None:
    for _ in range(3000):
        group = group.create_group("a")  # type: ignore[attr-defined]


FEATURES: dict[str, Callable[..., object]] = {
    "cycle": lambda h5py, opened, group: group.__setitem__("a", group),
    "soft link": lambda h5py, opened, group: group.__setitem__("scales", h5py.SoftLink("/a/scales")),
    "external link": lambda h5py, opened, group: group.__setitem__("scales", h5py.ExternalLink("/dev/zero", "/")),
    "nested": nested,
    "never written": replaced("keypoints", shape=(400_000_000, 2), dtype="f4", chunks=(1000, 2)),
    "never written, in ones": replaced("keypoints", shape=(60_000_000, 2), dtype="f4", chunks=(1, 1)),
    "compressed": replaced("keypoints", shape=(100_000_000, 2), dtype="f4", compression="gzip", fillvalue=1.0),
    "device": replaced("descriptors", shape=(128, 9), dtype="u1", external=[("/dev/zero", 0, 1152)]),
    "text": replaced("keypoints", data=np.array([[b"a", b"b"]] * 9)),
    "rank": replaced("keypoints", data=np.zeros((9, 2, 2))),
    "scalar": replaced("keypoints", data=1.0),
    "no columns": replaced("keypoints", shape=(9, 0), dtype="f4"),
    "compound": replaced("keypoints", data=np.zeros(9, [("a", "f4"), ("b", "f4")])),
    "NaN": replaced("descriptors", data=np.full((128, 9), np.nan)),
}


def zipped(members: dict[str, bytes], file: Path) -> None:
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, member in members.items():
            archive.writestr(name, member)


def itself(file: Path) -> None:
    endless: list[object] = [torch.zeros(2)]
    endless.append(endless)
    torch.save(endless, file)


def nodes(count: int) -> bytes:
    chain = [{"children": [number + 1], "translation": [1, 0, 0]} for number in range(count)]
    text = json.dumps(
        {"asset": {"version": "2.0"}, "extensionsUsed": ["KHR_gaussian_splatting"], "nodes": [*chain, {}]}
    ).encode()
    text += b" " * (-len(text) % 4)
    return struct.pack("<4sIIII", b"glTF", 2, 20 + len(text), len(text), 0x4E4F534A) + text


SOG = {"version": 2, "count": 64_000_000, "means": {"files": ["a", "a"], "mins": [0] * 3, "maxs": [1] * 3}}
FILES: dict[str, tuple[str, Edit, Callable[[Path], object]]] = {
    # The name of a file, what writes it, and what reads it.
    "torch: itself": ("a.pt", itself, lambda file: read_saved(file, "a checkpoint")),
    "splats: torch: itself": ("a.pt", itself, import_map),
    "splats: SOG": (
        "a.sog",
        partial(zipped, {"meta.json": json.dumps(SOG).encode(), "a": zeros_png(7000, 6, 4)}),
        import_map,
    ),
    "splats: SPZ": (
        "a.spz",
        lambda file: file.write_bytes(
            gzip.compress(struct.pack("<4sIIBBBB", b"NGSP", 2, 20_000_000, 0, 12, 0, 0) + bytes(380_000_000))
        ),
        import_map,
    ),
    "splats: nodes": ("a.glb", lambda file: file.write_bytes(nodes(60_000)), import_map),
    "archive": (
        "a.r3d",
        partial(zipped, {"metadata": bytes(900_000_000)}),
        lambda file: Archive(file).read("metadata"),
    ),
    "recording": ("a.r3d", partial(zipped, {"metadata": b"[" * 900_000_000}), read_all),
    "image": ("a.png", lambda file: file.write_bytes(zeros_png(13_000, 0, 1)), lambda file: read_image(file)),
    "header of an image": ("a.png", lambda file: file.write_bytes(png_of(10**6, 10**6)), lambda file: read_image(file)),
    "array": (
        "a.npy",
        lambda file: file.write_bytes(
            b"\x93NUMPY\1\0v\0" + b"{'descr':'<f8','fortran_order':False,'shape':(10**9,17)}".ljust(118)
        ),
        lambda file: read_array(file, "an array"),
    ),
    "tensors": (
        "a.safetensors",
        lambda file: file.write_bytes(struct.pack("<Q", 10**7) + b"[" * 10**7),
        lambda file: read_tensors_and_metadata(file),
    ),
    "PLY": (
        "a.ply",
        lambda file: file.write_bytes(
            b"ply\nformat ascii 1.0\nelement vertex 900000000\nproperty float x\nend_header\n1\n"
        ),
        read_ply,
    ),
    **{
        f"camera: {name}": (
            file,
            partial(lambda text, path: path.write_bytes(text), text),
            lambda path: read_camera(path, (9, 9)),
        )
        for name, file, text in (
            ("digits", "c.json", b'{"fl_x": ' + DIGITS + b', "w": 9, "h": 9}'),
            ("nan", "c.json", b'{"fl_x": NaN}'),
            ("infinite size", "c.json", b'{"fl_x": 5, "w": 1e999, "h": 9}'),
            ("list", "c.json", b"[" + b'{"fx": 1},' * 100_000 + b"{}]"),
            ("deep", "c.yaml", b"%YAML:1.0\n---\na: " + b"[" * 10**5),
            ("aliases", "c.yaml", b"a: &a [1,1]\nb: [*a,*a]\n"),
            ("lines", "c.yaml", b"\n" * 10**6),
            ("rows", "cameras.txt", b"1 PINHOLE " + DIGITS + b" 9 5 5 5 5\n"),
            ("numbers", "cameras.txt", b"1 PINHOLE 9 9 nan inf 1e999 5\n"),
            ("models", "cameras.txt", b"1 " + b"A" * 10**6 + b" 9 9 5 5 5 5\n"),
        )
    },
}


def files(work: Path) -> Checks:
    """Check files that hold or declare far more than their size, and maps with numbers that no training writes."""
    names, kept = ["a"], lambda file: stored_keypoints(file, names)
    cases = dict(FILES)
    cases |= {f"database: {name}": ("a.db", partial(database, script), kept) for name, script in DATABASES.items()}
    with contextlib.suppress(ImportError):
        import h5py  # noqa: F401 (only tried)

        cases |= {f"features: {name}": ("a.h5", partial(features, change), kept) for name, change in FEATURES.items()}
    for name, (file, write, read) in cases.items():
        folder = work / re.sub(r"\W+", "-", name)
        folder.mkdir()
        write(folder / file)
        yield check(name, partial(read, folder / file), folder / file)
        shutil.rmtree(folder)
    sound = sound_folder(work / "sound")
    numbers = list(NUMBER.finditer((sound / "map/map.json").read_bytes()))
    for place in range(0, 65, 64 // min(32, len(numbers))):
        for word in (b"1e308", b"-1", b"1e30"):
            folder = Path(shutil.copytree(sound / "map", work / "map"))
            with_word(place, word, folder / "map.json")
            yield check(f"map.json: number {place}: {word!r}", partial(load_map, folder), folder / "map.json")
            shutil.rmtree(folder)


# Requests.


@contextlib.contextmanager
def served(folder: Path, site: Path) -> Iterator[tuple[int, subprocess.Popen[bytes]]]:
    """Serve a map with the GeoPose Protocol in a process, and yield its port."""
    plugin = Path(__file__).parents[2] / "plugins/bidnerf-geopose"
    info = site / "geopose_attacked-1.0.dist-info"
    site.mkdir()
    if not entry_points(group="bidnerf.services", name="geopose"):  # as if it were installed
        info.mkdir()
        (info / "METADATA").write_text("Metadata-Version: 2.1\nName: geopose-attacked\nVersion: 1.0\n")
        (info / "entry_points.txt").write_text("[bidnerf.services]\ngeopose = bidnerf_geopose.protocol:GEOPOSE\n")
    path = os.pathsep.join([str(site), str(plugin), os.environ.get("PYTHONPATH", "")])
    words = ["serve", str(folder), "--port", "0", "--workers", "1", "--timeout", "20"]
    with (site / "log").open("wb") as log:
        process = subprocess.Popen(
            [sys.executable, "-c", "import sys; from bidnerf.cli import main; sys.exit(main())", *words],
            env={**os.environ, "PYTHONPATH": path},
            stderr=log,
            stdout=log,
        )
        try:
            until, found = time.monotonic() + 120, None
            while found is None and time.monotonic() < until and process.poll() is None:
                found = re.search(rb"http://127\.0\.0\.1:(\d+)", (site / "log").read_bytes())
                time.sleep(0.1)
            if found is None:
                raise SystemExit(f"the service did not start: {(site / 'log').read_text()[-500:]}")
            yield int(found[1]), process
        finally:
            process.terminate()
            process.wait(60)


def send(
    port: int, method: str, path: str, body: bytes | None = None, kind: str = "application/json"
) -> tuple[int, bytes, float]:
    began, connection = time.monotonic(), http.client.HTTPConnection("127.0.0.1", port, timeout=SECONDS)
    try:
        connection.request(method, path, body, {"Content-Type": kind})
        response = connection.getresponse()
        return response.status, response.read(), time.monotonic() - began
    finally:
        connection.close()


def requests(photo: bytes) -> Iterator[tuple[str, str, bytes, str]]:
    """Yield the name, the path, the body and the type of hostile requests."""
    bodies = {
        "1,000,000 sensors": b'{"sensorReadings":{"cameraReadings":[{"imageBytes":"AAAA"}]},"sensors":['
        + b"{}," * 10**6
        + b"{}]}",
        "31 MiB of values": b"[" + b"1," * 16_000_000 + b"1]",
        "unknown keys": b'{"a":' * 9000 + b"1" + b"}" * 9000,
        "brackets": b"[" * 9999,
        "digits": b'{"timestamp": ' + DIGITS + b"}",
        "nan": b'{"timestamp": NaN, "sensorReadings": {"cameraReadings": [{"imageBytes": "AAAA", "size": [NaN, 1e999]}]}}',
        "image bomb": json.dumps(
            {
                "sensorReadings": {
                    "cameraReadings": [{"imageBytes": "A" * 3_000_000, "imageFormat": "RGBA32", "size": [10**6, 10**6]}]
                }
            }
        ).encode(),
        "surrogates": b'{"id": "\\ud800", "sensorReadings": {"cameraReadings": [{"imageBytes": "AAAA"}]}}',
        "long id": json.dumps(
            {"id": "x" * 10**6, "sensorReadings": {"cameraReadings": [{"imageBytes": "AAAA"}]}}
        ).encode(),
        "empty": b"",
        "null": b"null",
        "text": b"\xff\xfe",
        "endless number": b"1" * 10**6,
    }
    for name, body in bodies.items():
        for path in ("/geopose", "/maps/map/geopose", "/localize"):
            yield f"{path}: {name}", path, body, "application/json"
    photos = {
        "header": png_of(10**6, 10**6),
        "megapixels": zeros_png(9000),
        "array": b"\x93NUMPY\1\0v\0" + b"{'descr':'O'}".ljust(118),
        "zeros": bytes(30_000_000),
    }
    for name, body in photos.items():
        yield f"photo: {name}", "/localize?hfov=60", body, "image/png"
    for name, words in {
        "focal": WORDS,
        "hfov": WORDS,
        "depth_unit": WORDS,
        "seed": WORDS,
        "start": (b"[[1e999]]", DIGITS, b"[" * 5000),
        "camera": (b"---", DIGITS, b"{" * 5000),
    }.items():
        for word in words:
            body = b"".join(
                b'--x\r\nContent-Disposition: form-data; name="' + key + b'"' + more + b"\r\n\r\n" + value + b"\r\n"
                for key, more, value in ((b"photo", b'; filename="a.png"', photo), (name.encode(), b"", word))
            )
            yield f"form: {name}: {word[:20]!r}", "/localize", body + b"--x--\r\n", "multipart/form-data; boundary=x"


def routes(work: Path) -> Checks:
    """Check that a service answers hostile requests with an error of the client, at once, and stays healthy and small."""
    sound = sound_folder(work / "sound")
    with served(sound / "map", work / "site") as (port, process):
        send(port, "GET", "/maps")

        def memory() -> int:
            return sum(
                each.memory_info().rss
                for each in [psutil.Process(process.pid), *psutil.Process(process.pid).children(True)]
            )

        before = memory()
        for name, path, body, kind in requests((sound / "photo.png").read_bytes()):
            wrong = []
            try:
                status, answer, seconds = send(port, "POST", path, body, kind)
                if not (400 <= status < 500 or status == 200) or (status != 200 and b'"detail"' not in answer):
                    wrong.append(f"status {status}: {answer[:100]!r}")
                health = send(port, "GET", "/health")
                if seconds > SECONDS or health[0] != 200 or health[2] > 2:
                    wrong.append(f"{seconds:.0f} s; health {health[0]} after {health[2]:.1f} s")
                if memory() > before + MEMORY + len(body):
                    wrong.append("memory")
            except (OSError, http.client.HTTPException) as error:
                wrong.append(repr(error))
            yield Check(name, tuple(wrong))
    log = (work / "site/log").read_text(errors="replace")
    yield Check("the log of the service", ("a traceback",) if "Traceback" in log else ())
