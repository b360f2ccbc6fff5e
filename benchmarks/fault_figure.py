r"""Draw the records of ``benchmarks/faults.py``: right, converged and silent answers under each fault, over all scenes.

python benchmarks/fault_figure.py benchmarks/results/faults_rgb.json benchmarks/results/faults_rgbd.json --out docs/faults.png
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import _lab
import numpy as np

from bidnerf.results import COLOURS, common_style, new_figure, success_rate

DRAWN = {
    "right": ("right", COLOURS[2]),
    "converged": ("converged", COLOURS[0]),
    "converged, but wrong": ("silent", COLOURS[1]),
}
"""The shares to draw: each a label, the count in the record, and a colour."""
ROW, WIDTH = 0.26, 5.2
"""Height of a fault's row and width of a panel, inches."""


def pool_counts(paths: Sequence[Path]) -> dict[str, dict[str, dict[str, int]]]:
    """Return the counts by mode and fault, summed over the scenes of all records."""
    found: dict[str, dict[str, dict[str, int]]] = {}
    for path in paths:
        for modes in json.loads(path.read_text())["results"]["cells"].values():
            for mode, cells in modes.items():
                for fault, cell in cells.items():
                    counts = found.setdefault(mode, {}).setdefault(fault, {})
                    for name in ("n", *(name for name, _ in DRAWN.values())):
                        counts[name] = counts.get(name, 0) + cell[name]
    return found


def draw_panel(panel: Any, mode: str, cells: dict[str, dict[str, int]]) -> None:
    """Draw one mode: a row for each fault, with Wilson's 95 % intervals."""
    places = np.arange(len(cells))
    for turn, (label, (name, colour)) in enumerate(DRAWN.items()):
        rates = [success_rate(cell[name], cell["n"]) for cell in cells.values()]
        middle = np.array([rate.rate for rate in rates])
        spread = 100 * np.abs(np.array([[r.low for r in rates], [r.high for r in rates]]) - middle)
        panel.errorbar(
            100 * middle,
            places + 0.18 * (turn - 1),
            xerr=spread,
            fmt="o",
            color=colour,
            label=label,
            markersize=4,
            elinewidth=1,
        )
    panel.set_yticks(places, [f"{fault}  (n={cell['n']})" for fault, cell in cells.items()])
    panel.set(xlabel="answers (%)", xlim=(-3, 103), ylim=(len(cells) - 0.5, -0.5), title=mode)
    panel.grid(axis="x")


def main() -> None:
    parser = _lab.parser(__doc__, named=False)
    parser.add_argument("records", nargs="+", type=Path)
    parser.add_argument("--out", type=Path, required=True, help="of the figure, a PNG")
    given = parser.parse_args()
    modes = pool_counts(given.records)
    rows = max(len(cells) for cells in modes.values())
    with common_style():
        figure = new_figure(len(modes) * WIDTH, rows * ROW * 1.6 + 1.1)
        axes = figure.subplots(1, len(modes), squeeze=False).flatten()
        for panel, (mode, cells) in zip(axes, modes.items(), strict=True):
            draw_panel(panel, mode, cells)
        handles, names = axes[0].get_legend_handles_labels()
        figure.legend(handles, names, loc="outside lower center", ncols=len(DRAWN))
        figure.savefig(given.out)
    print(given.out)


if __name__ == "__main__":
    main()
