r"""Calibrate the confidence that method ``auto`` requires for a tolerated risk, and test it on other answers.

    python benchmarks/risk.py ROWS [...] [--write]

The risk is the share of wrong answers among the accepted ones. The rows should be those of ``benchmarks/answers.py`` on frames that
the confidence was not fitted to; answers that are accepted without a tolerated risk are the examples. For each risk, the least
confidence is sought whose upper confidence bound of the share of wrong answers (Clopper and Pearson 1934) is at most the risk.
The thresholds are tested in a fixed order, so that all tests together err with probability ``ERROR`` at most (Learn then Test,
Angelopoulos et al. 2021).

Tested on: the other half of the faults of each scene (each half calibrates once and is tested once), also by fault and by
quarters of difficulty, which is the number of inliers; halves drawn anew ``REPEATS`` times; and each scene with thresholds from
the others, which are not exchangeable with it. ``--write`` calibrates on all rows and stores the thresholds in the package.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from _lab import Row, parser, record, within
from answers import answers_of, judged_anew, read_rows
from confidence import STORED
from scipy.stats import beta

RISKS = (0.001, 0.005, 0.01, 0.02, 0.05, 0.1)
ERROR = 0.1
"""Probability, over draws of the examples, that the share of wrong answers at a threshold exceeds its risk."""
STARTS = (1, 2, 4, 8)
"""The sequences of tests begin with all examples, and with the most confident half, quarter and eighth of them."""
REPEATS = 100
Thresholds = dict[float, float]
"""The least confidence for each risk; infinite where none has been shown to suffice."""
Tested = list[tuple[Row, Thresholds]]
"""Answers, each with thresholds that it did not help to calibrate."""


def upper_bound(wrong: np.ndarray, count: np.ndarray, error: float) -> np.ndarray:
    """Return the upper bound, with confidence 1 - ``error``, of the probability of a wrong answer."""
    return np.where(wrong < count, beta.ppf(1 - error, wrong + 1, np.maximum(count - wrong, 1)), 1.0)


def least_confidence(confidences: Sequence[float], right: Sequence[bool], risk: float) -> float:
    """Return the least confidence above which at most a share ``risk`` of the answers is wrong; infinite if that is not shown.

    The answers are taken by falling confidence. Each sequence of tests takes in one more at a time until the bound exceeds the
    risk. Each may err with an equal part of ``ERROR``.
    """
    order = np.argsort(-np.asarray(confidences, dtype=float), kind="stable")
    count = np.arange(1, len(order) + 1)
    wrong = np.cumsum(~np.asarray(right, dtype=bool)[order])
    passed = upper_bound(wrong, count, ERROR / len(STARTS)) <= risk
    last = -1
    for part in STARTS:
        place = len(order) // part - 1
        while 0 <= place < len(order) and passed[place]:
            last = max(last, place)
            place += 1
    return float("inf") if last < 0 else float(confidences[order[last]])


def calibrate(rows: Sequence[Row]) -> Thresholds:
    """Return the least confidence for each of ``RISKS``; a larger risk never requires more."""
    said, right = [row["confidence"] for row in rows], [within(row) for row in rows]
    least = np.minimum.accumulate([least_confidence(said, right, risk) for risk in RISKS])
    return dict(zip(RISKS, least.tolist(), strict=True))


def examples(paths: Iterable[Path]) -> tuple[list[Row], int]:
    """Return each answer by landmarks once that the present bounds accept, and the number of the other accepted answers."""
    rows = {}
    for path in paths:
        for key, row in answers_of(read_rows(path)).items():
            names = dict(zip(("scene", "mode", "fault", "frame"), key, strict=True))
            rows[key] = judged_anew(row) | names | {"diagnostics": row.get("evidence")}
    accepted = [row for row in rows.values() if row["converged"]]
    known = [row for row in accepted if row["diagnostics"] is not None and row["confidence"] is not None]
    return known, len(accepted) - len(known)


def halves(rows: Sequence[Row], seed: int) -> tuple[list[Row], list[Row]]:
    """Return the rows in two parts: half of the faults of each scene, with RGB and RGB-D on their own, and the others."""
    random, first = np.random.default_rng(seed), set()
    for scene, mode in sorted({(row["scene"], row["mode"]) for row in rows}):
        faults = sorted({row["fault"] for row in rows if (row["scene"], row["mode"]) == (scene, mode)})
        count = (len(faults) + int(random.integers(2))) // 2
        first |= {(scene, mode, faults[place]) for place in random.permutation(len(faults))[:count]}
    parts: tuple[list[Row], list[Row]] = [], []
    for row in rows:
        parts[(row["scene"], row["mode"], row["fault"]) not in first].append(row)
    return parts


def apply_thresholds(calibration: Sequence[Row], test: Sequence[Row]) -> Tested:
    """Return the rows ``test`` with the thresholds of the rows ``calibration``."""
    thresholds = calibrate(calibration)
    return [(row, thresholds) for row in test]


def cross_calibrate(rows: Sequence[Row], seed: int = 0) -> Tested:
    """Return all rows, each with the thresholds of the half that it does not belong to."""
    one, other = halves(rows, seed)
    return apply_thresholds(one, other) + apply_thresholds(other, one)


def count_outcomes(answers: Tested) -> dict[str, Any]:
    """Return for each risk how many answers are accepted, how many of these are wrong, and how many right ones are lost."""
    right = sum(within(row) for row, _ in answers)
    found: dict[str, Any] = {"n": len(answers), "right": right}
    for risk in RISKS:
        kept = [within(row) for row, least in answers if row["confidence"] >= least[risk]]
        wrong = len(kept) - sum(kept)
        found[f"{risk:g}"] = {"accepted": len(kept), "wrong": wrong, "right_lost": right - sum(kept)}
    return found


def by(group: Callable[[Row], str], answers: Tested) -> dict[str, Any]:
    """Return what was realised in each group of answers."""
    names = sorted({group(row) for row, _ in answers})
    return {name: count_outcomes([pair for pair in answers if group(pair[0]) == name]) for name in names}


def by_quarter(answers: Tested) -> dict[str, Any]:
    """Return what was realised in each quarter of difficulty; answers without inliers are a group of their own."""
    inliers = [row["diagnostics"]["inliers"] for row, _ in answers if _has_inliers(row)]
    limits = np.quantile(inliers, (0.25, 0.5, 0.75)) if inliers else np.zeros(3)

    def quarter(row: Row) -> str:
        if not _has_inliers(row):
            return "no landmarks"
        place = int(np.searchsorted(limits, row["diagnostics"]["inliers"], side="right"))
        low, high = [0, *limits][place], [*limits, max(inliers)][place]
        return f"{place + 1}: {low:.0f} to {high:.0f} inliers"

    return by(quarter, answers)


def _has_inliers(row: Row) -> bool:
    return "inliers" in (row.get("diagnostics") or {})


def other_halves(rows: Sequence[Row], repeats: int = REPEATS) -> dict[str, Any]:
    """Return in how many halves, drawn anew each time, the share of wrong answers exceeds the risk, and its mean."""
    shares: dict[str, list[float]] = {f"{risk:g}": [] for risk in RISKS}
    for seed in range(repeats):
        one, other = halves(rows, seed)
        for found in (count_outcomes(apply_thresholds(one, other)), count_outcomes(apply_thresholds(other, one))):
            for risk, some in shares.items():
                some += [_share(found[risk])] if found[risk]["accepted"] else []
    return {
        risk: {
            "halves_with_a_threshold": len(some),
            "exceeded": sum(share > float(risk) for share in some),
            "mean_share": float(np.mean(some)) if some else None,
        }
        for risk, some in shares.items()
    }


def _share(cell: dict[str, int]) -> float:
    return cell["wrong"] / cell["accepted"] if cell["accepted"] else 0.0


def show(name: str, found: dict[str, Any]) -> None:
    """Print what was realised, the risks beside each other."""
    cells = (
        f"{cell['wrong']}/{cell['accepted']} (-{cell['right_lost']})" if cell["accepted"] else "-"
        for cell in (found[f"{risk:g}"] for risk in RISKS)
    )
    print(f"{name:48} n {found['n']:5}  " + "  ".join(f"{cell:>16}" for cell in cells))


def main() -> None:
    arguments = parser(__doc__, "risk")
    arguments.add_argument("rows", nargs="+", type=Path)
    arguments.add_argument("--write", action="store_true", help="store the thresholds in the package")
    given = arguments.parse_args()
    rows, without = examples(given.rows)
    answers = cross_calibrate(rows)
    scenes = sorted({row["scene"] for row in rows})
    held_out = {
        scene: count_outcomes(
            apply_thresholds([r for r in rows if r["scene"] != scene], [r for r in rows if r["scene"] == scene])
        )
        for scene in scenes
    }
    least = {f"{risk:g}": value for risk, value in calibrate(rows).items() if value < float("inf")}
    results = {
        "error": ERROR,
        "accepted_without_confidence": without,
        "least_confidence": least,
        "other_faults": count_outcomes(answers),
        "other_faults_by_scene": by(lambda row: row["scene"], answers),
        "other_faults_by_fault": by(lambda row: row["fault"], answers),
        "other_faults_by_quarter": by_quarter(answers),
        "scene_left_out": held_out,
        "other_halves": other_halves(rows),
    }
    print(f"{'wrong/accepted (right ones lost) at risk':57}" + "  ".join(f"{risk:>16g}" for risk in RISKS))
    show("other faults", results["other_faults"])
    for name in (
        "other_faults_by_scene",
        "other_faults_by_fault",
        "other_faults_by_quarter",
        "scene_left_out",
    ):
        for group, found in results[name].items():
            show(f"{name.replace('_', ' ')}: {group}", found)
    for risk, found in results["other_halves"].items():
        print(f"risk {risk}: {found}; least confidence {least.get(risk)}")
    written = record(given.name, results)
    if given.write:
        stored = json.loads(STORED.read_text())
        levels = [[float(risk), value] for risk, value in least.items()]
        stored["risk"] = {"source": written.name, "least_confidence": levels}
        STORED.write_text(json.dumps(stored, indent=1) + "\n")
        print(STORED)


if __name__ == "__main__":
    main()
