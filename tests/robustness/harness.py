"""Sound files, hostile cases in a forked child with limits, and the judgement of how a case ended and what it left.

A case is a command line or a function. It must end in a result, in one line on stderr with status 1, in wrong usage with
status 2, or, in Python, in an ``InputError``. A traceback, a crash, exceeding the limits of time or memory, a character that
controls the terminal, and a half-written file are defects. Only the public interface is used, so that the cases also run
against other versions.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import resource
import shlex
import signal
import struct
import sys
import time
import traceback
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import imageio.v3 as iio
import numpy as np
import torch
from safetensors import safe_open

from bidnerf import SE3, Frame, InputError, Intrinsics, Localizer, Tracker, load_map

# Inside: the modules of the commands are imported before a process is forked for each case
from bidnerf.cli import evaluate, localize, main, maps, track, train  # noqa: F401  (before a fork)
from bidnerf.scenes import demo_object, orbit
from bidnerf.scenes import views as seen_from
from bidnerf_core.datasets import open_dataset, write_transforms
from bidnerf_core.localization import settings_of

CAMERA = Intrinsics(32.0, 32.0, 12.0, 12.0, 24, 24)
SMALL_FIELD = shlex.split(
    "--levels 3 --log2-table-size 9 --base-resolution 4 --finest-resolution 16 --width 16 --geometry-features 3"
    " --grid-resolution 16 --coarse-levels 1 --samples-per-step 2048 --rays-at-most 256 --prune-from 4 --prune-every 4"
)
QUICK = shlex.split("--method bid --max-steps 2 --rays 32")
AUTO = shlex.split("--points 100 --hypotheses 8 --rounds 1 --refine-rays 64")
AUTO_SETTINGS: dict[str, Any] = {"points": 100, "hypotheses": 8, "rounds": 1, "refine_rays": 64}
BAKED = ["--cells", "2000"]
SECONDS, MEMORY = 25.0, 2 * 2**30
"""Limits of a case: wall time, and address space beyond that of the process before it."""
NOBODY = 65534
TEMPORARY = re.compile(r"\..+\.[0-9a-f]{8}")

Words: TypeAlias = Sequence[object]
Door: TypeAlias = Words | Callable[[], object]
"""A command or a function."""


# Sound files.


def command(*words: object) -> None:
    """Run a command that must succeed, in this process."""
    with open(os.devnull, "w") as null, contextlib.redirect_stdout(null), contextlib.redirect_stderr(null):
        status = main([str(word) for word in words])
    if status != 0:
        raise SystemExit(f"the sound command failed: {' '.join(map(str, words))}")


def sound_folder(folder: Path, test: int = 2) -> Path:
    """Write a dataset, a map of it with surface and landmarks, photos with depth, and every other kind of input."""
    torch.set_num_threads(1)
    scene = demo_object()
    seen, unseen = (seen_from(scene, CAMERA, orbit(3.5, count, seed=seed)) for seed, count in ((0, 6), (1, test)))
    write_transforms(folder / "data", {"train": seen, "test": unseen}, scene.bounds.background)
    command("train", folder / "data", "--out", folder / "map", *SMALL_FIELD, "--steps", "6", "--no-bake")
    command("bake", folder / "map", "--data", folder / "data", *BAKED)
    pose, frame = unseen[0].T_ref_camera.matrix().tolist(), unseen[0].frame
    (folder / "pose.json").write_text(json.dumps({"T_world_camera": pose}))
    camera = {"fl_x": 32, "fl_y": 32, "cx": 12, "cy": 12, "w": 24, "h": 24, "k1": 0.01}
    (folder / "camera.json").write_text(json.dumps(camera))
    (folder / "cameras.txt").write_text("# camera\n1 OPENCV 24 24 32 32 12 12 0.01 0 0 0\n")
    (folder / "points.txt").write_text("0.1 0.1 3\n-0.1 0.1 3\n0.1 -0.1 3.1\n")
    np.save(folder / "points.npy", np.array([[0.1, 0.1, 3.0], [-0.1, 0.1, 3.0]]))
    np.savez(folder / "points.npz", points=np.array([[0.1, 0.1, 3.0]]), T_camera_sensor=np.eye(4))
    assert frame.depth is not None
    iio.imwrite(folder / "photo.png", (frame.rgb * 255).byte().numpy())
    iio.imwrite(folder / "photo.depth.png", (frame.depth * 1000).numpy().astype(np.uint16))
    np.save(folder / "photo.depth.npy", frame.depth.numpy())
    write_colmap(folder / "colmap", [view.T_ref_camera for view in seen], [v.frame.rgb for v in seen])
    words = ("--protocol", "none", "--trials", "1", "--workers", "1", *AUTO)
    command("evaluate", folder / "map", folder / "data", "--out", folder / "results.jsonl", *words)
    os.chmod(folder, 0o755)
    return folder


def write_colmap(project: Path, poses: Sequence[SE3], images: Sequence[torch.Tensor]) -> None:
    """Write a COLMAP project with a binary model of one camera, whose images observe 20 points."""
    (project / "images").mkdir(parents=True)
    sparse = project / "sparse" / "0"
    sparse.mkdir(parents=True)
    camera = struct.pack("<QIiQQ4d", 1, 1, 1, 24, 24, 32.0, 32.0, 12.0, 12.0)
    records = b""
    for number, (T_world_camera, rgb) in enumerate(zip(poses, images, strict=True), start=1):
        iio.imwrite(project / "images" / f"{number}.png", (rgb * 255).byte().numpy())
        T = T_world_camera.inverse()
        w = float(max(1e-6, 0.5 * (1 + torch.trace(T.rotation)) ** 0.5))
        axis = torch.stack([T.rotation[k, j] - T.rotation[j, k] for j, k in ((1, 2), (2, 0), (0, 1))])
        pose = [w, *(axis / (4 * w)).tolist(), *T.translation.tolist()]
        seen = b"".join(struct.pack("<2dq", 12.0, 12.0, point) for point in range(1, 21))
        records += struct.pack("<I7dI", number, *pose, 1) + f"{number}.png\0".encode()
        records += struct.pack("<Q", 20) + seen
    sightings = b"".join(struct.pack("<II", number, 0) for number in range(1, len(poses) + 1))
    points = b"".join(
        struct.pack("<q3d3BdQ", number, 0.02 * number, 0.0, 0.0, 1, 2, 3, 0.5, len(poses)) + sightings
        for number in range(1, 21)
    )
    (sparse / "cameras.bin").write_bytes(camera)
    (sparse / "images.bin").write_bytes(struct.pack("<Q", len(poses)) + records)
    (sparse / "points3D.bin").write_bytes(struct.pack("<Q", 20) + points)


def photo(folder: Path) -> Frame:
    return Frame.open(folder / "photo.png", hfov=40.0)


def localized(folder: Path, frame: Frame | None = None, **options: Any) -> object:
    localizer = Localizer(load_map(folder / "map"), "auto", settings_of("auto", AUTO_SETTINGS))
    return localizer(photo(folder) if frame is None else frame, **options)


def tracker(folder: Path, start: Any = None) -> Tracker:
    localizer = Localizer(load_map(folder / "map"), "auto", settings_of("auto", AUTO_SETTINGS))
    return Tracker(localizer, start=start)


def views_of(folder: Path) -> object:
    dataset = open_dataset(folder)
    return [dataset.views(split) for split in dataset.splits]


# Cases in a child.


@dataclass(frozen=True)
class Outcome:
    """How a case ended, and what it said."""

    ending: str  # "done", "refused", "wrong usage", "interrupted", "traceback", "hang", or "signal N"
    out: str
    err: str
    seconds: float
    status: int

    @property
    def last(self) -> str:
        """The last line on stderr."""
        return (self.err.strip().splitlines() or [""])[-1]


ENDINGS = {0: "done", 1: "refused", 2: "wrong usage", 130: "interrupted", 141: "reader gone"}
TRACEBACK = 70


def begin(
    door: Door,
    log: Path,
    memory: int = MEMORY,
    before: Callable[[], object] = lambda: None,
    out: Path | int | None = None,
    nobody: bool = False,
) -> int:
    """Run a case in a child of its own group, whose process id is returned; what it prints goes to ``log``.out and .err,
    or to the file or descriptor ``out``.
    """
    for suffix in (".out", ".err"):
        log.with_suffix(suffix).unlink(missing_ok=True)  # what an earlier case said
    child = os.fork()
    if child:
        return child
    try:
        os.setsid()
        for number, handler in ((2, signal.default_int_handler), (15, signal.SIG_DFL), (1, signal.SIG_DFL)):
            signal.signal(number, handler)
        for file, place in (
            (1, log.with_suffix(".out") if out is None else out),
            (2, log.with_suffix(".err")),
        ):
            flags = os.O_WRONLY | os.O_CREAT | os.O_TRUNC
            os.dup2(place if isinstance(place, int) else os.open(place, flags, 0o644), file)
        for name, file, errors in (("stdout", 1, "strict"), ("stderr", 2, "backslashreplace")):
            setattr(sys, name, open(file, "w", 1, errors=errors, closefd=False))  # noqa: SIM115
        status = Path("/proc/self/status").read_text().splitlines()
        size = next(int(line.split()[1]) for line in status if line.startswith("VmSize:"))
        resource.setrlimit(resource.RLIMIT_AS, (1024 * size + memory,) * 2)
        if nobody and os.geteuid() == 0:
            os.setgroups([])
            os.setresgid(NOBODY, NOBODY, NOBODY)
            os.setresuid(NOBODY, NOBODY, NOBODY)
        before()
        os._exit(_through(door))
    except BaseException:
        os.write(2, traceback.format_exc().encode(errors="replace"))
        os._exit(TRACEBACK)


def _through(door: Door) -> int:
    status = 0
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            if isinstance(door, Sequence):
                status = main([str(word) for word in door])
            else:
                door()
    except InputError as error:
        print("bidnerf Python:", error, file=sys.stderr)
        status = 1
    except BaseException:
        print(traceback.format_exc(), file=sys.stderr)
        status = TRACEBACK
    with contextlib.suppress(OSError):
        sys.stdout.flush()
        sys.stderr.flush()
    return status


def end(child: int, log: Path, seconds: float = SECONDS) -> Outcome:
    """Wait for a child, and kill its group when its time is over."""
    began = time.monotonic()
    while True:
        found, status = os.waitpid(child, os.WNOHANG)
        late = time.monotonic() - began > seconds
        if found or late:
            break
        time.sleep(0.005)
    with contextlib.suppress(ProcessLookupError):
        os.killpg(child, signal.SIGKILL)  # also what it has begun
    if not found:
        os.waitpid(child, 0)
    code = os.waitstatus_to_exitcode(status) if found else 0
    ending = "hang" if not found else f"signal {-code}" if code < 0 else ENDINGS.get(code, "traceback")
    out, err = (
        path.read_text(errors="surrogateescape") if path.is_file() else ""
        for path in (log.with_suffix(".out"), log.with_suffix(".err"))
    )
    return Outcome(ending, out, err, time.monotonic() - began, code)


def run(door: Door, log: Path, seconds: float = SECONDS, **options: Any) -> Outcome:
    """Run a case to its end; see ``begin`` and ``end``."""
    return end(begin(door, log, **options), log, seconds)


def defects(found: Outcome, folder: Path | None = None, before: frozenset[Path] = frozenset()) -> list[str]:
    """Return what is wrong with the end of a case, in what it said and in the new files of ``folder``."""
    wrong = []
    if found.ending not in ("done", "refused", "wrong usage", "interrupted"):
        wrong.append(found.ending if found.ending != "traceback" else f"traceback: {found.last[:160]}")
    elif "Traceback" in found.out + found.err:
        wrong.append("a traceback")
    odd = {c for c in found.out + found.err if c not in "\n\udcff" and not c.isprintable()}
    if odd and found.ending != "traceback":
        wrong.append(f"control characters {sorted(odd)!r}")
    if found.ending == "refused" and not (found.last.startswith("bidnerf ") and found.err.endswith("\n")):
        wrong.append(f"not one line of refusal: {found.err[-300:]!r}")
    return wrong + ([] if folder is None else half_written(folder, before))


def files_of(folder: Path) -> frozenset[Path]:
    return frozenset(path for path in folder.rglob("*") if path.is_file() and not path.is_symlink())


def half_written(folder: Path, before: frozenset[Path]) -> list[str]:
    """Return the files that were left half-written, apart from those in ``before``."""
    return [
        f"{'left' if TEMPORARY.fullmatch(path.name) else 'half-written'} {path.relative_to(folder)}"
        for path in files_of(folder)
        if TEMPORARY.fullmatch(path.name) or (path not in before and not whole(path))
    ]


def whole(path: Path) -> bool:
    """Return whether a new file can be read."""
    checks: dict[str, Callable[[Path], object]] = {
        ".json": lambda p: json.loads(p.read_bytes()),
        ".jsonl": lambda p: [json.loads(line) for line in p.read_bytes().splitlines()],
        ".safetensors": lambda p: safe_open(p, "pt").keys(),
        ".png": iio.imread,
    }
    try:
        checks.get(path.suffix, lambda p: None)(path)
    except Exception:
        return False
    return True


@dataclass(frozen=True)
class Check:
    """One case of a table of counts: what it was, and what was wrong with it (nothing, if it passed)."""

    name: str
    wrong: tuple[str, ...] = ()


Checks: TypeAlias = Iterator[Check]
