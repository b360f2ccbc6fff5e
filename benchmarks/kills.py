"""Kill train, bake, evaluate and report at random moments, fill their disk at every write, and let them meet each other.

    python benchmarks/kills.py [--kills 25] [--minutes 12] [--seed 0] [--name kills]

Each command runs in a child that is forked from this process, so that a kill costs no imports. After every kill the same
command goes on, and what it leaves must be whole; its last result must equal that of an undisturbed run but for times. A
write fails as on a full disk by a failing ``fsync``, the first, the second and so on until the command comes to its end.
Two processes begin with one ``--out`` at the same moment; a map is read while another process replaces it; and eight
threads share a ``Localizer``, whose answers and memory are compared with those of one thread.
"""

from __future__ import annotations

import argparse
import errno
import gc
import json
import os
import random
import signal
import sys
import time
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch
from fuzz_cases import BAKED, QUICK, SMALL_FIELD, sound_folder

from bidnerf_core import Localizer, load_map
from bidnerf_core.cli import bake, evaluate, main, report, train  # noqa: F401  (before the first fork)
from bidnerf_core.datasets import open_dataset
from bidnerf_core.evaluation.protocols import perturb
from bidnerf_core.evaluation.provenance import write_record
from bidnerf_core.evaluation.trials import STATUS
from bidnerf_core.io.files import is_temporary
from bidnerf_core.localization import settings_of
from bidnerf_core.maps.description import load_info
from bidnerf_core.maps.files import save_map
from bidnerf_core.results.plot_style import require_matplotlib
from bidnerf_core.training import TrainingState

RESULTS = Path(__file__).parent / "results"
VARIES = ("seconds", "peak_memory_bytes")
STEPS, TRIALS = "12", "8"


class Broken(Exception):
    """What a kill or a full disk left is not whole."""


# Children.


def begin(words: list[str], before: Callable[[], None] = lambda: None, log: Path | None = None) -> int:
    """Run a command in a child, whose process id is returned."""
    child = os.fork()
    if child:
        return child
    out = os.open(os.devnull if log is None else log, os.O_WRONLY | os.O_CREAT)
    os.dup2(out, 1)
    os.dup2(out, 2)
    before()
    os._exit(main(words))


def end(child: int) -> int:
    """Return the exit status of a child, or minus the number of the signal that killed it."""
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def undisturbed(words: list[str]) -> float:
    """Run a command to its end and return the seconds that it took."""
    began = time.monotonic()
    status = end(begin(words))
    if status != 0:
        raise Broken(f"exit status {status} of an undisturbed {' '.join(words)}")
    return time.monotonic() - began


# Commands, and what each must leave.


@dataclass(frozen=True)
class Job:
    """A command that is killed. ``folder`` stands for what the undisturbed and the killed run each have of their own."""

    words: Callable[[Path], list[str]]  # depends on what is there already
    check: Callable[[Path], object]  # raises where it is not whole
    result: Callable[[Path], object]  # of a run that came to its end


def jobs(sound: Path) -> dict[str, Job]:
    data = str(sound / "data")

    def training(folder: Path) -> list[str]:
        out = folder / "map"
        more = ["--resume"] if (out / "map.json").exists() else [*SMALL_FIELD, "--steps", STEPS]
        return ["train", data, "--out", str(out), "--checkpoint-every", "0", *more, "--no-bake"]

    def baking(folder: Path) -> list[str]:
        if not (folder / "map").exists():
            copy_map(sound / "map", folder / "map")
        return ["bake", str(folder / "map"), "--data", data, *BAKED]

    def trials(folder: Path) -> list[str]:
        more = ["--size", "0.3", "--trials", TRIALS, "--workers", "1", "--seed", "0", *QUICK]
        return ["evaluate", str(sound / "map"), data, "--out", str(folder / "r.jsonl"), *more]

    def reporting(folder: Path) -> list[str]:
        return ["report", str(sound / "results.jsonl"), "--out", str(folder / "report")]

    return {
        "train": Job(training, map_is_whole, lambda folder: map_numbers(folder, ("weights",))),
        "bake": Job(baking, map_is_whole, lambda folder: map_numbers(folder, ("surface", "landmarks"))),
        "evaluate": Job(
            trials, lambda folder: lines(folder / "r.jsonl"), lambda folder: lines(folder / "r.jsonl")
        ),
        "report": Job(reporting, page_is_whole, files_of_report),
    }


def copy_map(source: Path, to: Path) -> None:
    """Copy a map without its baked parts."""
    info = load_info(source)
    to.mkdir(parents=True)
    (to / info.weights).write_bytes((source / info.weights).read_bytes())
    plain = json.loads((source / "map.json").read_text())
    (to / "map.json").write_text(json.dumps(plain | {"surface": None, "landmarks": None, "capture": None}))


def map_is_whole(folder: Path) -> int:
    """Return the step of the map, or 0 where there is none yet."""
    if not (folder / "map" / "map.json").exists():
        return 0
    return load_map(folder / "map").info.step


def map_numbers(folder: Path, parts: tuple[str, ...]) -> object:
    """Return the bytes of the map's files, and check that there are no others."""
    info = load_info(folder / "map")
    parts_named = (info.weights, info.training, info.surface, info.landmarks, info.capture)
    named = {"map.json", *parts_named} - {None}
    others = {file.name for file in (folder / "map").iterdir()} - named
    if others:
        raise Broken(f"files that map.json does not name: {sorted(others)}")
    return [(folder / "map" / str(getattr(info, part))).read_bytes() for part in parts]


def lines(path: Path) -> list[dict[str, Any]]:
    """Return the results of whole lines without what varies from run to run."""
    whole = path.read_text().split("\n")[:-1] if path.exists() else []
    found = [json.loads(line) for line in whole]
    return [{name: value for name, value in line.items() if name not in VARIES} for line in found]


def page_is_whole(folder: Path) -> int:
    page = folder / "report" / "index.html"
    if not page.exists():
        return 0
    text = page.read_text()
    unfinished = "Unfinished report" in text
    if not unfinished and not text.endswith("</html>\n"):
        raise Broken("half of a page")
    return int(not unfinished)


def files_of_report(folder: Path) -> object:
    return {
        file.name: file.read_bytes() for file in (folder / "report").iterdir() if not is_temporary(file.name)
    }


# Kills.


def killed(
    job: Job, work: Path, whole: Path, seconds: float, kills: int, until: float, chance: random.Random
) -> dict[str, Any]:
    """Kill a command until it has been killed ``kills`` times; a run that comes to its end is compared and begun anew."""
    count, finished, rounds, kept = 0, 0, 0, 0
    folder, before = work / "0", 0
    folder.mkdir()
    expected = job.result(whole)
    while count < kills and time.monotonic() < until:
        child = begin(job.words(folder))
        time.sleep(chance.uniform(0, 1.1 * seconds))
        os.kill(child, signal.SIGKILL)
        status = end(child)
        if status == -signal.SIGKILL:
            count += 1
        elif status != 0:
            raise Broken(f"exit status {status} of {job.words(folder)}")
        now = job.check(folder)
        size = now if isinstance(now, int) else len(now)  # type: ignore[arg-type]
        if size < before:
            raise Broken(f"{before} before a kill, {size} after it")
        before, kept = size, kept + (size > 0)
        if status == 0:
            finished += equal(job, folder, expected)
            rounds += 1
            folder, before = work / str(rounds), 0
            folder.mkdir()
    if begun(job, folder):
        undisturbed(job.words(folder))
        finished += equal(job, folder, expected)
    return {
        "kills": count,
        "with something kept": kept,
        "runs to the end, equal to the undisturbed one": finished,
    }


def begun(job: Job, folder: Path) -> bool:
    words = job.words(folder)
    return (
        words[0] != "train"
        or not (folder / "map" / "map.json").exists()
        or not load_info(folder / "map").complete
    )


def equal(job: Job, folder: Path, expected: object) -> int:
    if job.result(folder) != expected:
        raise Broken(f"the result in {folder} is another than the undisturbed one")
    return 1


# A full disk.


def full_at(number: int) -> Callable[[], None]:
    """Let the ``number``-th flush to the disk of a child fail, from 1, and each after it."""

    def before() -> None:
        real, count = os.fsync, 0

        def fsync(file: int) -> None:
            nonlocal count
            count += 1
            if count >= number:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            real(file)

        os.fsync = fsync

    return before


def full_disk(job: Job, work: Path, expected: object, until: float) -> dict[str, int]:
    """Fail each write of a command in turn, and run it to the end afterwards."""
    number = 1
    while time.monotonic() < until:
        folder = work / f"full{number}"
        folder.mkdir()
        log = folder.with_suffix(".log")
        status = end(begin(job.words(folder), full_at(number), log))
        if status == 0:
            break
        said = log.read_text().splitlines()
        if status != 1 or "No space left on device" not in said[-1]:
            raise Broken(f"write {number}: exit status {status}, {said[-3:]}")
        job.check(folder)
        left = [path.name for path in folder.rglob("*") if path.is_file() and is_temporary(path.name)]
        if left:
            raise Broken(f"write {number} left {left}")
        undisturbed(job.words(folder))
        equal(job, folder, expected)
        number += 1
    return {"writes that failed, with a sound result afterwards": number - 1}


# Crowds.


def two_at_once(job: Job, work: Path, times: int) -> dict[str, int]:
    """Begin a command twice at the same moment; at least one comes to its end, and the other may be refused in a line."""
    endings = Counter[str]()
    for number in range(times):
        folder = work / f"two{number}"
        folder.mkdir()
        logs = [folder.with_suffix(f".{i}") for i in range(2)]
        words = job.words(folder)
        children = [begin(words, log=log) for log in logs]
        statuses = [end(child) for child in children]
        job.check(folder)
        refused = [
            log.read_text().splitlines()[-1]
            for log, status in zip(logs, statuses, strict=True)
            if status == 1
        ]
        if 0 not in statuses or any(
            "another" not in line and "exists already" not in line for line in refused
        ):
            raise Broken(f"two at once: {statuses}, {refused}")
        endings["both came to their end" if statuses == [0, 0] else "the second was refused in a line"] += 1
    return dict(endings)


def replaced_while_read(sound: Path, work: Path, seconds: float) -> dict[str, int]:
    """Load a map again and again while another process replaces it; every load gives one whole map."""
    folder = work / "replaced"
    copy_map(sound / "map", folder)
    info = load_info(folder)
    weights = load_map(folder).field.state_dict()  # type: ignore[attr-defined]
    writer = os.fork()
    if writer == 0:
        for step in range(1_000_000):
            changed = {
                name: value if not value.is_floating_point() else torch.full_like(value, float(step % 2))
                for name, value in weights.items()
            }
            save_map(folder, info, TrainingState(step, changed, {}))
    loads, until = 0, time.monotonic() + seconds
    try:
        while time.monotonic() < until:
            found = load_map(folder).field.state_dict()  # type: ignore[attr-defined]
            parameters = [value for name, value in found.items() if name.startswith("encoding")]
            if len({float(x) for value in parameters for x in value.flatten()[:3]}) != 1 and loads:
                raise Broken("a map of two halves")
            loads += 1
    finally:
        os.kill(writer, signal.SIGKILL)
        end(writer)
    return {"loads, each of one whole map": loads}


def threads(sound: Path, seconds: float) -> dict[str, Any]:
    """Localize on eight threads for some time, by ``bid`` and by ``auto`` in turn; compare with one thread, and the memory at the
    end with that at a third.
    """
    stored = load_map(sound / "map")
    methods = [
        Localizer(stored, "bid", settings_of("bid", {"rays": 64, "max_steps": 5})),
        Localizer(stored, "auto", settings_of("auto", {"points": 100, "hypotheses": 8, "rounds": 1})),
    ]
    view = open_dataset(sound / "data").views("test")[0]
    starts = [perturb(view.T_ref_camera, 0.1, 3.0, seed) for seed in range(32)]

    def answer(number: int) -> torch.Tensor:
        return methods[number % 2](view.frame, starts[number], seed=number).poses.matrix()

    alone = [answer(number) for number in range(32)]
    calls, other, memory, began = 0, 0, list[int](), time.monotonic()
    with ThreadPoolExecutor(8) as pool:
        while time.monotonic() - began < seconds:
            found = list(pool.map(answer, range(32)))
            other += sum(not torch.equal(a, b) for a, b in zip(found, alone, strict=True))
            calls += 32
            gc.collect()
            memory.append(resident())
    return {
        "seconds": round(time.monotonic() - began), "calls": calls, "answers that differ from one thread's": other,
        "MiB at a third and at the end": [round(memory[len(memory) // 3] / 2**20), round(memory[-1] / 2**20)],
    }  # fmt: skip


def resident() -> int:
    line = next(line for line in STATUS.read_text().splitlines() if line.startswith("VmRSS:"))
    return int(line.split()[1]) * 1024


def run_all(kills: int, minutes: float, seed: int, work: Path) -> dict[str, Any]:
    sound = work / "sound"
    sound.mkdir()
    sound_folder(sound)
    require_matplotlib()
    began, results = time.monotonic(), dict[str, Any]()
    share = 60 * minutes / 6
    for place, (name, job) in enumerate(jobs(sound).items(), start=1):
        folder = work / name
        whole = folder / "whole"
        whole.mkdir(parents=True)
        seconds = undisturbed(job.words(whole))
        until = began + place * share
        results[name] = {"seconds undisturbed": round(seconds, 2)}
        results[name] |= killed(
            job, folder, whole, seconds, kills, until - share / 3, random.Random(f"{seed}/{name}")
        )
        results[name] |= full_disk(job, folder, job.result(whole), until)
        results[name] |= two_at_once(job, folder, 2)
        print(name, results[name], file=sys.stderr, flush=True)
    results["map replaced while it is read"] = replaced_while_read(sound, work, share / 4)
    results["eight threads"] = threads(sound, share)
    return results


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--kills", type=int, default=25, help="of each command")
    parser.add_argument(
        "--minutes", type=float, default=12.0, help="a command whose time is over is killed less often"
    )
    parser.add_argument("--seed", type=int, default=0, help="of the moments")
    parser.add_argument("--name", default="kills")
    given = parser.parse_args()
    torch.set_num_threads(1)
    with TemporaryDirectory() as place:
        found = run_all(given.kills, given.minutes, given.seed, Path(place))
    print(write_record(RESULTS / f"{given.name}.json", found, given.seed))
    print(json.dumps(found, indent=1))
