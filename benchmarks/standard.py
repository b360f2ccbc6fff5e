r"""The standard benchmarks of visual localization: 7-Scenes, 12-Scenes and Cambridge Landmarks, as published.

    python benchmarks/standard.py SCENE [SCENE ...] --maps FOLDER [--sfm pgt/sfm] [--every 5] [--queries 200]

SCENE is the folder of one scene as its authors publish it; nobody redistributes these data, so whoever runs this fetches them:

- 7-Scenes (https://www.microsoft.com/en-us/research/project/rgb-d-dataset-7-scenes), such as ``chess`` with ``seq-01`` ...
- 12-Scenes (https://graphics.stanford.edu/projects/reloc), such as ``apt1/kitchen`` with ``info.txt`` and ``data``;
- Cambridge Landmarks (https://www.repository.cam.ac.uk/handle/1810/251342), such as ``KingsCollege`` with
  ``dataset_train.txt``, ``dataset_test.txt`` and ``reconstruction.nvm``.

The first two have two ground truths: the poses in their folders, tracked with depth ("dslam"), and those of structure from motion
("sfm"; Brachmann et al. 2021, "On the Limits of Pseudo Ground Truth in Visual Camera Re-Localization"), which ``--sfm`` takes from
the folder ``pgt/sfm`` of https://github.com/tsattler/visloc_pseudo_gt_limitations. A map is trained for each, on the training split
alone, and stored in ``--maps``, from which an interrupted run resumes. Queries are the test split, without a start, without depth
and, where there is any, with it.

Printed, and written as a record: the median errors, the shares within 5 cm and 5 degrees and within 2 cm and 2 degrees, as papers
report them over all queries, refused ones included; and what papers do not report: how many answers are accepted, how many of these
are wrong, and in how many of them the true pose lies inside the 95 % bound of the covariance. Wrong is beyond 5 cm or 5 degrees
indoors, and beyond 50 cm or 5 degrees in Cambridge, whose scenes are a hundred metres long.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from _lab import (
    BOUND,
    RESULTS,
    Row,
    RowStore,
    answer,
    cpu_seconds,
    median_errors,
    modes,
    one_thread,
    parser,
    record,
    within,
)

from bidnerf import SE3, Intrinsics, Localizer, load_map
from bidnerf.evaluation import views_digest
from bidnerf_core.datasets import Capture, Shot, open_dataset
from bidnerf_core.errors import InputError
from bidnerf_core.io import read_header, read_lines
from bidnerf_core.maps import train

SHARES = {"5 cm, 5 deg": (0.05, 5.0), "2 cm, 2 deg": (0.02, 2.0)}
RIGHT = {"7-Scenes": (0.05, 5.0), "12-Scenes": (0.05, 5.0), "Cambridge": (0.5, 5.0)}
"""Errors (metres, degrees) from which an answer is wrong, by benchmark."""


def benchmark_of(folder: Path) -> str:
    """Return which benchmark a scene belongs to. Raises ``InputError`` for a folder of another layout."""
    if (folder / "dataset_train.txt").is_file():
        return "Cambridge"
    if any((folder / name).is_file() for name in ("info.txt", "_info.txt")):
        return "12-Scenes"
    if (folder / "TrainSplit.txt").is_file():
        return "7-Scenes"
    raise InputError(
        "has no dataset_train.txt, info.txt or TrainSplit.txt",
        where=folder,
        expected="a scene of Cambridge Landmarks, 12-Scenes or 7-Scenes as published",
    )


def cambridge(folder: Path) -> Capture:
    """Read a scene of Cambridge Landmarks: poses of ``dataset_train.txt`` and ``dataset_test.txt``, focal lengths of the NVM file.

    A row is ``image X Y Z W P Q R``: the centre of the camera, and the rotation from world to camera. Radial distortion is
    ignored, as is usual.
    """
    focal, shots = dict[str, float](), list[Shot]()
    for row in read_lines(folder / "reconstruction.nvm", "VisualSFM's model", "image and camera", 2**30):
        words = row.text.split()
        if len(words) == 11 and "/" in words[0]:  # names end with .jpg there, and with .png on disk
            focal[str(Path(words[0]).with_suffix(""))] = float(words[1])
    for split in ("train", "test"):
        for row in read_lines(folder / f"dataset_{split}.txt", "a list of images", "image X Y Z W P Q R"):
            name, *words = row.text.split() or [""]
            if len(words) != 7 or not (folder / name).is_file():
                continue
            x, y, z, *quaternion = row.plain_numbers(words)
            turn = SE3.from_quaternion(torch.tensor(quaternion).double(), torch.zeros(3).double(), "wxyz")
            centre = torch.tensor([x, y, z], dtype=torch.float64)
            header, f = read_header(folder / name), focal[str(Path(name).with_suffix(""))]
            camera = Intrinsics(f, f, header.width / 2, header.height / 2, header.width, header.height)
            T = SE3(turn.rotation.mT, centre)
            shots.append(Shot(image=folder / name, camera=camera, T_world_camera=T, splits=(split,)))
    return Capture(folder, shots, unit="metres", poses_expected="rows of dataset_train.txt").require_poses()


def with_poses(scene: Capture, folder: Path, name: str) -> Capture:
    """Return a scene with the poses and focal lengths of structure from motion; images without one are left out.

    A row of ``folder/NAME_train.txt`` is ``image qw qx qy qz tx ty tz f``, from world to camera.
    """
    shots = {shot.file.relative_to(scene.path).as_posix(): shot for shot in scene.shots if shot.file}
    found = list[Shot]()
    for split in ("train", "test"):
        for row in read_lines(folder / f"{name}_{split}.txt", "poses", "image qw qx qy qz tx ty tz f"):
            image, *words = row.text.split() or [""]
            if image not in shots:
                continue
            *pose, f = row.plain_numbers(words)
            q, t = torch.tensor(pose).double().split([4, 3])
            header = read_header(scene.path / image)
            camera = Intrinsics(f, f, header.width / 2, header.height / 2, header.width, header.height)
            T = SE3.from_quaternion(q, t, "wxyz").inverse()
            found.append(replace(shots[image], camera=camera, T_world_camera=T, splits=(split,), name=""))
    return replace(scene, shots=found)


def ground_truths(folder: Path, sfm: Path | None) -> dict[str, Capture]:
    """Return a scene with each of its ground truths."""
    benchmark = benchmark_of(folder)
    if benchmark == "Cambridge":
        return {"sfm": cambridge(folder)}
    scene = open_dataset(folder)
    found = {"dslam": scene}
    if sfm is not None:
        name = folder.name if benchmark == "7-Scenes" else f"{folder.parent.name}_{folder.name}"
        found["sfm"] = with_poses(scene, sfm / benchmark.lower().replace("-", ""), name)
    return found


def spread(scene: Capture, split: str, every: int = 1, most: int | None = None) -> Capture:
    """Return every k-th image of a split, or ``most`` evenly spaced ones."""
    shots = [shot for shot in scene.shots if split in shot.splits][::every]
    count = min(most or len(shots), len(shots))
    return replace(scene, shots=[shots[place * len(shots) // count] for place in range(count)])


def summary(rows: Sequence[Row], right: tuple[float, float]) -> dict[str, Any]:
    """Return the medians, shares and counts of some answers."""
    accepted = [row for row in rows if row["converged"]]
    squared = [row["normalized_error_squared"] for row in accepted]
    return {
        "n": len(rows),
        **median_errors(rows),
        **{name: sum(within(row, limits) for row in rows) / len(rows) for name, limits in SHARES.items()},
        "accepted": len(accepted),
        "wrong_of_accepted": sum(not within(row, right) for row in accepted),
        "inside_95_of_accepted": sum(value is not None and value <= BOUND for value in squared),
        **cpu_seconds(rows),
    }


def main() -> None:
    arguments = parser(__doc__, "standard")
    arguments.add_argument("scenes", nargs="+", type=Path, metavar="SCENE")
    arguments.add_argument("--maps", type=Path, required=True, help="folder in which maps are stored")
    arguments.add_argument("--sfm", type=Path, help="pgt/sfm, the ground truth of structure from motion")
    arguments.add_argument(
        "--every", type=int, default=1, help="train on every K-th image (default: each)", metavar="K"
    )
    arguments.add_argument("--queries", type=int, help="evenly spaced test images (default: all)")
    arguments.add_argument("--steps", type=int, help="of training (default: the backend's)")
    given = arguments.parse_args()
    one_thread()
    config, results = None if given.steps is None else {"steps": given.steps}, dict[str, Any]()
    with RowStore(RESULTS / f"{given.name}.rows.jsonl") as store:
        for folder in given.scenes:
            right = RIGHT[benchmark_of(folder)]
            for truth, scene in ground_truths(folder, given.sfm).items():
                name = f"{folder.name}, {truth}"
                place = given.maps / f"{folder.parent.name}_{folder.name}_{truth}"
                if not place.exists():
                    unfinished = place.with_name(f"{place.name}.partial")
                    train(spread(scene, "train", given.every), out=unfinished, config=config)
                    unfinished.rename(place)
                found = load_map(place)
                localizer, rows = Localizer(found), dict[str, list[Row]]()
                queries = spread(scene, "test", most=given.queries)
                for view in (queries.view(shot) for shot in queries.shots):
                    for mode, (one,) in modes([view]).items():
                        key = [name, mode, found.info.weights, view.frame.name, views_digest([one])]
                        ask = partial(answer, partial(localizer, one.frame), one)
                        rows.setdefault(mode, []).append(store.get(key, ask))
                results[name] = {mode: summary(some, right) for mode, some in rows.items()}
                for mode, one in results[name].items():
                    print(f"{name:28} {mode:6} {line(one)}", flush=True)
    record(given.name, results)


def line(found: dict[str, Any]) -> str:
    """Return a summary as a line of a table."""
    metres, degrees = (found[f"median_{part}"] for part in ("translation", "rotation_deg"))
    middle = "no median" if metres is None else f"{100 * metres:.1f} cm, {degrees:.2f} deg"
    shares = "  ".join(f"{name}: {100 * found[name]:.1f} %" for name in SHARES)
    return (
        f"n {found['n']}  {middle}  {shares}  accepted {found['accepted']}, wrong {found['wrong_of_accepted']},"
        f" inside 95 %: {found['inside_95_of_accepted']}  {found['median_cpu_seconds']:.2f} s"
    )


if __name__ == "__main__":
    main()
