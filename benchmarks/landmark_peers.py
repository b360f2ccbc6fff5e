r"""Compare method ``auto`` with the simplest other ways to localize a camera, on the same map and frames, without a start.

    python benchmarks/landmark_peers.py MAP:DATA [MAP:DATA ...] --name landmark_peers

From images alone:

- ``auto``: ours;
- ``sift + pnp (pycolmap)``: SIFT points that COLMAP triangulates from the training images and their known poses, as in hloc;
  exhaustive matching with a ratio test; pycolmap's RANSAC and refinement with default options;
- ``sift + pnp (opencv)``: the same matches; ``solvePnPRansac`` and ``solvePnPRefineLM``.

Where frames have depth, from image and depth:

- ``auto``: ours;
- ``kiss-matcher + gicp``: KISS-Matcher, then small_gicp's GICP, on all pixels with a depth and the surfels of the map;
- ``open3d fpfh + ransac + icp``, ``open3d fpfh + ransac + coloured icp``: the same points.

Settings of the point cloud methods are tuned for each scene on the frames whose index in the test split is 1 modulo 5. These
frames are left out, since all methods were tuned on them; ``--tuning-frames`` takes only those. Peers take turns, frame by
frame, in one process of one thread. CPU times begin with the frame in memory and the map's points, features and trees built.

Libraries that are not installed are skipped: ``pip install '.[eval]' pycolmap`` installs all but Open3D, for which see
``registration_baselines.py``. Triangulated points are kept in ``--cache`` by the content of the images, and finished rows next
to the record, so that an interrupted run resumes where it stopped.
"""

from __future__ import annotations

import os

os.environ["OMP_NUM_THREADS"] = "1"  # before any library counts the cores

import argparse
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import torch
from peer_methods import Peer, depth_peers, image_peers, installed
from peer_summary import LIMITS, against, line, summary
from registration_tuning import as_pose

from bidnerf_core import Map, load_map
from bidnerf_core.datasets import Dataset, open_dataset
from bidnerf_core.evaluation.json_lines import RowStore
from bidnerf_core.evaluation.provenance import write_record
from bidnerf_core.evaluation.trial import views_digest
from bidnerf_core.frames.frame import View
from bidnerf_core.results.errors import pose_error

RESULTS = Path(__file__).resolve().parent / "results"
OURS = "auto"


def answer(peer: Peer, view: View, seed: int) -> dict[str, Any]:
    """Return the errors of one answer (None without a pose), whether the peer accepts it, and its CPU time."""
    began = time.process_time()
    found = peer(view.frame, seed)
    seconds = time.process_time() - began
    row: dict[str, Any] = dict.fromkeys(LIMITS) | {"accepted": found.accepted, "cpu_seconds": seconds}
    if found.T_world_camera is not None:
        error = pose_error(as_pose(found.T_world_camera), view.T_ref_camera)
        if error.translation.isfinite() and error.rotation_deg.isfinite():
            row |= {name: float(getattr(error, name)) for name in LIMITS}
    return row


def compared(
    peers: dict[str, Peer],
    views: Sequence[View],
    seeds: Sequence[int],
    warm: View,
    key: list[Any],
    settings: dict[str, Any],
    store: RowStore,
) -> dict[str, list[dict[str, Any]]]:
    """Return the rows of each peer; peers take turns on each frame. One-time work is done on ``warm`` and not timed."""
    rows: dict[str, list[dict[str, Any]]] = {name: [] for name in peers}
    names, warmed = list(peers), set[str]()

    def timed(name: str, view: View, seed: int) -> dict[str, Any]:
        if name not in warmed:
            peers[name](warm.frame, 0)
            warmed.add(name)
        return answer(peers[name], view, seed)

    for place, (view, seed) in enumerate(zip(views, seeds, strict=True)):
        shift = place % len(names)
        for name in names[shift:] + names[:shift]:
            known_by = [*key, name, settings.get(name), views_digest([view]), seed]
            row = store.get(known_by, partial(timed, name, view, seed))
            rows[name].append({"frame": view.frame.name, **row})
    return rows


def frames_of(dataset: Dataset, tuning: bool, count: int | None) -> tuple[list[str], list[int]]:
    """Return the names and indices of ``count`` evenly spaced test frames, from those for tuning or from all others."""
    chosen = [(name, i) for i, name in enumerate(dataset.frame_names("test")) if (i % 5 == 1) == tuning]
    kept = min(count or len(chosen), len(chosen))
    picked = [chosen[place * len(chosen) // kept] for place in range(kept)]
    return [name for name, _ in picked], [i for _, i in picked]


def scene(stored: Map, data: Path, given: argparse.Namespace, store: RowStore) -> dict[str, Any]:
    """Compare the peers on one scene, with images alone and, where there is depth, with depth."""
    dataset = open_dataset(data, stored.bounds.background)
    names, seeds = frames_of(dataset, given.tuning_frames, given.frames)
    views, tuning = dataset.views("test", names), dataset.views("test", frames_of(dataset, True, None)[0])
    info = stored.info
    key = [data.name, info.weights, str(info.landmarks), str(info.surface)]
    results: dict[str, Any] = {}
    for mode in given.modes:
        if mode == "RGB":
            peers, settings = image_peers(stored, dataset, given.cache), {}
        elif not any(view.frame.has_depth for view in views):
            continue
        else:
            peers, settings = depth_peers(stored, tuning, given.voxel, given.peers, key, store)
        if given.peers:
            peers = {name: peer for name, peer in peers.items() if name == OURS or name in given.peers}
        rows = compared(peers, views, seeds, tuning[0], [*key, mode], settings, store)
        results[mode] = {"settings": settings, "peers": summaries(rows), "rows": rows}
        for name, found in results[mode]["peers"].items():
            print(f"{data.name:15} {mode:5} {name:38} {line(found)}", flush=True)
    return results


def summaries(rows: dict[str, list[dict[str, Any]]]) -> dict[str, Any]:
    """Return the summary of each peer, and its paired comparison with ours."""
    return {
        name: summary(found) | ({} if name == OURS else {"paired": against(rows[OURS], found)})
        for name, found in rows.items()
    }


def totals(scenes: dict[str, Any], mode: str) -> dict[str, Any]:
    """Return the summaries over the frames of all scenes, for peers that were tried on all of them."""
    parts = [found[mode]["rows"] for found in scenes.values() if mode in found]
    shared = [name for name in (parts[0] if parts else ()) if all(name in part for part in parts)]
    return summaries({name: [row for part in parts for row in part[name]] for name in shared})


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scenes", nargs="+", metavar="MAP:DATA")
    parser.add_argument("--name", default="landmark_peers", help="of the record")
    parser.add_argument("--frames", type=int, help="frames of each scene, evenly spaced (default: all)")
    parser.add_argument("--tuning-frames", action="store_true")
    parser.add_argument("--peers", nargs="+", metavar="PEER", help="only these, and ours")
    parser.add_argument(
        "--voxel", type=float, default=0.05, help="metres, where tuning of point clouds begins"
    )
    parser.add_argument("--cache", type=Path, default=RESULTS.parent / "cache", help="of triangulated points")
    mode = parser.add_mutually_exclusive_group()
    mode.add_argument("--rgb", dest="modes", action="store_const", const=("RGB",))
    mode.add_argument("--rgbd", dest="modes", action="store_const", const=("RGB-D",))
    parser.set_defaults(modes=("RGB", "RGB-D"))
    return parser.parse_args()


def main() -> None:
    given = arguments()
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    versions = installed()
    kept = RESULTS / f"{given.name}.partial.jsonl"
    scenes: dict[str, Any] = {}
    with RowStore(kept) as store:
        for pair in given.scenes:
            folder, data = map(Path, pair.split(":"))
            scenes[data.name] = scene(load_map(folder), data, given, store)
    everything = {mode: totals(scenes, mode) for mode in given.modes}
    for mode, found in everything.items():
        for name, each in found.items():
            print(f"{'all scenes':15} {mode:5} {name:38} {line(each)}")
    results = {"versions": versions, "scenes": scenes, "all": everything}
    print(write_record(RESULTS / f"{given.name}.json", results, seed=0))
    kept.unlink(missing_ok=True)


if __name__ == "__main__":
    main()
