"""The memory and time that captures of many large photos take.

    python benchmarks/capture_size.py --work DIR [--photos 20 100 1000] [--steps 200]

Photos of twelve megapixels are drawn of a textured room, as JPEG files with a ``transforms.json``, into DIR; then ``bidnerf train``
(which bakes as well), ``localize`` and ``bake`` run, each as a process of its own. Its resident memory is read every 50 ms: ``resident``
includes the pages of mapped files, which the system may drop, ``anonymous`` does not. Photos and measurements that exist
already are not made again, so that an interrupted run goes on.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from _lab import RESULTS, parser, record

SIZE = (4032, 3024)
FOCAL = 3000.0  # pixels at that size
DRAWN = 4  # photos are drawn at SIZE / DRAWN, and enlarged
ROOM = (5.0, 4.0, 3.0)  # metres
WALLS = (  # corner, and the two edges from it
    ((0, 0, 0), (1, 0, 0), (0, 0, 1)),
    ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    ((1, 1, 0), (-1, 0, 0), (0, 0, 1)),
    ((0, 1, 0), (0, -1, 0), (0, 0, 1)),
    ((0, 0, 0), (1, 0, 0), (0, 1, 0)),
    ((0, 0, 1), (1, 0, 0), (0, 1, 0)),
)
TEXELS = 2048


def main() -> None:
    args = arguments()
    folder = args.work / "photos"
    textures = [texture(number) for number in range(len(WALLS))]
    for number in range(max(args.photos) + 1):
        draw(folder / f"{number:04d}.jpg", number, textures)
    rows = {tuple(row["key"]): row for row in stored(args.rows)}
    for command in ("train", "localize", "bake"):
        for count in args.photos:
            key = (count, command)
            if key not in rows:
                data = dataset(args.work, folder, count)
                row = measured(arguments_of(command, args, data, args.work / f"map_{count}"), args.work)
                rows[key] = {"key": list(key), **row}
                with args.rows.open("a", encoding="utf-8") as file:
                    file.write(json.dumps(rows[key]) + "\n")
            print(*key, rows[key], flush=True)
            table = {
                f"{command} {count}": {k: v for k, v in row.items() if k != "key"}
                for (count, command), row in sorted(rows.items())
            }
            record(args.name, {"size": list(SIZE), "steps": args.steps, "measurements": table})


def arguments_of(command: str, args: argparse.Namespace, data: Path, place: Path) -> list[str]:
    """Return the arguments of a command of bidnerf: ``train`` bakes the map as well, ``bake`` does it anew."""
    if command == "train":
        return ["train", str(data), "--out", str(place), "--overwrite", "--steps", str(args.steps)]
    if command == "bake":
        return ["bake", str(place), "--data", str(data)]
    photo = data.parent / "photos" / f"{max(args.photos):04d}.jpg"
    return ["localize", str(place), str(photo), "--focal", str(FOCAL)]


def arguments() -> argparse.Namespace:
    found = parser(__doc__, "capture_size")
    found.add_argument("--work", type=Path, required=True, help="folder for photos and maps: 3 MB a photo")
    found.add_argument("--photos", type=int, nargs="+", default=[20, 100, 1000])
    found.add_argument("--steps", type=int, default=200, help="of training")
    args = found.parse_args()
    args.rows = RESULTS / f"{args.name}.rows.jsonl"
    return args


def stored(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def texture(seed: int) -> np.ndarray:
    """Return colours with detail of every size, which keypoint detectors like."""
    generator, whole = np.random.default_rng(seed), np.zeros((TEXELS, TEXELS, 3), np.float32)
    for side in (8, 32, 128, 512, TEXELS):
        noise = generator.normal(size=(side, side, 3)).astype(np.float32)
        whole += cv2.resize(noise, (TEXELS, TEXELS), interpolation=cv2.INTER_CUBIC) * side**-0.25
    low, high = np.quantile(whole, [0.01, 0.99])
    return (np.clip((whole - low) / (high - low), 0, 1) * 255).astype(np.uint8)


def pose(number: int) -> np.ndarray:
    """Return T_world_camera (OpenCV axes) of a photo: walks through the room, looking around."""
    step = 0.618 * number
    x, y = 2.5 + 1.2 * math.cos(step * 0.37), 2.0 + 0.9 * math.sin(step * 0.53)
    centre = np.array([x, y, 1.5 + 0.4 * math.sin(step * 0.29)])
    angle, tilt = step * 0.21, 0.25 * math.sin(step * 0.17)
    forward = np.array([math.cos(angle) * math.cos(tilt), math.sin(angle) * math.cos(tilt), math.sin(tilt)])
    right = np.array([math.sin(angle), -math.cos(angle), 0.0])
    T = np.eye(4)
    T[:3] = np.stack([right, np.cross(forward, right), forward, centre], axis=1)
    return T


def draw(path: Path, number: int, textures: Sequence[np.ndarray]) -> None:
    """Write a photo, unless it exists."""
    if path.exists():
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    width, height = SIZE[0] // DRAWN, SIZE[1] // DRAWN
    K = np.array([[FOCAL / DRAWN, 0, width / 2], [0, FOCAL / DRAWN, height / 2], [0, 0, 1]])
    T, room = np.linalg.inv(pose(number)), np.array(ROOM)
    image, nearest = np.zeros((height, width, 3), np.uint8), np.full((height, width), np.inf)
    v, u = np.mgrid[:height, :width] + 0.5
    rays = np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(K).T
    for (corner, first, second), colours in zip(WALLS, textures, strict=True):
        edges = [T[:3, :3] @ (np.array(edge) * room) for edge in (first, second)]
        origin = T[:3, :3] @ (np.array(corner) * room) + T[:3, 3]
        # It maps a point of the plane to (a, b, -1) up to scale.
        plane = np.linalg.inv(np.stack([*edges, -origin], axis=1))
        solved = rays @ plane.T
        depth = -1 / np.minimum(solved[..., 2], -1e-9)  # z at which the ray meets the plane
        a, b = solved[..., 0] * depth, solved[..., 1] * depth
        shown = (a >= 0) & (a <= 1) & (b >= 0) & (b <= 1) & (solved[..., 2] < 0) & (depth < nearest)
        place = [(c * TEXELS).astype(np.float32) for c in (a, b)]
        seen = cv2.remap(colours, *place, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        image[shown], nearest[shown] = seen[shown], depth[shown]
    photo = cv2.resize(image, SIZE, interpolation=cv2.INTER_LINEAR)
    part = path.with_suffix(".part.jpg")
    cv2.imwrite(str(part), photo, [cv2.IMWRITE_JPEG_QUALITY, 90])
    part.replace(path)


def dataset(work: Path, photos: Path, count: int) -> Path:
    """Return a folder whose ``transforms.json`` lists the first photos, all of them for training."""
    folder = work / f"data_{count}"
    folder.mkdir(exist_ok=True)
    names = [os.path.relpath(photos / f"{number:04d}.jpg", folder) for number in range(count)]
    flip = np.diag([1.0, -1.0, -1.0, 1.0])
    frames = [{"file_path": name, "transform_matrix": (pose(n) @ flip).tolist()} for n, name in enumerate(names)]
    content = {
        "fl_x": FOCAL,
        "fl_y": FOCAL,
        "cx": SIZE[0] / 2,
        "cy": SIZE[1] / 2,
        "w": SIZE[0],
        "h": SIZE[1],
        "train_filenames": names,
        "frames": frames,
    }
    (folder / "transforms.json").write_text(json.dumps(content), encoding="utf-8")
    return folder


def measured(command: Sequence[str], work: Path) -> dict[str, Any]:
    """Run a command of bidnerf, and return its time and the peaks of its memory in MB."""
    began, peaks = time.perf_counter(), {"RssAnon": 0, "VmHWM": 0}
    program = [
        sys.executable,
        "-c",
        "import sys; from bidnerf.cli import main; sys.exit(main(sys.argv[1:]))",
    ]
    with (work / "output.txt").open("w") as output:
        child = subprocess.Popen([*program, *command], stdout=output, stderr=output)
        while child.poll() is None:
            for key in peaks:
                peaks[key] = max(peaks[key], status(child.pid, key))
            time.sleep(0.05)
    said = (work / "output.txt").read_text().splitlines()
    if child.returncode:
        raise SystemExit(f"bidnerf {' '.join(command)}: {said[-1:]}")
    shutil.copy(work / "output.txt", work / f"output_{command[0]}_{int(began)}.txt")
    return {
        "seconds": time.perf_counter() - began,
        "resident_MB": peaks["VmHWM"] / 1e3,
        "anonymous_MB": peaks["RssAnon"] / 1e3,
        "said": [line for line in said if " read at " in line],
    }


def status(pid: int, key: str) -> int:
    """Return a figure of a process in kB; 0 once it has ended."""
    try:
        lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    except OSError:
        return 0
    return next((int(line.split()[1]) for line in lines if line.startswith(f"{key}:")), 0)


if __name__ == "__main__":
    main()
