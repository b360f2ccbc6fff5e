"""Give 10,000 malformed files, options and arguments to all commands and to the Python interface, and judge the results.

    python benchmarks/fuzz.py [--count 10000] [--minutes 10] [--seed 0] [--name fuzz] [--only NUMBER...]

Every case is drawn from its own seed, and runs in this process on a fresh copy of a folder of sound files, with a limit of
10 s and 2 GB. It must end in a result, in one line on stderr with exit status 1, in wrong usage with exit status 2, or, in
Python, in an ``InputError``. A traceback, exceeding the limits of time or memory, a character that controls the terminal, and
a half-written file are defects; they are listed with the numbers of their cases, and ``--only`` repeats these.
"""

from __future__ import annotations

import argparse
import contextlib
import gc
import io
import json
import os
import resource
import shutil
import signal
import stat
import sys
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from random import Random
from tempfile import TemporaryDirectory
from typing import Any

import torch
from fuzz_cases import Case, draw_case, files_of, sound_folder
from safetensors import safe_open

from bidnerf_core.cli import main as bidnerf
from bidnerf_core.errors import InputError
from bidnerf_core.evaluation.provenance import write_record
from bidnerf_core.evaluation.trials import (
    STATUS,
    forget_peak_memory,
    opened,
    opened_points,
    peak_memory_bytes,
)
from bidnerf_core.io.files import is_temporary

RESULTS = Path(__file__).parent / "results"
LONGEST, MOST_MEMORY = 10.0, 2 * 2**30
"""CPU seconds, and bytes beyond those of the process before the case."""
MOST_WAITING = 30.0
"""Seconds of wall time: on a busy machine a case may get only a third of it as CPU time."""
NOBODY = 65534


class TooLong(BaseException):
    """The case exceeded the time limit. As a ``BaseException``, no handler of the library catches it."""


@dataclass(frozen=True)
class Outcome:
    """The outcome of a case."""

    ending: str  # "done", "refused", "wrong usage", "interrupted", or the type of an exception
    seconds: float
    bytes: int  # peak memory beyond that before the case
    defects: tuple[str, ...]


def run_case(case: Case, folder: Path) -> Outcome:
    before = {path.relative_to(folder) for path in files_of(folder)}
    out, err = io.StringIO(), io.StringIO()
    forget_peak_memory()
    base, began = peak_memory_bytes(), time.monotonic()
    defects: list[str] = []
    ending = "done"
    try:
        with (
            limited(),
            contextlib.redirect_stdout(out),
            contextlib.redirect_stderr(err),
            as_user(case, folder),
        ):
            ending = through(case)
    except InputError as error:
        ending = "refused"
        if "\n" in str(error):
            defects.append(f"message of several lines: {str(error)[:200]!r}")
    except TooLong:
        defects.append(f"hung over {LONGEST:g} s")
    except BaseException as error:
        last = traceback.extract_tb(error.__traceback__)[-1]
        defects.append(
            f"{type(error).__name__} in {Path(last.filename).name}:{last.lineno}: {str(error)[:120]!r}"
        )
        ending = type(error).__name__
    seconds, used = time.monotonic() - began, peak_memory_bytes() - base
    if used > MOST_MEMORY:
        defects.append(f"{used / 2**30:.1f} GB")
    if isinstance(case.door, list):
        defects += defects_of_text(ending, out.getvalue(), err.getvalue())
        defects += defects_of_files(folder, before)
    for cache in (opened, opened_points):
        cache.cache_clear()
    return Outcome(ending, seconds, used, tuple(defect.replace(str(folder), "{}") for defect in defects))


def through(case: Case) -> str:
    """Run a case through its entry point; return how a command ended."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        if not isinstance(case.door, list):
            case.door(Path.cwd())
            return "done"
        status = bidnerf(case.door)
    return {0: "done", 1: "refused", 2: "wrong usage", 130: "interrupted"}.get(status, f"status {status}")


@contextlib.contextmanager
def limited() -> Iterator[None]:
    """Limit the code in the context to ``LONGEST`` seconds and ``MOST_MEMORY``."""
    began, cpu = time.monotonic(), time.process_time()

    def stop(number: int, frame: Any) -> None:
        waited = time.monotonic() - began
        if time.process_time() - cpu > LONGEST or waited > MOST_WAITING:
            raise TooLong

    line = next(line for line in STATUS.read_text().splitlines() if line.startswith("VmSize:"))
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    previous = signal.signal(signal.SIGALRM, stop)
    resource.setrlimit(resource.RLIMIT_AS, (int(line.split()[1]) * 1024 + MOST_MEMORY, hard))
    signal.setitimer(signal.ITIMER_REAL, LONGEST, LONGEST / 2)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))
        signal.signal(signal.SIGALRM, previous)


@contextlib.contextmanager
def as_user(case: Case, folder: Path) -> Iterator[None]:
    """Work in the folder, as a user without privileges if permissions are tested."""
    here = Path.cwd()
    os.chdir(folder)
    root = case.as_user and os.geteuid() == 0
    if root:
        for path in (folder, *folder.rglob("*")):
            os.chown(path, NOBODY, NOBODY, follow_symlinks=False)
        os.seteuid(NOBODY)
    try:
        yield
    finally:
        if root:
            os.seteuid(0)
        os.chdir(here)


def defects_of_text(ending: str, out: str, err: str) -> Iterator[str]:
    odd = {c for c in out + err if c != "\n" and not c.isprintable()}
    if odd:
        yield f"control characters {sorted(odd)!r}"
    if "Traceback" in out + err:
        yield "a traceback"
    last = err.splitlines()[-1:]
    if ending == "refused" and not (last and last[0].startswith("bidnerf ") and err.endswith("\n")):
        yield f"not one line of refusal: {err[-300:]!r}"
    if ending not in ("done", "refused", "wrong usage", "interrupted"):
        yield f"ended with {ending}"


def defects_of_files(folder: Path, before: set[Path]) -> Iterator[str]:
    """Yield the files that a command left half-written."""
    for path in files_of(folder):
        name = path.relative_to(folder)
        if is_temporary(path.name):
            yield f"left {name}"
        elif name not in before and not whole(path):
            yield f"half-written {name}"


def whole(path: Path) -> bool:
    """Return whether a new file can be read."""
    checks: dict[str, Callable[[Path], object]] = {
        ".json": lambda p: json.loads(p.read_bytes()),
        ".jsonl": lambda p: [json.loads(line) for line in p.read_bytes().splitlines()],
        ".safetensors": lambda p: safe_open(p, "pt").keys(),
    }
    try:
        checks.get(path.suffix, lambda p: None)(path)
    except Exception:
        return False
    return True


def remove(folder: Path) -> None:
    for path in folder.rglob("*"):
        if not path.is_symlink() and not stat.S_IMODE(path.stat().st_mode) & stat.S_IWUSR:
            path.chmod(0o755)
    shutil.rmtree(folder, ignore_errors=True)


def run_all(
    sound: Path, work: Path, numbers: Iterator[int], seed: int, until: float, verbose: bool
) -> list[tuple[int, Case, Outcome]]:
    found = []
    for number in numbers:
        if time.monotonic() > until:
            break
        folder = work / f"case{number}"
        case = draw_case(Random(f"{seed}/{number}"), sound, folder)
        outcome = run_case(case, folder)
        found.append((number, case, outcome))
        for defect in outcome.defects:
            print(f"{number}: {case.kind} | {case.words!r} | {defect}", flush=True)
        if verbose:
            print(number, case.kind, repr(case.words), outcome, flush=True)
        remove(folder)
        if number % 50 == 49:
            gc.collect()
        if number % 500 == 499:
            print(f"{number + 1} cases", file=sys.stderr, flush=True)
    return found


def summary(found: list[tuple[int, Case, Outcome]]) -> dict[str, Any]:
    longest = max(found, key=lambda one: one[2].seconds)
    largest = max(found, key=lambda one: one[2].bytes)
    return {
        "cases": len(found),
        "endings": dict(Counter(outcome.ending for _, _, outcome in found).most_common()),
        "by door": dict(Counter(door_name(case) for _, case, _ in found).most_common()),
        "by kind": dict(sorted(Counter(case.kind for _, case, _ in found).items())),
        "defects": [f"{number}: {case.kind}: {defect}" for number, case, o in found for defect in o.defects],
        "worst seconds": {
            "case": longest[0],
            "kind": longest[1].kind,
            "seconds": round(longest[2].seconds, 2),
        },
        "worst memory": {"case": largest[0], "kind": largest[1].kind, "MiB": round(largest[2].bytes / 2**20)},
    }


def door_name(case: Case) -> str:
    return (
        case.door[0]
        if isinstance(case.door, list) and case.door
        else "no command"
        if isinstance(case.door, list)
        else "Python"
    )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--count", type=int, default=10_000)
    parser.add_argument("--minutes", type=float, default=10.0, help="no case begins after this time")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--name", default="fuzz")
    parser.add_argument("--only", type=int, nargs="*", help="run these cases and record nothing")
    given = parser.parse_args()
    torch.set_num_threads(1)
    with TemporaryDirectory() as folder:
        os.chmod(folder, 0o755)
        sound, work = Path(folder) / "sound", Path(folder) / "work"
        sound.mkdir()
        work.mkdir(mode=0o755)
        sound_folder(sound)
        until = time.monotonic() + 60 * given.minutes
        found = run_all(
            sound, work, iter(given.only or range(given.count)), given.seed, until, bool(given.only)
        )
    results = summary(found)
    if given.only is None:
        print(write_record(RESULTS / f"{given.name}.json", results, given.seed))
    print(json.dumps({k: v for k, v in results.items() if k != "by kind"}, indent=1))


if __name__ == "__main__":
    main()
