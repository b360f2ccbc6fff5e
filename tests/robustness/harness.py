"""Sound files, hostile cases in a forked child with limits, and the judgement of how a case ended and what it left.

A case is a command line or a function. It must end in a result, in one line on stderr with status 1, in wrong usage with
status 2, or, in Python, in an ``InputError``. A traceback, a crash, exceeding the limits of time or memory, a character that
controls the terminal, and a half-written file are defects.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import resource
import shlex
import signal
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
import psutil
import torch
from safetensors import safe_open

import sparse_model
import tiny
from bidnerf import Frame, InputError, Localization, Localizer, Tracker, load_map

# Inside: the modules of the commands are imported before a process is forked for each case
from bidnerf.cli import evaluate, localize, main, maps, track, train  # noqa: F401  (before a fork)
from bidnerf_core.datasets import write_transforms
from bidnerf_core.localization import settings_of
from scan_layouts import metres, millimetres, pixels, write_image

QUICK = shlex.split("--method bid --max-steps 2 --rays 32")
AUTO_SETTINGS: dict[str, Any] = {"points": 100, "hypotheses": 8, "rounds": 1, "refine_rays": 64}
AUTO = [word for name, value in AUTO_SETTINGS.items() for word in (f"--{name.replace('_', '-')}", str(value))]
BAKED = ["--cells", "2000"]
SECONDS, MEMORY = 25.0, 2 * 2**30
"""Limits of a case: time, and address space beyond that of the process before it.

The time is that of its processor, on which other processes do not count; one that waits for something may take four times as long.
"""
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
    seen, unseen = tiny.views(6), tiny.views(test, seed=1)
    write_transforms(folder / "data", {"train": seen, "test": unseen}, tiny.BACKGROUND)
    command("train", folder / "data", "--out", folder / "map", *tiny.options(6))
    command("bake", folder / "map", "--data", folder / "data", *BAKED)
    camera = {"fl_x": 32, "fl_y": 32, "cx": 12, "cy": 12, "w": 24, "h": 24, "k1": 0.01}
    texts = {
        "pose.json": json.dumps({"T_world_camera": unseen[0].T_ref_camera.matrix().tolist()}),
        "camera.json": json.dumps(camera),
        "cameras.txt": "# camera\n1 OPENCV 24 24 32 32 12 12 0.01 0 0 0\n",
        "points.txt": "0.1 0.1 3\n-0.1 0.1 3\n0.1 -0.1 3.1\n",
    }
    for name, text in texts.items():
        (folder / name).write_text(text)
    np.save(folder / "points.npy", np.array([[0.1, 0.1, 3.0], [-0.1, 0.1, 3.0]]))
    np.savez(folder / "points.npz", points=np.array([[0.1, 0.1, 3.0]]), T_camera_sensor=np.eye(4))
    iio.imwrite(folder / "photo.png", pixels(unseen[0]))
    iio.imwrite(folder / "photo.depth.png", millimetres(unseen[0]))
    np.save(folder / "photo.depth.npy", metres(unseen[0]))
    names = [f"{number}.png" for number in range(1, 7)]
    known = sparse_model.known(seen, names)
    sparse_model.write(folder / "text", known)
    sparse_model.to_binary(sparse_model.write(folder / "colmap/sparse/0", known))
    for name, view in zip(names, seen, strict=True):
        write_image(folder / "colmap/images" / name, pixels(view))
    words = ("--protocol", "none", "--trials", "1", "--workers", "1", *AUTO)
    command("evaluate", folder / "map", folder / "data", "--out", folder / "results.jsonl", *words)
    tracker = Tracker(localizer(folder), start=unseen[0].T_ref_camera)  # with a start, it has a motion to store
    for view in unseen:
        tracker(view.frame)
    tracker.save(folder / "state")
    folder.parent.chmod(0o755)  # so that a user without privileges sees it
    return folder


def photo(folder: Path) -> Frame:
    return Frame.open(folder / "photo.png", hfov=40.0)


def localizer(folder: Path) -> Localizer:
    return Localizer(load_map(folder / "map"), "auto", settings_of("auto", AUTO_SETTINGS))


def localize_photo(folder: Path, frame: Frame | None = None, **options: Any) -> Localization:
    return localizer(folder)(photo(folder) if frame is None else frame, **options)


def instead(make: Callable[[Path], object], file: Path) -> None:
    """Put something else in the place of a file."""
    file.unlink()
    make(file)


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
        waited = time.monotonic() - began
        late = waited > seconds and (waited > 4 * seconds or cpu_seconds(child) > seconds)
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


def cpu_seconds(child: int) -> float:
    """Return the processor time of a process and of those that it began."""
    total = 0.0
    with contextlib.suppress(psutil.Error):
        for process in (own := psutil.Process(child), *own.children(recursive=True)):
            total += sum(process.cpu_times())
    return total


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
