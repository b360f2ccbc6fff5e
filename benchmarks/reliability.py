r"""The reliability of method ``auto``'s confidence: how often answers are right, as a diagram, and its calibration error.

    python benchmarks/reliability.py benchmarks/results/answers_new.rows.jsonl.xz ... --out docs/reliability.png

Takes the rows of ``benchmarks/answers.py`` on frames that the confidence was not fitted to. Answers without a confidence are
counted and left out. Answers within 5 degrees and 0.05 units of the truth are right; a second criterion is whether the truth
lies inside the 95 % bound of the answer's own covariance. The error is the expected calibration error in ten bins, overall and
by scene.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from _lab import BOUND, parser, record, within
from answers import answers_of, read_rows
from confidence import assess

from bidnerf.results import COLOURS, common_style, new_figure

CRITERIA = {
    "right": lambda row: within(row),
    "inside its 95 % bound": lambda row: (row["normalized_error_squared"] or float("inf")) <= BOUND,
}


def rows_of(path: Path) -> list[dict[str, Any]]:
    return [row | {"scene": key[0].partition("@")[0]} for key, row in answers_of(read_rows(path)).items()]


def reliability(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return, for both criteria, the diagram and counts over all rows and for each scene."""
    stated = [row for row in rows if row["confidence"] is not None]
    found: dict[str, Any] = {"without a confidence": len(rows) - len(stated)}
    for name, met in CRITERIA.items():
        scenes = {scene: [r for r in stated if r["scene"] == scene] for scene in {r["scene"] for r in stated}}
        found[name] = {
            scene: assess([r["confidence"] for r in some], [met(r) for r in some])
            for scene, some in {"all": stated, **dict(sorted(scenes.items()))}.items()
        }
    return found


def draw(panel: Any, name: str, found: dict[str, Any]) -> None:
    """Draw the share of answers that meet each criterion by stated confidence, with the size of each bin."""
    panel.plot([0, 1], [0, 1], color="0.6", linewidth=1)
    for (label, curves), colour in zip(((n, found[n]) for n in CRITERIA), COLOURS, strict=False):
        bins = curves["all"]["reliability"]
        error = curves["all"]["expected_calibration_error"]
        panel.plot(
            [b["said"] for b in bins],
            [b["right"] for b in bins],
            "o-",
            color=colour,
            label=f"{label}: error {error:.3f}",
            markersize=4,
        )
    for b in found["right"]["all"]["reliability"]:
        panel.annotate(str(b["n"]), (b["said"], -0.01), ha="center", va="top", fontsize=7, color="0.4")
    panel.set(xlabel="stated confidence", ylabel="share of answers", title=name, xlim=(0, 1), ylim=(-0.07, 1.03))
    panel.legend(loc="lower right", bbox_to_anchor=(1.0, 0.08))


def main() -> None:
    arguments = parser(__doc__, "reliability")
    arguments.add_argument("rows", nargs="+", type=Path)
    arguments.add_argument("--out", type=Path, required=True, help="of the figure, a PNG")
    given = arguments.parse_args()
    results = {path.name.split(".")[0]: reliability(rows_of(path)) for path in given.rows}
    with common_style():
        figure = new_figure(4.6 * len(results), 4.0)
        axes = figure.subplots(1, len(results), squeeze=False).flatten()
        for panel, (name, found) in zip(axes, results.items(), strict=True):
            draw(panel, name, found)
        figure.savefig(given.out)
    for name, found in results.items():
        for criterion in CRITERIA:
            errors = {s: round(a["expected_calibration_error"], 3) for s, a in found[criterion].items()}
            print(name, criterion, errors)
    record(given.name, results)


if __name__ == "__main__":
    main()
