"""The ways to find a camera without a start that ``landmark_peers.py`` compares, each a function of a frame and a seed."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from registration_baselines import OPEN3D, gicp_settings, open3d_settings
from registration_clouds import map_points, measured_points
from registration_kiss import KissMatcher, tuned_kiss
from registration_methods import Gicp, Matrix, Open3d, Ransac, Refine, SmallGicp
from registration_tuning import Case, cases
from sift_pnp import FEWEST_INLIERS, PnpResult, SiftMatcher, colmap_pnp, opencv_pnp
from sift_points import sift_points

from bidnerf_core import Localizer, Map
from bidnerf_core.datasets import Dataset
from bidnerf_core.evaluation.json_lines import RowStore
from bidnerf_core.frames.frame import Frame, View
from bidnerf_core.io.json import from_plain

LIBRARIES = {
    "pycolmap": "pycolmap", "kiss_matcher": "kiss-matcher", "small_gicp": "small_gicp",
    "open3d": "open3d or open3d-cpu",
}  # fmt: skip
"""Distributions that peers need, by module name."""

KISS_GICP = "kiss-matcher + gicp"
OPEN3D_PEERS = {f"open3d fpfh + ransac + {name}": name for name in ("icp", "coloured icp")}


@dataclass(frozen=True, eq=False)
class Answer:
    """A pose, if one was found, and whether the peer accepts it; None if the peer does not judge its answers."""

    T_world_camera: Matrix | None
    accepted: bool | None = None


Peer = Callable[[Frame, int], Answer]
"""A function from a frame and a seed to an answer."""


def installed() -> dict[str, str | None]:
    """Return the versions of the libraries, and print a line for each that is missing."""
    found: dict[str, str | None] = {}
    for module, distributions in LIBRARIES.items():
        found[module] = None
        if find_spec(module) is None:
            print(f"{distributions} is not installed: what needs it is skipped")
        else:
            found[module] = _version(distributions.split(" or "))
    return found


def _version(distributions: Sequence[str]) -> str | None:
    for name in distributions:
        try:
            return version(name)
        except ModuleNotFoundError:  # which PackageNotFoundError is
            continue
    return None


def auto(localizer: Localizer, depth: bool, frame: Frame, seed: int) -> Answer:
    """Localize a frame with our method, with its depth or without it."""
    found = localizer(frame if depth else replace(frame, depth=None), seed=seed)
    return Answer(found.T_world_camera.matrix().double().numpy(), found.converged)


def image_peers(stored: Map, dataset: Dataset, cache: Path) -> dict[str, Peer]:
    """Return the methods that take an image; ``cache`` holds the points triangulated from the training images."""
    peers: dict[str, Peer] = {"auto": partial(auto, Localizer(stored), False)}
    if find_spec("pycolmap"):
        matcher = SiftMatcher(sift_points(dataset.views("train"), cache))
        peers["sift + pnp (pycolmap)"] = partial(pnp, matcher, colmap_pnp)
        peers["sift + pnp (opencv)"] = partial(pnp, matcher, opencv_pnp)
    return peers


def pnp(matcher: SiftMatcher, solve: Callable[..., PnpResult | None], frame: Frame, seed: int) -> Answer:
    """Match a frame and solve for its pose."""
    found = solve(*matcher(frame), frame.intrinsics, seed)
    return (
        Answer(None, False)
        if found is None
        else Answer(found.T_world_camera, found.inliers >= FEWEST_INLIERS)
    )


def depth_peers(
    stored: Map,
    tuning: Sequence[View],
    voxel: float,
    wanted: Sequence[str] | None,
    key: list[Any],
    store: RowStore,
) -> tuple[dict[str, Peer], dict[str, Any]]:
    """Return the methods that take an image with depth, and the settings that do best on the frames for tuning.

    Only ``wanted`` methods are tuned, if that is given. ``store`` keeps the settings under ``key``.
    """
    peers: dict[str, Peer] = {"auto": partial(auto, Localizer(stored), True)}
    settings: dict[str, Any] = {}
    if stored.surface is None or not tuning:
        return peers, settings
    points = map_points(stored.surface)
    tries = cases([(measured_points(view.frame), view.T_ref_camera) for view in tuning])
    name = KISS_GICP
    if find_spec("kiss_matcher") and find_spec("small_gicp") and (not wanted or name in wanted):
        kiss, gicp = KissMatcher(points), SmallGicp(points)
        tuned = partial(_kiss_settings, kiss, gicp, tries, voxel)
        settings[name] = store.get([*key, "tuned", name, voxel], tuned)
        refine = from_plain(Gicp, settings[name]["gicp"], name)
        peers[name] = partial(kiss_gicp, kiss, gicp, settings[name]["voxel"], refine)
    if find_spec("open3d") and (not wanted or not OPEN3D_PEERS.keys().isdisjoint(wanted)):
        library = Open3d(points)
        plain = store.get([*key, "tuned", "open3d", voxel], partial(open3d_settings, points, tries, voxel))
        ransac = from_plain(OPEN3D["ransac"], plain["ransac"], "open3d")
        for name, refinement in OPEN3D_PEERS.items():
            settings[name] = {"ransac": plain["ransac"], "refinement": plain[refinement]}
            refine = from_plain(OPEN3D[refinement], plain[refinement], name)
            peers[name] = partial(open3d, library, ransac, refine)
    return peers, settings


def _kiss_settings(kiss: KissMatcher, gicp: SmallGicp, tries: Sequence[Case], voxel: float) -> dict[str, Any]:
    print("tuning KISS-Matcher", flush=True)
    best, starts = tuned_kiss(kiss, gicp, tries, voxel)
    return {"voxel": best, "gicp": gicp_settings(gicp.points, tries, starts, voxel, near=True)}


def kiss_gicp(
    kiss: KissMatcher, gicp: SmallGicp, voxel: float, refine: Gicp, frame: Frame, seed: int
) -> Answer:
    """Register a frame with KISS-Matcher, which is deterministic, and refine the pose."""
    measured = measured_points(frame)
    T, accepted = kiss.search(measured, voxel)
    return Answer(gicp.refine(measured, T, refine), accepted)


def open3d(library: Open3d, ransac: Ransac, refine: Refine, frame: Frame, seed: int) -> Answer:
    """Register a frame with Open3D, which does not judge its answers."""
    library.seed(seed)
    measured = measured_points(frame)
    return Answer(library.refine(measured, library.search(measured, ransac), refine))
