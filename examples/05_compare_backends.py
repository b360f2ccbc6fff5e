"""Compare all installed backends on one scene, from the same starts: success, steps, time, memory, as a table and a picture.

    python examples/05_compare_backends.py [--out compare-out] [--steps 600] [--trials 4]
    python examples/05_compare_backends.py --data DATA --maps MAP MAP ...

Without maps, each backend is trained briefly on a scene in closed form, which is written to --out as a dataset.
`bidnerf compare` makes the same comparison for maps that you have.
"""

import argparse
import sys
from pathlib import Path

from bidnerf_core import Intrinsics, list_plugins
from bidnerf_core.cli import main
from bidnerf_core.datasets import write_transforms
from bidnerf_core.scenes.demo import demo_object, orbit, views

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("--out", type=Path, default=Path("compare-out"))
parser.add_argument("--maps", type=Path, nargs="+", default=[])
parser.add_argument("--data", type=Path, help="dataset of what the maps show")
parser.add_argument("--steps", type=int, default=600, help="of each training")
parser.add_argument("--descent", type=int, default=120, help="steps of the localizer")
parser.add_argument("--trials", type=int, default=4, help="starts")
given = parser.parse_args()
if given.maps and given.data is None:
    parser.error("--maps needs --data, a dataset of what they show")


def bidnerf(*words: object) -> None:
    """Run one command of the command line."""
    status = main([str(word) for word in words])
    if status:
        sys.exit(status)


def trained() -> list[Path]:
    """Return a map of each backend that is installed and not broken."""
    scene, camera = demo_object(), Intrinsics(fx=90.0, fy=90.0, cx=32.0, cy=32.0, width=64, height=64)
    seen, unseen = orbit(radius=3.5, count=40), orbit(radius=3.5, count=8, elevation=(15, 50), seed=1)
    splits = {"train": views(scene, camera, seen), "test": views(scene, camera, unseen)}
    write_transforms(given.data, splits, scene.bounds.background)
    maps = []
    for info in list_plugins("backends"):
        if info.fault is None:
            maps.append(given.out / info.name)
            options = ["--steps", given.steps, "--overwrite"]
            bidnerf("train", given.data, "--backend", info.name, "--out", maps[-1], *options)
    return maps


given.data = given.data or given.out / "scene"
maps = given.maps or trained()
descent = ["--rays", 512, "--max-steps", given.descent, "--size", 0.5, "--trials", given.trials]
bidnerf("compare", *maps, given.data, "--out", given.out / "comparison", "--overwrite", *descent)
