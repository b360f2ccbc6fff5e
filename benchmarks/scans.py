"""Scans as maps: images with depth localized without a start in fused depth, beside registration of point clouds by others.

    python benchmarks/scans.py DATA... --folder WORK --name scans

Open3D fuses the measured depth of a dataset's training images into a truncated signed distance function, and writes the cloud and
the mesh of its surface as PLY files to WORK. Each is imported as a map (``bidnerf import``; plugin ``bidnerf-scan``) with landmarks
from rendered images, and the cloud also without its colours, and with landmarks from the training photos (``--photos``). Peers get
the points and normals of the same cloud: Open3D (FPFH features, RANSAC, point-to-plane ICP) and KISS-Matcher refined by small_gicp,
with voxels of ``--voxel`` metres. Answers are kept in a ``.rows.jsonl`` next to the record, and maps in WORK, so that an interrupted run
resumes where it stopped.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from _lab import RESULTS, Row, RowStore, cpu_seconds, held_out, judgement, one_thread, parser, rates, record
from clouds import Gicp, KissMatcher, Open3d, Points, Ransac, Refine, SmallGicp, measured_points
from landmark_peers import Answer, Peer, answer, auto, kiss_gicp, open3d

from bidnerf import ImportOptions, Localizer, View, import_map, load_map
from bidnerf_core.datasets import Capture, open_dataset
from bidnerf_core.errors import InputError

CELLS = 256
"""Voxels of the fused depth along the longest side of what was measured."""
FARTHEST = 100.0
"""Metres: depth beyond it is not fused."""
LEAST_WEIGHT = 3.0
"""Images that must have seen a voxel."""
MAPS: dict[str, tuple[str, bool]] = {
    "cloud": ("cloud.ply", False),
    "mesh": ("mesh.ply", False),
    "cloud without colours": ("grey.ply", False),
    "cloud, landmarks from photos": ("cloud.ply", True),
}
"""File of each map, and whether its landmarks come from photos."""


def fused(views: Sequence[View], folder: Path) -> None:
    """Write the fused depth of ``views`` as a cloud, as a cloud without colours and as a mesh, unless they are there."""
    import open3d

    if (folder / "grey.ply").exists():
        return
    points = np.concatenate(
        [
            view.T_ref_camera.matrix().double().numpy()[:3, :3] @ positions.T
            + view.T_ref_camera.matrix().double().numpy()[:3, 3:]
            for view in views
            if len(positions := measured_points(view.frame).positions[::50])
        ],
        axis=1,
    )
    side = float((np.quantile(points, 0.99, axis=1) - np.quantile(points, 0.01, axis=1)).max())
    voxel = side / CELLS
    core, geometry = open3d.core, open3d.t.geometry
    grid = geometry.VoxelBlockGrid(
        ("tsdf", "weight", "color"),
        (core.float32,) * 3,
        ((1), (1), (3)),
        voxel,
        16,
        50_000,
        core.Device("CPU:0"),
    )
    for view in views:
        frame, camera = view.frame, view.frame.intrinsics
        assert frame.depth is not None
        colour = geometry.Image(core.Tensor(np.ascontiguousarray(frame.rgb.numpy(), np.float32)))
        depth = geometry.Image(core.Tensor(np.ascontiguousarray(frame.depth.numpy()[..., None], np.float32)))
        # Its pixels have their centres at whole numbers.
        pinhole = np.array([[camera.fx, 0, camera.cx - 0.5], [0, camera.fy, camera.cy - 0.5], [0, 0, 1]])
        K = core.Tensor(pinhole, core.float64)
        T = core.Tensor(np.linalg.inv(view.T_ref_camera.matrix().double().numpy()).copy(), core.float64)
        blocks = grid.compute_unique_block_coordinates(depth, K, T, 1.0, FARTHEST)
        grid.integrate(blocks, depth, colour, K, K, T, 1.0, FARTHEST)
    cloud = grid.extract_point_cloud(LEAST_WEIGHT).to_legacy()
    mesh = grid.extract_triangle_mesh(LEAST_WEIGHT).to_legacy()
    open3d.io.write_triangle_mesh(str(folder / "mesh.ply"), mesh)
    open3d.io.write_point_cloud(str(folder / "cloud.ply"), cloud)
    cloud.colors = open3d.utility.Vector3dVector()
    open3d.io.write_point_cloud(str(folder / "grey.ply"), cloud)


def localizer(name: str, data: Path, folder: Path) -> Localizer:
    """Return a localizer in the map of a file, which is imported unless it is there."""
    file, has_photos = MAPS[name]
    place = folder / f"map-{name.replace(', ', '-').replace(' ', '-')}"
    try:
        found = load_map(place)
        if found.surface is None:
            raise InputError("not finished")
    except InputError:
        import_map(folder / file, place, photos=data if has_photos else None, options=ImportOptions(overwrite=True))
        found = load_map(place)
    return Localizer(found)


def registration(cloud: Path, voxel: float) -> dict[str, Peer]:
    """Return the methods of others on the points of a file, with the settings of their tutorials for this voxel size."""
    import open3d as library

    read = library.io.read_point_cloud(str(cloud))
    points = Points(*(np.asarray(part) for part in (read.points, read.colors, read.normals)))
    ransac = Ransac(voxel, iterations=300_000)
    refine = Refine(False, (voxel, voxel / 2, voxel / 4), (1.5, 1.5, 1.5))
    peers: dict[str, Peer] = {"open3d fpfh + ransac + icp": partial(open3d, Open3d(points), ransac, refine)}
    if find_spec("kiss_matcher") and find_spec("small_gicp"):
        gicp = Gicp(voxel / 2, (2 * voxel, voxel))
        peers["kiss-matcher + gicp"] = partial(kiss_gicp, KissMatcher(points), SmallGicp(points), voxel, gicp)
    return peers


def once(make: Callable[[], Localizer]) -> Peer:
    """Return our method as a peer, whose map is read only where an answer is missing."""
    kept: list[Localizer] = []

    def localize(view: View, seed: int) -> Answer:
        if not kept:
            kept.append(make())
        return auto(kept[0], None, view, seed)

    return localize


def scene_rows(data: Path, given: argparse.Namespace, store: RowStore) -> dict[str, list[Row]]:
    """Return the rows of all peers on the frames of a dataset."""
    dataset: Capture = open_dataset(data)
    folder = given.folder / data.name
    folder.mkdir(parents=True, exist_ok=True)
    fused(dataset.views("train"), folder)
    views = dataset.views("test", held_out(dataset.frame_names("test"), count=given.frames))
    peers = registration(folder / "cloud.ply", given.voxel)
    peers |= {f"auto, {name}": once(partial(localizer, name, data, folder)) for name in MAPS}
    rows: dict[str, list[Row]] = {}
    for name, peer in peers.items():
        if given.only and not any(part in name for part in given.only):
            continue
        rows[name] = []
        for place, view in enumerate(views):
            key = [data.name, name, view.frame.name, place, given.voxel]
            rows[name].append(store.get(key, partial(answer, peer, replace(view), place)))
        print(f"{data.name}: {name}: {summary(rows[name])}", flush=True)
    return rows


def summary(rows: Sequence[Row]) -> dict[str, Any]:
    """Return success, median errors, times and, of methods that judge their answers, how well they do."""
    judged = judgement(rows) if all(row["converged"] is not None for row in rows) else {}
    names = {"accepted": "converged", "silent": "silent", "right_but_rejected": "right_but_rejected"}
    return {
        "n": len(rows),
        **rates(rows),
        **cpu_seconds(rows),
        **{n: judged.get(k) for n, k in names.items()},
    }


def main() -> None:
    arguments = parser(__doc__, "scans")
    arguments.add_argument("data", nargs="+", type=Path, help="folders of datasets with depth")
    arguments.add_argument("--folder", type=Path, required=True, help="for the fused depth and the maps")
    arguments.add_argument("--frames", type=int, help="test frames of each dataset (default: all)")
    arguments.add_argument("--voxel", type=float, default=0.05, help="metres (default: %(default)s)")
    arguments.add_argument("--only", nargs="+", help="methods whose names have one of these parts")
    given = arguments.parse_args()
    one_thread()
    with RowStore(RESULTS / f"{given.name}.rows.jsonl") as store:
        found = {data.name: {n: summary(r) for n, r in scene_rows(data, given, store).items()} for data in given.data}
    versions = {
        name: version(name)
        for name in ("open3d", "kiss-matcher", "small_gicp", "trimesh")
        if find_spec(name.replace("-", "_"))
    }
    record(given.name, {"versions": versions, "voxel": given.voxel, "scenes": found})


if __name__ == "__main__":
    main()
