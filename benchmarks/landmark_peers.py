r"""Compare method ``auto`` with the simplest other ways to localize a camera, on the same map and frames.

    python benchmarks/landmark_peers.py SCENE [SCENE ...] --name landmark_peers

From images alone, without a start:

- ``auto``: ours;
- ``sift + pnp (pycolmap)``: SIFT points that COLMAP triangulates from the training images and their known poses, as in hloc;
  exhaustive matching with a ratio test; pycolmap's RANSAC and refinement with default options;
- ``sift + pnp (opencv)``: the same matches; ``solvePnPRansac`` and ``solvePnPRefineLM``.

Where frames have depth, from image and depth, without a start but for the last two:

- ``auto``: ours;
- ``kiss-matcher + gicp``: KISS-Matcher, then small_gicp's GICP, on all pixels with a depth and the surfels of the map;
- ``open3d fpfh + ransac + icp``, ``open3d fpfh + ransac + coloured icp``: the same points;
- ``gicp from a start``, ``auto from a start``: from the same starts of protocol ``bid``, ``--off`` away.

Settings of the point cloud methods are tuned for each scene on the frames for tuning. ``--voxel`` is where that begins: 5 cm in
rooms, or 2 % of the extent of an object. Peers take turns, frame by frame, in one process of one thread. CPU times begin with
the frame in memory and the map's points, features and trees built.

Libraries that are not installed are skipped: ``pip install -e '.[sfm]' --group peers`` installs all but Open3D, which is large
(``open3d-cpu``). Triangulated points are kept in ``--cache`` by the content of the images, and finished rows next to
the record, so that an interrupted run resumes where it stopped.
"""

from __future__ import annotations

import os

os.environ["OMP_NUM_THREADS"] = "1"  # before any library counts the cores

import argparse
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from _lab import (
    LIMITS,
    RESULTS,
    RIGHT,
    STRICT,
    Row,
    RowStore,
    Scene,
    cpu_seconds,
    in_turn,
    judgement,
    modes,
    one_thread,
    parser,
    rates,
    record,
    times_slower,
    within,
)
from clouds import (
    Gicp,
    KissMatcher,
    Matrix,
    Open3d,
    Ransac,
    Refine,
    SmallGicp,
    as_pose,
    cases,
    map_points,
    measured_points,
    tuned_gicp,
    tuned_kiss,
    tuned_open3d,
)
from scipy.stats import binomtest
from sift import FEWEST_INLIERS, SiftMatcher, colmap_pnp, opencv_pnp, sift_points

from bidnerf import Localizer, View
from bidnerf.evaluation import bid_start, views_digest
from bidnerf.results import pose_error
from bidnerf_core.io import from_plain, to_plain

OURS = "auto"
LIBRARIES = {
    "pycolmap": ("pycolmap",),
    "kiss_matcher": ("kiss-matcher",),
    "small_gicp": ("small_gicp",),
    "open3d": ("open3d", "open3d-cpu"),
}
"""Distributions that peers need, by module name."""
KISS_GICP, FROM_START = "kiss-matcher + gicp", "gicp from a start"
OPEN3D_PEERS = {f"open3d fpfh + ransac + {name}": name for name in ("icp", "coloured icp")}


@dataclass(frozen=True, eq=False)
class Answer:
    """A pose, if one was found, and whether the peer accepts it; None if the peer does not judge its answers."""

    T_world_camera: Matrix | None
    accepted: bool | None = None


Peer = Callable[[View, int], Answer]
"""A function from a view and a seed to an answer; the view's own pose serves only to make a start."""


def installed_versions() -> dict[str, str | None]:
    """Return the versions of the libraries, and print a line for each that is missing."""
    found: dict[str, str | None] = dict.fromkeys(LIBRARIES)
    for module, distributions in LIBRARIES.items():
        for name in distributions if find_spec(module) else ():
            try:
                found[module] = version(name)
            except PackageNotFoundError:
                continue
        if find_spec(module) is None:
            print(f"{' or '.join(distributions)} is not installed: what needs it is skipped")
    return found


def auto(localizer: Localizer, off: float | None, view: View, seed: int) -> Answer:
    """Localize a view with our method, from a start that is ``off`` or from none."""
    start = None if off is None else bid_start(view.T_ref_camera, off, seed)
    found = localizer(view.frame, start, seed=seed)
    return Answer(found.T_world_camera.matrix().double().numpy(), found.converged)


def image_peers(scene: Scene, cache: Path) -> dict[str, Peer]:
    """Return the methods that take an image; ``cache`` holds the points triangulated from the training images."""
    peers: dict[str, Peer] = {OURS: partial(auto, Localizer(scene.map), None)}
    if find_spec("pycolmap"):
        matcher = SiftMatcher(sift_points(scene.dataset.views("train"), cache))
        for name, solve in (("pycolmap", colmap_pnp), ("opencv", opencv_pnp)):
            peers[f"sift + pnp ({name})"] = partial(pnp, matcher, solve)
    return peers


def pnp(matcher: SiftMatcher, solve: Callable[..., Any], view: View, seed: int) -> Answer:
    found = solve(*matcher(view.frame), view.frame.intrinsics, seed)
    return Answer(None, False) if found is None else Answer(found.T_world_camera, found.inliers >= FEWEST_INLIERS)


def depth_peers(
    scene: Scene, tuning: Sequence[View], given: argparse.Namespace, store: RowStore
) -> tuple[dict[str, Peer], dict[str, Any]]:
    """Return the methods that take an image with depth, and the settings that do best on the frames for tuning.

    Only the peers that were asked for are tuned.
    """
    localizer = Localizer(scene.map)
    peers: dict[str, Peer] = {OURS: partial(auto, localizer, None)}
    settings: dict[str, Any] = {}
    if scene.map.surface is None or not tuning:
        return peers, settings
    points, voxel = map_points(scene.map.surface), given.voxel
    tries = cases([(measured_points(view.frame), view.T_ref_camera) for view in tuning])

    def is_wanted(*names: str) -> bool:
        return not given.peers or any(name in given.peers for name in names)

    def tuned(name: str, make: Callable[[], dict[str, Any]]) -> dict[str, Any]:
        print(f"tuning {name}", flush=True)
        found: dict[str, Any] = store.get([*scene.key, "tuned", name, voxel, given.off], make)
        return found

    if find_spec("small_gicp") and is_wanted(KISS_GICP, FROM_START):
        gicp = SmallGicp(points)
        if is_wanted(FROM_START):
            starts = [bid_start(case.truth, given.off, i).matrix().numpy() for i, case in enumerate(tries)]
            settings[FROM_START] = tuned(FROM_START, lambda: to_plain(tuned_gicp(gicp, tries, starts, voxel, False)))
            refine = from_plain(Gicp, settings[FROM_START], FROM_START)
            peers[FROM_START] = lambda view, seed: Answer(
                gicp.refine(
                    measured_points(view.frame),
                    bid_start(view.T_ref_camera, given.off, seed).matrix().numpy(),
                    refine,
                )
            )
            peers["auto from a start"] = partial(auto, localizer, given.off)
        if find_spec("kiss_matcher") and is_wanted(KISS_GICP):
            kiss = KissMatcher(points)

            def tune_kiss() -> dict[str, Any]:
                best, found = tuned_kiss(kiss, gicp, tries, voxel)
                return {"voxel": best, "gicp": to_plain(tuned_gicp(gicp, tries, found, voxel, True))}

            chosen = settings[KISS_GICP] = tuned(KISS_GICP, tune_kiss)
            peers[KISS_GICP] = partial(
                kiss_gicp, kiss, gicp, chosen["voxel"], from_plain(Gicp, chosen["gicp"], KISS_GICP)
            )
    if find_spec("open3d") and is_wanted(*OPEN3D_PEERS):
        library = Open3d(points)
        names = ("ransac", "icp", "coloured icp")
        plain = tuned(
            "open3d",
            lambda: dict(zip(names, map(to_plain, tuned_open3d(library, tries, voxel)), strict=True)),
        )
        ransac = from_plain(Ransac, plain["ransac"], "open3d")
        for name, refinement in OPEN3D_PEERS.items():
            settings[name] = {"ransac": plain["ransac"], "refinement": plain[refinement]}
            peers[name] = partial(open3d, library, ransac, from_plain(Refine, plain[refinement], name))
    return peers, settings


def kiss_gicp(kiss: KissMatcher, gicp: SmallGicp, voxel: float, refine: Gicp, view: View, seed: int) -> Answer:
    """Register a frame with KISS-Matcher, which is deterministic, and refine the pose."""
    measured = measured_points(view.frame)
    T, accepted = kiss.search(measured, voxel)
    return Answer(gicp.refine(measured, T, refine), accepted)


def open3d(library: Open3d, ransac: Ransac, refine: Refine, view: View, seed: int) -> Answer:
    """Register a frame with Open3D, which does not judge its answers."""
    library.seed(seed)
    measured = measured_points(view.frame)
    return Answer(library.refine(measured, library.search(measured, ransac), refine))


def answer(peer: Peer, view: View, seed: int) -> Row:
    """Return the errors of one answer (None without a pose), whether the peer accepts it, and its times."""
    began, used = time.perf_counter(), time.process_time()
    found = peer(view, seed)
    row: Row = {"seconds": time.perf_counter() - began, "cpu_seconds": time.process_time() - used}
    row |= {
        "converged": found.accepted,
        "translation": None,
        "rotation_deg": None,
        "normalized_error_squared": None,
    }
    error = (
        None if found.T_world_camera is None else pose_error(as_pose(found.T_world_camera), view.T_ref_camera).plain()
    )
    return row | (error or {})


def compare(
    peers: dict[str, Peer],
    views: Sequence[View],
    warm: View,
    key: list[Any],
    settings: dict[str, Any],
    store: RowStore,
) -> dict[str, list[Row]]:
    """Return the rows of each peer; peers take turns on each frame. One-time work is done on ``warm`` and not timed."""
    rows: dict[str, list[Row]] = {name: [] for name in peers}
    warmed = set[str]()

    def time_answer(name: str, view: View, seed: int) -> Row:
        if name not in warmed:
            peers[name](warm, 0)
            warmed.add(name)
        return answer(peers[name], view, seed)

    for place, view in enumerate(views):
        for name in in_turn(list(peers), place):
            known_by = [*key, name, settings.get(name), views_digest([view]), place]
            rows[name].append(store.get(known_by, partial(time_answer, name, view, place)))
    return rows


def summary(rows: Sequence[Row]) -> dict[str, Any]:
    """Return success with Wilson intervals, median errors, times, and silent answers of peers that judge their answers."""
    judged = judgement(rows) if all(row["converged"] is not None for row in rows) else {}
    names = {"accepted": "converged", "silent": "silent", "right_but_rejected": "right_but_rejected"}
    return {
        "n": len(rows),
        **rates(rows),
        **cpu_seconds(rows),
        **{n: judged.get(k) for n, k in names.items()},
    }


def against(ours: Sequence[Row], theirs: Sequence[Row]) -> dict[str, Any]:
    """Return how many frames both, one or neither localizes, with McNemar's exact p, and their time relative to ours."""
    result: dict[str, Any] = {}
    for name in LIMITS:
        found = [(within(a, name), within(b, name)) for a, b in zip(ours, theirs, strict=True)]
        only_ours, only_theirs = found.count((True, False)), found.count((False, True))
        apart = only_ours + only_theirs
        result[name] = {
            "both": found.count((True, True)),
            "only_auto": only_ours,
            "only_peer": only_theirs,
            "neither": found.count((False, False)),
            "p": float(binomtest(only_ours, apart).pvalue) if apart else 1.0,
        }
    return result | {"cpu_seconds_against_auto": times_slower(theirs, ours)}


def summaries(rows: dict[str, list[Row]]) -> dict[str, Any]:
    """Return the summary of each peer, and its paired comparison with ours."""
    return {
        name: summary(found) | ({} if name == OURS else {"paired": against(rows[OURS], found)})
        for name, found in rows.items()
    }


def line(found: dict[str, Any]) -> str:
    """Return a summary as a line of a table."""
    silent = "-" if found["silent"] is None else f"{found['silent']} of {found['accepted']}"
    text = (
        f"n {found['n']:3} right {found[RIGHT]['successes']:3} strict {found[STRICT]['successes']:3}"
        f" median {found['median_translation'] or float('nan'):.4f}, silent {silent}, CPU {found['median_cpu_seconds']:.2f} s"
    )
    if paired := found.get("paired"):
        text += f" | only auto, only this: {paired[RIGHT]['only_auto']}, {paired[RIGHT]['only_peer']}"
    return text


def scene_rows(scene: Scene, given: argparse.Namespace, store: RowStore) -> tuple[dict[str, Any], dict[str, Any]]:
    """Compare the peers on one scene, with images alone and, where there is depth, with depth; return summaries and rows."""
    tuning = scene.views(True)
    results, every = {}, {}
    for mode, views in modes(scene.views(given.tuning_frames, given.frames), given.modes).items():
        peers, settings = image_peers(scene, given.cache), {}
        if mode == "RGB-D":
            peers, settings = depth_peers(scene, tuning, given, store)
        if given.peers:
            peers = {name: peer for name, peer in peers.items() if name == OURS or name in given.peers}
        rows = every[mode] = compare(peers, views, modes(tuning)[mode][0], [*scene.key, mode], settings, store)
        results[mode] = {"settings": settings, "peers": summaries(rows)}
        for name, found in results[mode]["peers"].items():
            print(f"{scene.name:15} {mode:5} {name:38} {line(found)}", flush=True)
    return results, every


def totals(scenes: Sequence[dict[str, Any]], mode: str) -> dict[str, Any]:
    """Return the summaries over the frames of all scenes, for peers that were tried on all of them."""
    parts = [rows[mode] for rows in scenes if mode in rows]
    shared = [name for name in (parts[0] if parts else ()) if all(name in part for part in parts)]
    return summaries({name: [row for part in parts for row in part[name]] for name in shared})


def main() -> None:
    arguments = parser(__doc__, "landmark_peers", scenes=True)
    arguments.add_argument("--peers", nargs="+", metavar="PEER", help="only these, and ours")
    arguments.add_argument("--voxel", type=float, default=0.05, help="metres, where tuning of point clouds begins")
    arguments.add_argument("--off", type=float, default=0.5, help="size of the starts that are given")
    arguments.add_argument("--cache", type=Path, default=RESULTS.parent / "cache", help="of triangulated points")
    mode = arguments.add_mutually_exclusive_group()
    mode.add_argument("--rgb", dest="modes", action="store_const", const=("RGB",))
    mode.add_argument("--rgbd", dest="modes", action="store_const", const=("RGB-D",))
    arguments.set_defaults(modes=("RGB", "RGB-D"))
    given = arguments.parse_args()
    one_thread()
    versions, scenes, every = installed_versions(), {}, []
    with RowStore(RESULTS / f"{given.name}.rows.jsonl") as store:
        for scene in map(Scene.open, given.scenes):
            scenes[scene.name], rows = scene_rows(scene, given, store)
            every.append(rows)
    everything = {mode: totals(every, mode) for mode in given.modes}
    for mode, found in everything.items():
        for name, each in found.items():
            print(f"{'all scenes':15} {mode:5} {name:38} {line(each)}")
    record(given.name, {"versions": versions, "scenes": scenes, "all": everything})


if __name__ == "__main__":
    main()
