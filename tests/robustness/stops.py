"""Kills, signals at random moments, full disks, folders that cannot be written, and processes that meet each other.

Each command runs in a child that is forked from this process, so that a stop costs no imports. After every kill the same
command goes on, and what it leaves must be whole; its last result must equal that of an undisturbed run but for times. A
signal may not lose an answer that was printed before it. A write fails as on a full disk by a failing ``fsync``, the first,
the second and so on until the command comes to its end.
"""

from __future__ import annotations

import errno
import gc
import itertools
import json
import os
import random
import shutil
import signal
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch

import tiny
from bidnerf import Localizer, load_map
from bidnerf_core.localization import settings_of
from harness import (
    BAKED,
    QUICK,
    TEMPORARY,
    Check,
    Checks,
    Outcome,
    begin,
    defects,
    end,
    files_of,
    half_written,
    localize_photo,
    photo,
    run,
    sound_folder,
)

VARIES = ("seconds", "cpu_seconds", "peak_memory_bytes")
STEPS, TRIALS, FRAMES = 12, "8", 24
OTHER_RESULT = "the result is another than the undisturbed one"
SIGNALS = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP, signal.SIGKILL)


@dataclass(frozen=True)
class Job:
    """A command that is stopped. Its folder is what each run has of its own."""

    words: Callable[[Path], list[object]]  # depends on what is there already
    kept: Callable[[Path], int]  # how much is there; raises where it is not whole
    result: Callable[[Path], object]  # of a run that came to its end
    resumes: bool = True


def jobs(sound: Path) -> dict[str, Job]:
    data = sound / "data"

    def training(folder: Path) -> list[object]:
        out = folder / "map"
        more = ["--resume", "--no-bake"] if (out / "map.json").exists() else tiny.options(STEPS)
        return ["train", data, "--out", out, "--checkpoint-every", "0", *more]

    def baking(folder: Path) -> list[object]:
        if not (folder / "map").exists():
            copy_map(sound / "map", folder / "map")
        return ["bake", folder / "map", "--data", data, *BAKED]

    def trials(folder: Path) -> list[object]:
        more = ["--size", "0.3", "--trials", TRIALS, "--workers", "1", "--seed", "0", *QUICK]
        return ["evaluate", sound / "map", data, "--out", folder / "r.jsonl", *more]

    def answers(command: str, *more: object) -> Job:
        return Job(
            lambda folder: [command, sound / "map", data, "--out", folder / "poses.json", *more],
            lambda folder: len(rows(folder / "poses.json")),
            lambda folder: rows(folder / "poses.json"),
            resumes=False,
        )

    return {
        "train": Job(training, step_of, lambda folder: parts(folder, ("weights",))),
        "bake": Job(baking, step_of, lambda folder: parts(folder, ("surface", "landmarks"))),
        "evaluate": Job(trials, lambda folder: len(rows(folder / "r.jsonl")), lambda folder: rows(folder / "r.jsonl")),
        "report": Job(
            lambda folder: ["report", sound / "results.jsonl", "--out", folder / "report"],
            pages,
            lambda folder: {
                file.name: file.read_bytes()
                for file in (folder / "report").iterdir()
                if not TEMPORARY.fullmatch(file.name)
            },
        ),
        "localize": answers(
            "localize", "--json", "--perturb", "0.1", "5", "--method", "bid", "--max-steps", "12", "--rays", "64"
        ),
        "track": answers("track"),
    }


class Broken(Exception):
    """What a stop left is not whole."""


def copy_map(source: Path, to: Path) -> None:
    """Copy a map without its baked parts."""
    to.mkdir(parents=True)
    plain = json.loads((source / "map.json").read_text())
    shutil.copy(source / plain["weights"], to)
    (to / "map.json").write_text(json.dumps(plain | {"surface": None, "landmarks": None, "capture": None}))


def step_of(folder: Path) -> int:
    """Return the step of the map, or 0 where there is none yet."""
    return load_map(folder / "map").info.step if (folder / "map" / "map.json").exists() else 0


def parts(folder: Path, names: Sequence[str]) -> object:
    """Return the bytes of the map's files."""
    plain = json.loads((folder / "map" / "map.json").read_text())
    return [(folder / "map" / plain[part]).read_bytes() for part in names]


def wrong_result(job: Job, folder: Path, expected: object, finished: bool = True) -> list[str]:
    """Return what is wrong with a result; where the last process ``finished``, a map's folder has no files that it does not name."""
    wrong, description = [] if job.result(folder) == expected else [OTHER_RESULT], folder / "map" / "map.json"
    if finished and description.exists():
        named = {description.name, *(v for v in json.loads(description.read_text()).values() if isinstance(v, str))}
        wrong += [f"not named: {file.name}" for file in description.parent.iterdir() if file.name not in named]
    return wrong


def rows(path: Path) -> list[dict[str, Any]]:
    """Return the rows of a list in JSON, or of whole lines of JSON, without what varies from run to run."""
    text = path.read_text() if path.exists() else ""
    found = map(json.loads, text.split("\n")[:-1]) if path.suffix == ".jsonl" else json.loads(text or "[]")
    return [{name: value for name, value in row.items() if name not in VARIES} for row in found]


def pages(folder: Path) -> int:
    page = folder / "report" / "index.html"
    text = page.read_text() if page.exists() else "Unfinished report"
    if "Unfinished report" not in text and not text.rstrip().endswith("</html>"):
        raise Broken("half of a page")
    return int("Unfinished report" not in text)


def run_undisturbed(job: Job, folder: Path) -> float:
    """Run a command to its end and return the seconds that it took."""
    folder.mkdir(parents=True, exist_ok=True)
    found = run(job.words(folder), folder.with_suffix(".log"), 300)
    if found.ending != "done":
        raise Broken(f"an undisturbed {job.words(folder)[0]}: {found}")
    return found.seconds


# Kills, and resuming after them.


def kill(job: Job, work: Path, expected: object, seconds: float, kills: int, chance: random.Random) -> Checks:
    """Kill a command at random moments and resume it; a run that comes to its end is compared and begun anew."""
    rounds, before, folder = 0, 0, work / "0"
    folder.mkdir(parents=True)
    for number in range(kills):
        found = stop(job, folder, signal.SIGKILL, chance.uniform(0, 1.1 * seconds))
        wrong = damage_of(job, folder, before)
        before = 0 if wrong else job.kept(folder)
        # Resuming is refused after a kill between the last write and the end of the process, in which earlier files are removed;
        # the next save removes them then.
        if found.ending == "done" or "nothing to resume" in found.last:
            wrong += wrong_result(job, folder, expected, found.ending == "done")
            rounds, before = rounds + 1, 0
            folder = work / str(rounds)
            folder.mkdir()
        elif found.status != -signal.SIGKILL:
            wrong.append(f"{found.ending}: {found.last}")
        yield Check(f"kill {number}", tuple(wrong))


def stop(job: Job, folder: Path, number: int, moment: float) -> Outcome:
    log = folder.with_suffix(".log")
    child = begin(job.words(folder), log)
    time.sleep(moment)
    os.kill(child, number)
    return end(child, log, 30)


def damage_of(job: Job, folder: Path, least: int) -> list[str]:
    try:
        now = job.kept(folder)
    except Exception as error:
        return [f"not whole: {error!r}"]
    return [] if now >= least else [f"{now} kept of {least}"]


# Signals.


def send_signals(job: Job, work: Path, seconds: float, count: int, chance: random.Random) -> Checks:
    """Send one of the signals at each random moment; answers that were printed before must be in the file, which is whole."""
    for number in range(count):
        folder, kind = work / f"signal{number}", SIGNALS[number % len(SIGNALS)]
        folder.mkdir(parents=True)
        moment = chance.uniform(0, 1.1 * seconds)
        found = stop(job, folder, kind, moment)
        answered = len(found.out.split("\n")) - 1 if "--json" in job.words(folder) else int(moment > 0.7 * seconds)
        printed = 0 if job.resumes else answered
        wrong = damage_of(job, folder, printed if kind != signal.SIGKILL else 0)
        if kind != signal.SIGKILL:
            wrong += half_written(folder, frozenset())
            if found.ending in ("traceback", "hang") and found.status != 128 + kind:
                wrong.append(f"{found.ending}: {found.last[:120]}")
            if "Traceback" in found.err:
                wrong.append(f"a traceback: {found.err[-400:]!r}")
        yield Check(f"{kind.name} {number}", tuple(wrong))
        shutil.rmtree(folder)


# Disks that are full, and folders that cannot be written.


def full_at(number: int) -> None:
    """Let the ``number``-th flush to the disk of this process fail, from 1, and each after it."""
    real, calls = os.fsync, itertools.count(1)

    def fsync(file: int) -> None:
        if next(calls) >= number:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        real(file)

    os.fsync = fsync


def full_disk(job: Job, work: Path, expected: object) -> Checks:
    """Fail each write of a command in turn, and run it to the end afterwards."""
    for number in range(1, 40):
        folder = work / f"full{number}"
        folder.mkdir(parents=True)
        found = run(job.words(folder), folder.with_suffix(".log"), 120, before=partial(full_at, number))
        if found.ending == "done":
            return
        wrong = (
            []
            if (found.ending, "No space left" in found.last) == ("refused", True)
            else [f"{found.ending}: {found.last}"]
        )
        wrong += damage_of(job, folder, 0) + half_written(folder, frozenset())
        run_undisturbed(job, folder)
        wrong += wrong_result(job, folder, expected)
        yield Check(f"write {number}", tuple(wrong))


def unwritable(folder: Path) -> Checks:
    """Let a user without privileges write into folders and over files that it may only read, and lose stdout: it is full, or
    its reader is gone.
    """
    sound, work = sound_folder(folder / "sound"), folder / "read-only"
    work.mkdir()
    copy_map(sound / "map", work / "map")
    shutil.copy(sound / "results.jsonl", work / "r.jsonl")
    (work / "poses.json").write_text("[]\n")
    for path in (work, *work.rglob("*")):
        path.chmod(0o555 if path.is_dir() else 0o444)
    data, map_folder, training = sound / "data", sound / "map", tiny.options(2)
    known = ["localize", map_folder, sound / "photo.png", "--hfov", "40", "--start", sound / "pose.json", *QUICK]
    trials = ["evaluate", map_folder, data, "--trials", "1", "--workers", "1", *QUICK, "--out"]
    commands: dict[str, list[object]] = {
        "train into it": ["train", data, "--out", work / "new", *training],
        "train over a map": ["train", data, "--out", work / "map", "--overwrite", *training],
        "resume": ["train", data, "--out", work / "map", "--resume"],
        "bake": ["bake", work / "map", "--data", data, *BAKED],
        "scale": ["scale", work / "map", "--factor", "2", "--overwrite"],
        "localize --out": [*known, "--out", work / "p.json"],
        "localize --out over a file": [*known, "--out", work / "poses.json"],
        "localize --draw": [*known, "--draw", work / "pictures"],
        "track --out": ["track", map_folder, data, "--out", work / "t.json"],
        "track --plot": ["track", map_folder, data, "--out", work.parent / "t.json", "--plot", work / "t.png"],
        "evaluate": [*trials, work / "e.jsonl"],
        "evaluate --resume": [*trials, work / "r.jsonl"],
        "report": ["report", sound / "results.jsonl", "--out", work / "report"],
        "render": ["render", map_folder, data, "--out", work / "images"],
        "demo": ["demo", "--out", work / "demo"],
        "info": ["info", work / "map"],
    }
    for name, words in commands.items():
        before = files_of(work)
        found = run(words, work.parent / "readonly.log", 60, nobody=True)
        wrong = defects(found, work, before)
        wrong += [] if found.ending == ("done" if name == "info" else "refused") else [found.ending]
        yield Check(f"read-only: {name}", tuple(wrong))
    for name, words in {"localize": known, "info": ["info", map_folder], "backends": ["backends"]}.items():
        found = run(words, work.parent / "full.log", 60, out=Path("/dev/full"))
        wrong = [] if found.ending == "refused" and "No space left" in found.last else [f"{found.ending}: {found.last}"]
        yield Check(f"full stdout: {name}", tuple(wrong))
    moved = ["localize", map_folder, data, "--perturb", "0.1", "5", *QUICK, "--out"]
    for name, more in {"closed pipe": [], "closed pipe, --json": ["--json"], "full disk": []}.items():
        reading, out = os.pipe()
        os.close(reading)
        file = work.parent / f"{name}.json"
        found = run([*moved, file, *more], work.parent / "lost.log", out=Path("/dev/full") if "disk" in name else out)
        os.close(out)
        wrong = ["a traceback"] if "Traceback" in found.err else []
        yield Check(f"stdout is lost: {name}", tuple(wrong + ([] if rows(file) else ["no pose in the file"])))


# Crowds.


def two_at_once(job: Job, work: Path, times: int) -> Checks:
    """Begin a command twice at the same moment; at least one comes to its end, and the other may be refused in a line."""
    for number in range(times):
        folder = work / f"two{number}"
        folder.mkdir(parents=True)
        logs = [folder.with_name(f"{folder.name}-{i}") for i in range(2)]
        words = job.words(folder)
        children = [begin(words, log) for log in logs]
        found = [end(child, log, 120) for child, log in zip(children, logs, strict=True)]
        refused = [one.last for one in found if one.ending == "refused"]
        sound = any(one.ending == "done" for one in found) and len(refused) == sum(
            one.ending != "done" for one in found
        )
        good = sound and all("another" in line or "exists already" in line for line in refused)
        wrong = damage_of(job, folder, 0) + ([] if good else [f"{[one.ending for one in found]}, {refused}"])
        yield Check(f"two at once {number}", tuple(wrong))


def replaced_while_read(sound: Path, work: Path, seconds: float) -> Checks:
    """Load a map again and again while another process replaces it; every load gives one of the two maps."""
    folder = work / "replaced"
    copy_map(sound / "map", folder / "map")
    copy_map(sound / "map", folder / "other")

    def replace() -> None:
        from bidnerf.cli import main

        for step in range(1_000_000):
            words = ["train", sound / "data", "--out", folder / "map", "--overwrite", *tiny.options(2 + step % 2)]
            main([str(word) for word in words])

    writer = begin(replace, folder.with_suffix(".log"))
    until, loads = time.monotonic() + seconds, 0
    while time.monotonic() < until:
        wrong = []
        try:
            if load_map(folder / "map").info.step not in (1, 2, 3, 6):
                wrong.append("another map")
        except Exception as error:
            if "map" not in str(error):
                wrong.append(repr(error))
        loads += 1
        yield Check(f"load {loads}", tuple(wrong))
    os.kill(writer, signal.SIGKILL)
    end(writer, folder.with_suffix(".log"))


def threads(sound: Path, seconds: float) -> Checks:
    """Localize on eight threads for some time, by ``bid`` and by ``auto`` in turn; compare with one thread, and the memory at
    the end with that at a third.
    """
    stored, view = load_map(sound / "map"), photo(sound)
    bid = Localizer(stored, "bid", settings_of("bid", {"rays": 64, "max_steps": 5}))
    start = torch.tensor(json.loads((sound / "pose.json").read_text())["T_world_camera"], dtype=torch.float64)

    def answer(number: int) -> torch.Tensor:
        if number % 2:
            return localize_photo(sound, view, seed=number).T_world_camera.matrix()
        return bid(view, start.numpy(), seed=number).T_world_camera.matrix()

    alone, memory, began = [answer(number) for number in range(32)], list[int](), time.monotonic()
    with ThreadPoolExecutor(8) as pool:
        while time.monotonic() - began < seconds or len(memory) < 3:
            for number, (one, other) in enumerate(zip(pool.map(answer, range(32)), alone, strict=True)):
                yield Check(
                    f"call {number}",
                    () if torch.equal(one, other) else ("another answer than on one thread",),
                )
            gc.collect()
            memory.append(int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE"))
    growth = (memory[-1] - memory[len(memory) // 3]) / 2**20
    yield Check("memory", () if growth < 50 else (f"grew by {growth:.0f} MiB",))


def checks(work: Path, kind: str, count: int, seconds: float = 20, seed: int = 0) -> Checks:
    """Yield the checks of one kind: kills and signals (``count`` of each command), disks, or crowds (for some seconds)."""
    sound = sound_folder(work / "sound", FRAMES)
    for name, job in jobs(sound).items():
        if name in ("train", "bake") if kind == "signals" else not job.resumes:
            continue
        folder, chance = work / name, random.Random(f"{seed}/{name}")
        took, expected = run_undisturbed(job, folder / "whole"), job.result(folder / "whole")
        made = {
            "kills": lambda j=job, f=folder, t=took, e=expected, c=chance: kill(j, f / "kills", e, t, count, c),
            "signals": lambda j=job, f=folder, t=took, c=chance: send_signals(j, f / "signals", t, count, c),
            "disks": lambda j=job, f=folder, e=expected: full_disk(j, f / "full", e),
            "crowds": lambda j=job, f=folder: two_at_once(j, f / "two", 2),
        }[kind]()
        yield from (Check(f"{name}, {check.name}", check.wrong) for check in made)
    if kind == "crowds":
        yield from replaced_while_read(sound, work, seconds)
        yield from threads(sound, seconds)
