"""Kills, signals at random moments, full disks, folders that cannot be written, and processes that meet each other.

Each command runs in a child that is forked from this process, so that a stop costs no imports. After every kill the same
command goes on, and what it leaves must be whole; its last result must equal that of an undisturbed run but for times. A
signal may not lose an answer that was printed before it. A write fails as on a full disk by a failing ``fsync``, the first,
the second and so on until the command comes to its end.
"""

from __future__ import annotations

import errno
import gc
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

from bidnerf import Localizer, load_map
from bidnerf_core.localization import settings_of
from harness import (
    BAKED,
    QUICK,
    SMALL_FIELD,
    TEMPORARY,
    Check,
    Checks,
    Outcome,
    begin,
    defects,
    end,
    files_of,
    half_written,
    localized,
    photo,
    run,
    sound_folder,
)

VARIES = ("seconds", "peak_memory_bytes")
STEPS, TRIALS, FRAMES = "12", "8", 24
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
        more = ["--resume"] if (out / "map.json").exists() else [*SMALL_FIELD, "--steps", STEPS]
        return ["train", data, "--out", out, "--checkpoint-every", "0", *more, "--no-bake"]

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
            lambda folder: len(poses(folder)),
            lambda folder: [{k: v for k, v in row.items() if k not in VARIES} for row in poses(folder)],
            resumes=False,
        )

    return {
        "train": Job(training, step_of, lambda folder: parts(folder, ("weights",))),
        "bake": Job(baking, step_of, lambda folder: parts(folder, ("surface", "landmarks"))),
        "evaluate": Job(trials, lambda folder: len(rows(folder)), rows),
        "report": Job(
            lambda folder: ["report", sound / "results.jsonl", "--out", folder / "report"], pages, files_of_report
        ),
        "localize": answers(
            "localize", "--json", "--perturb", "0.1", "5", "--method", "bid", "--max-steps", "12", "--rays", "64"
        ),
        "track": answers("track"),
    }


class Broken(Exception):
    """What a stop left is not whole."""


def plain_map(folder: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((folder / "map" / "map.json").read_text())
    return found


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
    """Return the bytes of the map's files, and check that there are no others."""
    plain = plain_map(folder)
    named = {"map.json", *(v for v in plain.values() if isinstance(v, str))}
    if others := {file.name for file in (folder / "map").iterdir()} - named:
        raise Broken(f"files that map.json does not name: {sorted(others)}")
    return [(folder / "map" / plain[part]).read_bytes() for part in names]


def rows(folder: Path) -> list[dict[str, Any]]:
    """Return the results of whole lines without what varies from run to run."""
    path = folder / "r.jsonl"
    found = [json.loads(line) for line in path.read_text().split("\n")[:-1]] if path.exists() else []
    return [{name: value for name, value in line.items() if name not in VARIES} for line in found]


def poses(folder: Path) -> list[dict[str, Any]]:
    path = folder / "poses.json"
    found: list[dict[str, Any]] = json.loads(path.read_text()) if path.exists() else []
    return found


def pages(folder: Path) -> int:
    page = folder / "report" / "index.html"
    text = page.read_text() if page.exists() else "Unfinished report"
    if "Unfinished report" not in text and not text.rstrip().endswith("</html>"):
        raise Broken("half of a page")
    return int("Unfinished report" not in text)


def files_of_report(folder: Path) -> object:
    files = (file for file in (folder / "report").iterdir() if not TEMPORARY.fullmatch(file.name))
    return {file.name: file.read_bytes() for file in files}


def undisturbed(job: Job, folder: Path) -> float:
    """Run a command to its end and return the seconds that it took."""
    folder.mkdir(parents=True, exist_ok=True)
    found = run(job.words(folder), folder.with_suffix(".log"), 300)
    if found.ending != "done":
        raise Broken(f"an undisturbed {job.words(folder)[0]}: {found}")
    return found.seconds


def equal(job: Job, folder: Path, expected: object) -> list[str]:
    return [] if job.result(folder) == expected else ["the result is another than the undisturbed one"]


# Kills, and resuming after them.


def killed(job: Job, work: Path, expected: object, seconds: float, kills: int, chance: random.Random) -> Checks:
    """Kill a command at random moments and resume it; a run that comes to its end is compared and begun anew."""
    rounds, before, folder = 0, 0, work / "0"
    folder.mkdir(parents=True)
    for number in range(kills):
        found = stopped(job, folder, signal.SIGKILL, chance.uniform(0, 1.1 * seconds))
        wrong = kept_whole(job, folder, before)
        before = 0 if wrong else job.kept(folder)
        if found.ending == "done":
            wrong += equal(job, folder, expected)
            rounds, before = rounds + 1, 0
            folder = work / str(rounds)
            folder.mkdir()
        elif found.status != -signal.SIGKILL:
            wrong.append(f"{found.ending}: {found.last}")
        yield Check(f"kill {number}", tuple(wrong))


def stopped(job: Job, folder: Path, number: int, moment: float) -> Outcome:
    log = folder.with_suffix(".log")
    child = begin(job.words(folder), log)
    time.sleep(moment)
    os.kill(child, number)
    return end(child, log, 30)


def kept_whole(job: Job, folder: Path, least: int) -> list[str]:
    try:
        now = job.kept(folder)
    except Exception as error:
        return [f"not whole: {error!r}"]
    return [] if now >= least else [f"{now} kept of {least}"]


# Signals.


def signalled(job: Job, work: Path, seconds: float, count: int, chance: random.Random) -> Checks:
    """Send one of the signals at each random moment; answers that were printed before must be in the file, which is whole."""
    for number in range(count):
        folder, kind = work / f"signal{number}", SIGNALS[number % len(SIGNALS)]
        folder.mkdir(parents=True)
        moment = chance.uniform(0, 1.1 * seconds)
        found = stopped(job, folder, kind, moment)
        answered = len(found.out.split("\n")) - 1 if "--json" in job.words(folder) else int(moment > 0.7 * seconds)
        printed = 0 if job.resumes else answered
        wrong = kept_whole(job, folder, printed if kind != signal.SIGKILL else 0)
        if kind != signal.SIGKILL:
            wrong += half_written(folder, frozenset())
            if found.ending in ("traceback", "hang") and found.status != 128 + kind:
                wrong.append(f"{found.ending}: {found.last[:120]}")
            if "Traceback" in found.err:
                wrong.append("a traceback")
        yield Check(f"{kind.name} {number}", tuple(wrong))
        shutil.rmtree(folder)


# Disks that are full, and folders that cannot be written.


def full_at(number: int) -> None:
    """Let the ``number``-th flush to the disk of this process fail, from 1, and each after it."""
    real, count = os.fsync, 0

    def fsync(file: int) -> None:
        nonlocal count
        count += 1
        if count >= number:
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
        wrong += kept_whole(job, folder, 0) + half_written(folder, frozenset())
        undisturbed(job, folder)
        yield Check(f"write {number}", tuple(wrong + equal(job, folder, expected)))


def read_only(sound: Path, work: Path) -> Checks:
    """Let a user without privileges write into folders and over files that it may only read, and with a full stdout."""
    work.mkdir(parents=True, exist_ok=True)
    copy_map(sound / "map", work / "map")
    shutil.copy(sound / "results.jsonl", work / "r.jsonl")
    (work / "poses.json").write_text("[]\n")
    for path in (work, *work.rglob("*")):
        path.chmod(0o555 if path.is_dir() else 0o444)
    data, map_folder, shot = sound / "data", sound / "map", sound / "photo.png"
    known = ["localize", map_folder, shot, "--hfov", "40", "--start", sound / "pose.json", *QUICK]
    commands: dict[str, list[object]] = {
        "train into it": ["train", data, "--out", work / "new", *SMALL_FIELD, "--steps", "2", "--no-bake"],
        "train over a map": [
            "train",
            data,
            "--out",
            work / "map",
            "--overwrite",
            *SMALL_FIELD,
            "--steps",
            "2",
            "--no-bake",
        ],
        "resume": ["train", data, "--out", work / "map", "--resume"],
        "bake": ["bake", work / "map", "--data", data, *BAKED],
        "localize --out": [*known, "--out", work / "p.json"],
        "localize --out over a file": [*known, "--out", work / "poses.json"],
        "localize --draw": [*known, "--draw", work / "pictures"],
        "track --out": ["track", map_folder, data, "--out", work / "t.json"],
        "track --plot": ["track", map_folder, data, "--out", work.parent / "t.json", "--plot", work / "t.png"],
        "evaluate": [
            "evaluate",
            map_folder,
            data,
            "--out",
            work / "e.jsonl",
            "--trials",
            "1",
            "--workers",
            "1",
            *QUICK,
        ],
        "evaluate --resume": [
            "evaluate",
            map_folder,
            data,
            "--out",
            work / "r.jsonl",
            "--trials",
            "1",
            "--workers",
            "1",
            *QUICK,
        ],
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
        wrong = kept_whole(job, folder, 0) + ([] if good else [f"{[one.ending for one in found]}, {refused}"])
        yield Check(f"two at once {number}", tuple(wrong))


def replaced_while_read(sound: Path, work: Path, seconds: float) -> Checks:
    """Load a map again and again while another process replaces it; every load gives one of the two maps."""
    folder = work / "replaced"
    copy_map(sound / "map", folder / "map")
    copy_map(sound / "map", folder / "other")
    words = ["train", sound / "data", *SMALL_FIELD, "--no-bake", "--overwrite", "--steps"]

    def replace() -> None:
        from bidnerf.cli import main

        for step in range(1_000_000):
            main([str(word) for word in (*words, 2 + step % 2, "--out", folder / "map")])

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
            return localized(sound, view, seed=number).T_world_camera.matrix()  # type: ignore[attr-defined, no-any-return]
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


def checks(work: Path, kinds: Sequence[str], kills: int, signals: int, seconds: float = 20, seed: int = 0) -> Checks:
    """Yield all checks of some ``kinds``: kills, signals, disks, read-only, crowds."""
    work.chmod(0o755)
    sound = work / "sound"
    sound.mkdir()
    sound_folder(sound, FRAMES)
    for name, job in jobs(sound).items():
        folder, chance = work / name, random.Random(f"{seed}/{name}")
        wanted = {
            "kills": job.resumes,
            "disks": job.resumes,
            "crowds": job.resumes,
            "signals": name not in ("train", "bake"),
        }
        if not any(wanted.get(kind) for kind in kinds):
            continue
        took = undisturbed(job, folder / "whole")
        expected = job.result(folder / "whole")
        parts_of_job = {
            "kills": lambda j=job, f=folder, e=expected, t=took, c=chance: killed(j, f / "kills", e, t, kills, c),
            "signals": lambda j=job, f=folder, t=took, c=chance: signalled(j, f / "signals", t, signals, c),
            "disks": lambda j=job, f=folder, e=expected: full_disk(j, f / "full", e),
            "crowds": lambda j=job, f=folder: two_at_once(j, f / "two", 2),
        }
        for kind in kinds:
            if wanted.get(kind):
                for check in parts_of_job[kind]():
                    yield Check(f"{name}, {check.name}", check.wrong)
    if "read-only" in kinds:
        yield from read_only(sound, work / "read-only")
    if "crowds" in kinds:
        yield from replaced_while_read(sound, work, seconds)
        yield from threads(sound, seconds)
