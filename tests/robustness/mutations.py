"""Mutation testing: seeded faults in the code, one at a time, and the share of them that the test suite catches.

    BIDNERF_DATA=... python tests/robustness/mutations.py [--tests ROOT] [--seconds 150] [--out out/mutations.json]

ROOT is the checkout whose code and tests are measured, by default that of this script. ``mutations.json`` lists the faults,
so that two versions of the suite are measured by the same ones. A fault is identified by its file and the text of its
expression, not by its line; one that no longer applies is reported and not counted.

Tests run first on the sound code, which records which functions they enter and the CPU time. With a fault, the
files that enter its function run until a test fails, for up to ``--seconds`` of CPU: first those whose text names most of
it, then all others, the slow tests last. A fault is caught if a test fails or hangs. What only other processes enter is not
seen. Each run is a line of ``OUT.rows.jsonl``, from which the program goes on after an interruption, or with more seconds;
OUT is the summary. Remove both when the tests or the code change.
"""

from __future__ import annotations

import argparse
import ast
import compileall
import json
import os
import re
import resource
import shutil
import signal
import sys
import threading
import time
from collections import defaultdict
from dataclasses import asdict, dataclass
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory
from types import CodeType, FrameType
from typing import IO, Any, NoReturn

FAULTS = Path(__file__).with_suffix(".json")
LONGEST = 1800.0
"""Seconds for the tests of a file on the sound code."""
MOST_PAGES = 6 * 2**30 // 4096
"""Memory at which a test is stopped: a fault in a size can ask for any."""
GUESSES = 4
"""Files of tests that are tried before all others."""

Row = dict[str, Any]
Unit = tuple[str, bool]
"""A file of tests, and whether its slow ones are meant or the others."""


@dataclass(frozen=True)
class Fault:
    """A small change of the code that tests ought to notice."""

    file: str
    function: str  # as in __qualname__
    kind: str
    text: str  # of the expression, which ``becomes`` replaces
    becomes: str
    nth: int = 0  # among the same expressions in the file, from 0


def with_fault(root: Path, fault: Fault) -> str | None:
    """Return the source of a fault's file with the fault, or None if its expression is no longer there."""
    path = root / fault.file
    source = path.read_text(encoding="utf-8") if path.exists() else ""
    spelled = list(re.finditer(r"\s+".join(map(re.escape, fault.text.split())), source))
    if len(spelled) <= fault.nth:
        return None
    start, end = spelled[fault.nth].span()
    return source[:start] + fault.becomes + source[end:]


def run_tests(copy: Path, test: str, slow: bool, sound: Row | None = None) -> Row:
    """Run the slow or the other tests of a file in a fork, which need not import the large libraries again.

    Without a run of the ``sound`` code before, this is one, and records which functions are entered. With it, tests that
    failed in it are left out, and the first failure ends the run.
    """
    result = copy / "result.json"
    result.unlink(missing_ok=True)
    began, pid = time.monotonic(), os.fork()
    if pid == 0:
        run_tests_here(copy, test, slow, sound)
    limit = 300 + 10 * sound["wall"] if sound else LONGEST  # others may use the machine, too
    while (ended := os.wait4(pid, os.WNOHANG))[0] == 0:
        pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
        if time.monotonic() - began > limit or pages > MOST_PAGES:
            os.killpg(pid, signal.SIGKILL)
        time.sleep(0.1)
    status = os.waitstatus_to_exitcode(ended[1])
    return {
        "outcome": {0: "passed", 5: "empty"}.get(status, "failed" if status > 0 else "stopped"),
        "seconds": round(ended[2].ru_utime + ended[2].ru_stime, 2),
        "wall": round(time.monotonic() - began, 2),
        **(json.loads(result.read_text()) if result.exists() else {"failed": [], "entered": []}),
    }


def run_tests_here(copy: Path, test: str, slow: bool, sound: Row | None) -> NoReturn:
    """Run tests in this process, write to ``result.json`` which failed and which functions they entered, and exit."""
    import pytest

    os.setsid()
    log = os.open(copy / "result.log", os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    os.dup2(log, 1)
    os.dup2(log, 2)
    os.chdir(copy)
    sys.path[:0] = os.environ["PYTHONPATH"].split(os.pathsep)
    options = [test, "-q", "-p", "no:xdist", "-p", "no:cacheprovider", "-m", "slow" if slow else "not slow"]
    failed: list[str] = []
    codes: set[CodeType] = set()

    class Recorder:
        def pytest_runtest_logreport(self, report: Any) -> None:
            failed.extend([report.nodeid] if report.failed else [])

        pytest_collectreport = pytest_runtest_logreport

    def record_call(frame: FrameType, event: str, argument: object) -> None:
        codes.add(frame.f_code)

    if sound:
        resource.setrlimit(resource.RLIMIT_CPU, (int(30 + 4 * sound["seconds"]),) * 2)
        options += ["-x", *(f"--deselect={name}" for name in sound["failed"])]
    else:
        threading.settrace(record_call)
        sys.settrace(record_call)
    status = pytest.main(options, plugins=[Recorder()])
    sys.settrace(None)
    code, skipped = (f"{copy}/bidnerf", f"{copy}/backends/bidnerf"), len(f"{copy}/")
    entered = {(c.co_filename[skipped:], c.co_qualname) for c in codes if c.co_filename.startswith(code)}
    (copy / "result.json").write_text(json.dumps({"failed": failed, "entered": sorted(entered)}))
    os._exit(status)


class Measurement:
    """The runs of tests so far, which are also lines of a file, on a copy of a checkout."""

    def __init__(self, root: Path, copy: Path, rows: IO[str]) -> None:
        ignored = shutil.ignore_patterns(".*", "__pycache__", "out", "site", "dist", "build")
        shutil.copytree(root, copy, ignore=ignored)
        [compileall.compile_dir(copy / name, quiet=2) for name in ("bidnerf", "bidnerf_core", "backends")]
        self.copy, self.rows = copy, rows
        # Of the sound code (None), and of each fault by its number.
        self.runs: dict[int | None, dict[Unit, Row]] = defaultdict(dict)
        rows.seek(0)
        for number, unit, run in map(json.loads, rows):
            self.runs[number][tuple(unit)] = run

    def run(self, number: int | None, unit: Unit) -> None:
        run = run_tests(self.copy, *unit, None if number is None else self.runs[None][unit])
        self.runs[number][unit] = run
        print(json.dumps([number, unit, run]), file=self.rows, flush=True)
        print(number, *unit, run["outcome"], run["seconds"], *run["failed"], flush=True)

    def units(self, slow: bool) -> list[Unit]:
        files = sorted((self.copy / "tests").rglob("test_*.py"))
        names = [str(f.relative_to(self.copy)) for f in files if not slow or ".slow" in f.read_text()]
        return [(name, slow) for name in names if "robustness" not in name]

    def mentioning(self, fault: Fault) -> list[Unit]:
        """Return the few files of tests that name most often the fault's function or of what its file defines."""
        module = ast.parse((self.copy / fault.file).read_bytes())
        defined = {node.name for node in module.body if isinstance(node, ast.ClassDef | ast.FunctionDef)}
        words = {name for name in defined if not name.startswith("_")} | {*fault.function.split(".")}
        words.add(fault.file.removesuffix(".py").replace("/", "."))
        spoken = re.compile(rf"\b({'|'.join(map(re.escape, words))})\b")
        scores = {unit: len(spoken.findall((self.copy / unit[0]).read_text())) for unit in self.units(slow=False)}
        return sorted(filter(scores.__getitem__, scores), key=lambda unit: -scores[unit])[:GUESSES]

    def judge(self, number: int, fault: Fault, units: list[Unit], seconds: float) -> None:
        """Run those tests that enter a fault's function, until one fails or the time is over."""
        sound, done, path = self.runs[None], self.runs[number], self.copy / fault.file
        for unit in units:
            if unit not in sound:
                self.run(None, unit)
        place = [fault.file, fault.function]
        units = [u for u in units if place in sound[u]["entered"] and sound[u]["outcome"] != "empty"]
        # Those first that enter little and are fast.
        units.sort(key=lambda unit: sound[unit]["seconds"] * len(sound[unit]["entered"]))
        original, times = path.read_bytes(), path.stat()
        path.write_text(with_fault(self.copy, fault) or "", encoding="utf-8")
        for unit in units:
            spent = sum(run["seconds"] for run in done.values()) + sound[unit]["seconds"]
            if unit not in done and spent <= seconds and not self.caught(number):
                self.run(number, unit)
        path.write_bytes(original)
        # By its time, the compiled file is known.
        os.utime(path, ns=(times.st_atime_ns, times.st_mtime_ns))

    def caught(self, number: int) -> list[Any]:
        """Return what failed for a fault."""
        done = self.runs[number].items()
        return [run["failed"] or unit for unit, run in done if run["outcome"] in ("failed", "stopped")]

    def verdict(self, number: int, fault: Fault) -> Row:
        place, done, by = [fault.file, fault.function], self.runs[number], self.caught(number)
        entering = [u for u, run in self.runs[None].items() if place in run["entered"] and run["outcome"] != "empty"]
        left = 0 if by else len(set(entering) - set(done))
        survived = "not entered" if not entering else "out of time" if left else "survived"
        spent = sum(run["seconds"] for run in done.values())
        return {"verdict": "caught" if by else survived, "by": by, "left": left, "seconds": spent}


def main() -> None:
    """Measure a checkout."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--tests", type=Path, default=Path(__file__).parents[2], metavar="ROOT")
    parser.add_argument("--seconds", type=float, default=150)
    parser.add_argument("--out", type=Path, default=Path("out/mutations.json"), metavar="FILE")
    arguments = parser.parse_args()
    faults = [Fault(**fields) for fields in json.loads(FAULTS.read_text())]
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    with arguments.out.with_suffix(".rows.jsonl").open("a+") as rows, TemporaryDirectory() as folder:
        copy = Path(folder).resolve() / "copy"
        parts = (copy, copy / "backends", copy / "plugins" / "bidnerf-scanner-app")
        os.environ |= {"PYTHONPATH": os.pathsep.join(map(str, parts)), "PYTHONDONTWRITEBYTECODE": "1"}
        os.environ |= {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "OMP_WAIT_POLICY": "PASSIVE"}
        sys.dont_write_bytecode = True  # a compiled fault would outlive it
        for library in ("cv2", "hypothesis", "kornia", "pytest", "scipy.optimize"):
            import_module(library)
        measurement = Measurement(arguments.tests, copy, rows)
        applies = {number: fault for number, fault in enumerate(faults) if with_fault(copy, fault)}
        for number, fault in applies.items():
            for unit in measurement.mentioning(fault):
                if not measurement.caught(number):
                    measurement.judge(number, fault, [unit], arguments.seconds)
        for slow in (False, True):
            for number, fault in applies.items():
                if not measurement.caught(number):
                    measurement.judge(number, fault, measurement.units(slow), arguments.seconds)
    verdicts = [asdict(fault) | measurement.verdict(number, fault) for number, fault in applies.items()]
    print(*(f"no longer applies: {fault}" for fault in faults if fault not in applies.values()), sep="\n")
    for row in verdicts:
        if row["verdict"] != "caught":
            print("{verdict}, {left} left: {kind} in {file}, {function}: {text} -> {becomes}".format(**row))
    from bidnerf.results import success_rate  # not above: the runs import the code of the copy

    rate = success_rate(sum(row["verdict"] == "caught" for row in verdicts), len(verdicts))
    minutes = sum(run["seconds"] for group in measurement.runs.values() for run in group.values()) / 60
    print(f"caught: {rate.successes} of {rate.trials}, {rate.low:.0%} to {rate.high:.0%}; {minutes:.0f} CPU minutes")
    summary = asdict(rate) | {"minutes": minutes}
    arguments.out.write_text(json.dumps({**summary, "faults": verdicts}, indent=1) + "\n")


if __name__ == "__main__":
    main()
