"""Compare an evaluation that is killed and resumed at random moments with an undisturbed one, and with one on two dask workers.

    python benchmarks/evaluate_killed.py [--kills 10] [--trials 40] [--name evaluate_killed]

All run on a closed-form scene through the command line. The three files must be equal except for the time and memory in each
line: no trial may be missing, and none may occur twice.
"""

from __future__ import annotations

import argparse
import json
import random
import signal
import subprocess
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from distributed import LocalCluster

from bidnerf_core.evaluation.provenance import write_record

RESULTS = Path(__file__).parent / "results"
SCENE = "demo:blobs"
MAIN = "import sys; from bidnerf_core.cli import main; sys.exit(main())"
VARIES = ("seconds", "peak_memory_bytes")
LONGEST = 15.0
"""The longest time (s) before a process is killed; it needs some five seconds before its first trial."""


def command(out: Path, trials: int, *more: str) -> list[str]:
    words = ["--protocol", "bid", "--size", "0.3", "--trials", str(trials), "--method", "bid"]
    words += ["--rays", "256", "--max-steps", "40", "--seed", "0"]
    return [sys.executable, "-c", MAIN, "evaluate", SCENE, "--out", str(out), *words, *more]


def undisturbed(out: Path, trials: int, *more: str) -> None:
    subprocess.run(command(out, trials, "--workers", "1", *more), check=True, capture_output=True)


def killed(out: Path, trials: int, kills: int, chance: random.Random) -> list[int]:
    """Kill and resume an evaluation, then run it to the end; return the number of lines after each kill."""
    known = []
    while len(known) < kills:
        process = subprocess.Popen(
            command(out, trials, "--workers", "1"), stderr=subprocess.DEVNULL, start_new_session=True
        )
        time.sleep(chance.uniform(0, LONGEST))
        if process.poll() is not None:
            raise SystemExit("it came to its end before it was killed often enough: give more --trials")
        process.send_signal(signal.SIGKILL)
        process.wait()
        known.append(len(lines(out)))
        print(f"killed {len(known)} times, {known[-1]} of {trials} trials are kept", flush=True)
    undisturbed(out, trials)
    return known


def on_dask(out: Path, trials: int) -> None:
    with LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None, silence_logs=50) as cluster:
        words = command(out, trials, "--dask", cluster.scheduler_address)
        subprocess.run(words, check=True, capture_output=True)


def lines(path: Path) -> list[dict[str, Any]]:
    """Return the results in complete lines, without what varies from run to run."""
    whole = path.read_text().split("\n")[:-1] if path.exists() else []
    found = [json.loads(line) for line in whole]
    return [{name: value for name, value in line.items() if name not in VARIES} for line in found]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--kills", type=int, default=10)
    parser.add_argument("--trials", type=int, default=40)
    parser.add_argument("--seed", type=int, default=0, help="of the moments")
    parser.add_argument("--name", default="evaluate_killed")
    given = parser.parse_args()
    with TemporaryDirectory() as folder:
        alone, resumed, together = (
            Path(folder) / f"{name}.jsonl" for name in ("alone", "resumed", "together")
        )
        undisturbed(alone, given.trials)
        kept = killed(resumed, given.trials, given.kills, random.Random(given.seed))
        on_dask(together, given.trials)
        results = {
            "trials": given.trials,
            "kept after each kill": kept,
            "resumed equals undisturbed": lines(resumed) == lines(alone),
            "two dask workers equal one process": lines(together) == lines(alone),
        }
    print(write_record(RESULTS / f"{given.name}.json", results, given.seed))
    print(json.dumps(results, indent=1))


if __name__ == "__main__":
    main()
