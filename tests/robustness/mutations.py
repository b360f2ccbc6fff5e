"""Mutation testing: seeded faults in the code, one at a time, and the share of them that the test suite catches.

    BIDNERF_DATA=... python tests/robustness/mutations.py [--tests ROOT] [--seconds 150] [--out out/mutations.json]

ROOT is the checkout whose code and tests are measured, by default that of this script. ``mutations.json`` lists the faults,
so that two versions of the suite are measured by the same ones. A fault is identified by its file, its function and the
text of the expression, not by its line; one that no longer applies is reported and not counted. Without the list, a new
one is drawn with a fixed seed: delete it to draw again.

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
import random
import re
import resource
import shutil
import signal
import sys
import threading
import time
from collections import Counter, defaultdict
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory
from types import CodeType, FrameType
from typing import IO, Any, NoReturn

FAULTS = Path(__file__).with_suffix(".json")
SEED = 2024
STRATA = (
    (28, "localization mapping camera geometry fields depth carving training captures frames structure"),
    (12, "datasets io maps results evaluation service viewer cli"),
)
"""How many faults are drawn from which packages: the numerical ones, and those around them."""
OPERATORS = {ast.Add: "+-", ast.Sub: "-+", ast.Mult: "*/", ast.Div: "/*"}
BOUNDS = {ast.Lt: ("<", "<="), ast.LtE: ("<=", "<"), ast.Gt: (">", ">="), ast.GtE: (">=", ">")}
EXTREMES = {"min": "max", "amin": "amax", "argmin": "argmax", "minimum": "maximum", "clamp_min": "clamp_max"}
EXTREMES |= {most: least for least, most in EXTREMES.items()}
AXES = {"0": "1", "1": "0", "-1": "-2", "-2": "-1"}
SKIPPED = ast.Import | ast.ImportFrom | ast.Raise | ast.Assert | ast.JoinedStr | ast.arguments
SKIPPED_FIELDS = {"annotation", "returns", "decorator_list"}
MESSAGES = re.compile(r"(.*\.)?(print|warn|\w*(Error|Warning)|debug|info|log_message)")
"""Functions whose arguments are only shown."""
DISPLAYS = ast.List | ast.Tuple | ast.Dict | ast.Set | ast.ListComp | ast.JoinedStr
NO_NUMBERS = re.compile(
    r"""b?["'].*|(str|bytes|list|tuple|set|sorted|Path)\(.*|.*(keys|encode|read_bytes|perf_counter)\(.*"""
    r"""|.*(path|folder|file|root|directory|parent|name|text|dir|base|content|word|line)s?(\[.*)?""",
    re.IGNORECASE | re.DOTALL,
)
"""Operands that are joined or repeated rather than added, divided or multiplied, and times that are only shown."""
TINY = re.compile(r"\de-[5-9]|\de-\d\d|\b(EPS|EPSILON|TINY|ROUNDING)\b")
"""Summands that guard against division by zero: without them, results are equal."""
COUNT = re.compile(r"\d+|len\(.*|.*(\.ndim|\.numel\(\)|\.shape\[\S+\]|\.sum\(\)|count)")
"""A side of a comparison that makes equality likely."""
CONTEXT = 20
"""Letters of an expression that identify it in its function, unless the whole of it is shorter."""
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
    nth: int = 0  # among the same in the function, from 0


def candidates(root: Path, path: Path) -> Iterator[tuple[Fault, bytes]]:
    """Yield all faults that can be made in a file, each with the changed file."""
    source = path.read_bytes().decode("latin-1")  # a letter a byte, in which ``ast`` counts
    lines = [0, *(match.end() for match in re.finditer("\n", source))]
    seen: Counter[Fault] = Counter()

    def span(node: Any) -> tuple[int, int]:
        return lines[node.lineno - 1] + node.col_offset, lines[node.end_lineno - 1] + node.end_col_offset

    def text(node: ast.AST) -> str:
        return source[slice(*span(node))]

    def joined(node: ast.AST) -> bool:
        if isinstance(node, ast.BinOp):
            return joined(node.left) or joined(node.right)
        return isinstance(node, DISPLAYS) or NO_NUMBERS.fullmatch(text(node)) is not None

    def operator(left: ast.AST, right: ast.AST, old: str, new: str) -> tuple[int, int, str]:
        at = source.index(old, span(left)[1], span(right)[0])
        return at, at + len(old), new

    def changes(node: Any) -> Iterator[tuple[str, tuple[int, int, str]]]:
        """Yield the kinds of faults at a node, each with the part of the source and its replacement."""
        start, end = span(node) if hasattr(node, "lineno") else (0, 0)
        match node:
            case ast.BinOp(left=left, right=right) | ast.AugAssign(target=left, value=right):
                if type(node.op) in OPERATORS and not joined(left) and not joined(right):
                    at, stop, new = operator(left, right, *OPERATORS[type(node.op)])
                    yield "sign" if new in "+-" else "scale", (at, stop, new)
                    if new in "+-" and isinstance(node, ast.BinOp) and not TINY.search(text(right)):
                        yield "dropped summand", (len(source[:at].rstrip()), end, "")
            case ast.UnaryOp(op=ast.USub()) if not source.endswith(("dim=", "axis="), 0, start):
                yield "dropped minus", (start, start + 1, "")
            case ast.Compare(left=left, ops=[op], comparators=[right]) if type(op) in BOUNDS:
                if COUNT.fullmatch(text(left)) or COUNT.fullmatch(text(right)):
                    yield "boundary", operator(left, right, *BOUNDS[type(op)])
            case ast.BoolOp(op=op, values=[left, right]):
                words = ("and", "or") if isinstance(op, ast.And) else ("or", "and")
                at, stop, new = operator(left, right, *words)
                yield "connective", (start, end, f"({source[start:at]}{new}{source[stop:end]})")
            case ast.If(test=test) | ast.While(test=test) | ast.IfExp(test=test):
                yield "negated condition", (*span(test), f"not ({text(test)})")
            case ast.Slice() | ast.Call(func=ast.Name(id="range") | ast.Attribute(attr="arange")):
                for bound in node.args if isinstance(node, ast.Call) else (node.lower, node.upper):
                    number = bound.operand if isinstance(bound, ast.UnaryOp) else bound
                    if isinstance(number, ast.Constant) and type(number.value) is int:
                        for step in (1, -1):
                            yield "off by one", (*span(number), str(number.value + step))
            case ast.Call(func=ast.Name(id=name) | ast.Attribute(attr=name)) if name in EXTREMES:
                stop = span(node.func)[1]
                yield "extreme", (stop - len(name), stop, EXTREMES[name])
            case ast.keyword(arg="dim" | "axis", value=axis) if text(axis) in AXES:
                yield "axes", (*span(axis), AXES[text(axis)])
            case ast.Subscript(slice=ast.Tuple(elts=[first, *_, ast.Constant() as axis])):
                if text(axis) in AXES and (isinstance(first, ast.Slice) or text(first) == "..."):
                    yield "axes", (*span(axis), AXES[text(axis)])
            case ast.Attribute(attr="T" | "mT" as name) if not source.startswith(".", end):  # a pose's has more
                yield "axes", (end - len(name) - 1, end, "")

    def walk(node: Any, name: str, inside: bool, around: list[ast.AST]) -> Iterator[tuple[Fault, bytes]]:
        if isinstance(node, ast.Call) and MESSAGES.fullmatch(text(node.func)):
            return
        if isinstance(node, ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            name = f"{name}{'.<locals>' * inside}{'.' * bool(name)}{node.name}"
            inside = not isinstance(node, ast.ClassDef)
        if isinstance(node, ast.expr | ast.stmt):
            around = [*around, node] if isinstance(node, ast.expr) else []
        refuses = isinstance(node, ast.If) and isinstance(node.body[0], ast.Raise)
        for kind, (start, end, new) in changes(node) if inside and not refuses else ():
            # A statement of several lines is not known by its text, but by that of its condition.
            whole = [*reversed(around)] or [node if isinstance(node, ast.AugAssign) else node.test]
            first, last = span(next((outer for outer in whole if len(text(outer)) >= CONTEXT), whole[-1]))
            texts = source[first:last], source[first:start] + new + source[end:last]
            before, after = (" ".join(code.split()) for code in texts)
            fault = Fault(str(path.relative_to(root)), name, kind, before, after)
            changed = source[:start] + new + source[end:]
            yield replace(fault, nth=seen[fault]), changed.encode("latin-1")
            seen[fault] += 1
        for field, value in ast.iter_fields(node):
            if field not in SKIPPED_FIELDS and not (refuses and field == "test"):
                for child in value if isinstance(value, list) else [value]:
                    if isinstance(child, ast.AST) and not isinstance(child, SKIPPED):
                        yield from walk(child, name, inside, around)

    yield from walk(ast.parse(path.read_bytes()), "", False, [])


def draw(root: Path) -> list[Fault]:
    """Draw as many faults of each kind as of the others, and at most one of a file."""
    drawn: list[Fault] = []
    chance = random.Random(SEED)
    for count, packages in STRATA:
        pool: dict[str, list[Fault]] = defaultdict(list)
        for package in packages.split():
            for path in sorted(root.glob(f"bidnerf*/{package}/**/*.py")):
                for fault, _ in candidates(root, path):
                    pool[fault.kind].append(fault)
        kinds = chance.sample(sorted(pool), len(pool))
        for number in range(count):
            files = {fault.file for fault in drawn}
            of_kind = [fault for fault in pool[kinds[number % len(kinds)]] if fault.file not in files]
            drawn.append(chance.choice(of_kind))
    return drawn


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
        path.write_bytes(dict(candidates(self.copy, path))[fault])
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
    if not FAULTS.exists():
        drawn = [asdict(fault) for fault in draw(arguments.tests)]
        FAULTS.write_text(json.dumps(drawn, indent=1) + "\n")
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
        applies = {
            number: fault
            for number, fault in enumerate(faults)
            if (copy / fault.file).exists() and fault in dict(candidates(copy, copy / fault.file))
        }
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
