r"""Learn the confidence of method ``auto`` in poses by landmarks from answers to images with and without faults, and test it on others.

    python benchmarks/answers.py MAP [MAP ...] --out ROWS.jsonl
    python benchmarks/confidence.py ROWS [...] [--write]

Each row of ``benchmarks/answers.py`` with a pose by landmarks is an example, unless the query's mirror image ruled it out; it is
right within 5 degrees and 0.05 units. A logistic regression with a small ridge penalty is fitted. Its quality is measured by
leaving out one scene at a time: the model is fitted to the other scenes and tested on the one left out (expected calibration error in ten bins, wrong answers among the accepted, right
ones among the rejected). A harder test also leaves out one half of the faults, so that the model is tested on kinds of failure
that it was not fitted to. ``--write`` fits to all examples and stores the weights in the package.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import _lab
import numpy as np
from answers import answers_of, read_rows
from scipy.optimize import minimize
from scipy.special import expit

import bidnerf_core
from bidnerf_core.localization import (
    ACCEPTED,
    Evidence,
    LogisticModel,
    Outcome,
    features,
)

STORED = Path(bidnerf_core.__file__).parent / "localization" / "acceptance.json"
RIDGE = 0.005
"""Penalty of the squared weights of standardised features, relative to the mean log loss."""
GOOD = ("inliers", "above_chance", "recall", "spread", "mass", "on_surface", "colour_inliers")
BAD = ("noise_ratio", "precision", "replaced")
"""Features whose larger values can only raise (GOOD) or only lower (BAD) the confidence: examples are too few to show each."""
BINS = 10
WITHOUT_CONFIDENCE = (Outcome.MIRRORED, Outcome.AMBIGUOUS)
"""Outcomes of answers that a mirror image of the query rules out, however well they fit; they have no confidence."""
FEWEST = 30
"""Minimum number of right and of wrong examples from which a model is fitted."""


@dataclass(frozen=True)
class Example:
    """A row's features, whether its pose is right, and where it comes from."""

    features: dict[str, float]
    right: bool
    scene: str
    fault: str


def examples(paths: Sequence[Path]) -> list[Example]:
    """Read the rows of poses by landmarks that state a confidence. Answers to images of another scene are all wrong."""
    found = []
    for path in paths:
        for key, row in answers_of(read_rows(path)).items():
            if row.get("evidence") is not None and row["outcome"] not in WITHOUT_CONFIDENCE:
                found.append(example(key, row))
    return found


def example(key: Sequence[str], row: dict[str, Any]) -> Example:
    scene, _, condition, _ = key
    error = row["translation"]
    right = error is not None and error < 0.05 and row["rotation_deg"] < 5
    # Maps from halves of a scene's images are of one scene.
    return Example(features(Evidence(**row["evidence"])), right, scene.partition("@")[0], condition)


def fit_model(given: Sequence[Example], ridge: float = RIDGE) -> LogisticModel:
    """Fit a logistic regression whose weights have the right signs.

    Features are standardised for the ridge penalty; the weights returned are for the raw features.
    """
    names = tuple(given[0].features)
    x = np.array([[e.features[name] for name in names] for e in given])
    y = np.array([e.right for e in given], dtype=float)
    mean, deviation = x.mean(0), x.std(0) + 1e-3

    def loss(parameters: np.ndarray) -> tuple[float, np.ndarray]:
        odds = (x - mean) / deviation @ parameters[:-1] + parameters[-1]
        value = np.mean(np.logaddexp(0, odds) - y * odds) + ridge * np.sum(parameters[:-1] ** 2)
        off = (expit(odds) - y) / len(y)
        slope = np.append((x - mean).T / deviation[:, None] @ off + 2 * ridge * parameters[:-1], off.sum())
        return float(value), slope

    bounds = [(0, None) if name in GOOD else (None, 0) if name in BAD else (None, None) for name in names]
    start = np.zeros(len(names) + 1)
    best = minimize(loss, start, jac=True, method="L-BFGS-B", bounds=[*bounds, (None, None)]).x
    weights = best[:-1] / deviation
    return LogisticModel(dict(zip(names, weights.tolist(), strict=True)), float(best[-1] - weights @ mean))


def folds(given: Sequence[Example], by_fault: bool) -> list[tuple[list[Example], list[Example]]]:
    """Return pairs (fit, test) of examples from different scenes and, with ``by_fault``, different halves of the faults."""
    faults = sorted({e.fault for e in given})
    halves = [(set(faults[::2]), set(faults[1::2])), (set(faults[1::2]), set(faults[::2]))]
    pairs = []
    for scene in sorted({e.scene for e in given}):
        for tested, fitted in halves if by_fault else [(set(faults), set(faults))]:
            test = [e for e in given if e.scene == scene and e.fault in tested]
            fit = [e for e in given if e.scene != scene and e.fault in fitted]
            if test and len({e.right for e in fit}) == 2:
                pairs.append((fit, test))
    return pairs


def assess(said: Sequence[float], right: Sequence[bool]) -> dict[str, Any]:
    """Return the reliability diagram and the counts at the threshold of acceptance."""
    p, y = np.array(said), np.array(right)
    number = np.minimum((p * BINS).astype(int), BINS - 1)
    diagram = [
        {"n": int(m.sum()), "said": float(p[m].mean()), "right": float(y[m].mean())}
        for i in range(BINS)
        if (m := number == i).any()
    ]
    accepted = p >= ACCEPTED
    return {
        "n": len(p),
        "right": int(y.sum()),
        "accepted": int(accepted.sum()),
        "accepted_but_wrong": int((accepted & ~y).sum()),
        "right_but_rejected": int((~accepted & y).sum()),
        "expected_calibration_error": sum(b["n"] * abs(b["said"] - b["right"]) for b in diagram) / len(p),
        "log_loss": float(-np.mean(np.log(np.clip(np.where(y, p, 1 - p), 1e-9, 1)))),
        "reliability": diagram,
    }


def cross_validate(given: Sequence[Example], by_fault: bool) -> dict[str, Any]:
    """Fit and test on every fold, and pool the answers, overall and by scene."""
    said, right, scenes = [], [], []
    for fit, test in folds(given, by_fault):
        model = fit_model(fit)
        said += [model.probability(e.features) for e in test]
        right += [e.right for e in test]
        scenes += [e.scene for e in test]
    by_scene = {
        scene: assess(
            [p for p, s in zip(said, scenes, strict=True) if s == scene],
            [y for y, s in zip(right, scenes, strict=True) if s == scene],
        )
        for scene in sorted(set(scenes))
    }
    return {"all": assess(said, right), "by_scene": by_scene}


def line(s: dict[str, Any]) -> str:
    """Return the counts in one line."""
    return (
        f"n {s['n']}, right {s['right']}, accepted {s['accepted']}, of these wrong {s['accepted_but_wrong']}, right but"
        f" rejected {s['right_but_rejected']}, calibration error {s['expected_calibration_error']:.3f}"
    )


def main() -> None:
    parser = _lab.parser(__doc__, "confidence")
    parser.add_argument("rows", nargs="+", type=Path)
    parser.add_argument("--write", action="store_true", help="store the weights in the package")
    given = parser.parse_args()
    everything = examples(given.rows)
    if min(sum(e.right for e in everything), sum(not e.right for e in everything)) < FEWEST:
        raise SystemExit(f"{len(everything)} examples, expected {FEWEST} right and {FEWEST} wrong ones")
    model = fit_model(everything)
    results = {
        "other scenes": cross_validate(everything, by_fault=False),
        "other scenes and faults": cross_validate(everything, by_fault=True),
        "the examples themselves": assess(
            [model.probability(e.features) for e in everything], [e.right for e in everything]
        ),
    }
    for name, found in results.items():
        print(f"tested on {name}: {line(found.get('all', found))}")
    for name, weight in model.weights.items():
        print(f"  {name:22} {weight:+.2f}")
    record = _lab.record(given.name, {"examples": len(everything), "held_out": {"landmarks": results}})
    if given.write:
        stored = json.loads(STORED.read_text()) | {"source": record.name, "landmarks": vars(model)}
        text = json.dumps(stored, indent=1)
        STORED.write_text(text + "\n")
        print(STORED)


if __name__ == "__main__":
    main()
