r"""Photos without poses: what finding their poses takes, beside COLMAP's incremental mapper, and on a cluster.

    python benchmarks/photos_without_poses.py PHOTOS[:PARTS] [PHOTOS[:PARTS] ...] [--work photos_without_poses]

PHOTOS are folders of photos, each of one scene. The parts (all of them unless PARTS names some, separated by commas), of which each is
made once and kept in ``WORK/rows.jsonl``:

- ``ours``: ``find_poses``, on one thread;
- ``colmap``: the same keypoints; COLMAP's exhaustive matching and its incremental mapper with default options, on one thread. Its
  database is kept, so that an interrupted run goes on;
- ``cluster``: ``find_poses`` with the four processes of a local dask cluster;
- ``killed``: the same, where one of the processes is killed at half of the pairs;
- ``posed``: what ``train`` does with the placed photos before the field: reading, detection, pairs, matches, tests of the poses, points,
  landmarks and their trial.

CPU times are those of all processes, which are started with the settings that docs/maps.md advises for a cluster. ``error`` is the mean reprojection error (pixels of the downscaled photos). ``apart`` is the median
distance between the cameras of ours and of COLMAP's model after the best similarity, as a fraction of the extent of the cameras.
"""

from __future__ import annotations

import os

os.environ |= {  # for the processes of the cluster
    "OMP_NUM_THREADS": "1",
    "OPENCV_FOR_THREADS_NUM": "1",
    "MALLOC_MMAP_THRESHOLD_": f"{2**25}",
    "MALLOC_TRIM_THRESHOLD_": f"{2**28}",
    "DASK_DISTRIBUTED__WORKER__PROFILE__ENABLED": "False",
    "DASK_DISTRIBUTED__ADMIN__TICK__INTERVAL": "1s",
}

import resource
import signal
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from _lab import Row, RowStore, one_thread, parser, record

import bidnerf as bn
from bidnerf.structure import (
    LEAST_PHOTOS,
    MODEL,
    FoundPoses,
    import_pycolmap,
    list_photos,
    photos_of,
    write_cameras,
    write_keypoints,
)
from bidnerf_core.captures import prepare_views, tried_landmarks
from bidnerf_core.carving import estimate_bounds
from bidnerf_core.datasets import DatasetOptions
from bidnerf_core.geometry import fit_similarity
from bidnerf_core.maps import read_views
from bidnerf_core.progress import Progress, job_context

WORKERS = 4


def cpu_seconds() -> float:
    """Return the CPU time of this process and of its children that have ended."""
    own, ended = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return own.ru_utime + own.ru_stime + ended.ru_utime + ended.ru_stime


class Stages:
    """The CPU time of each stage of a job, from its first report to that of the next."""

    def __init__(self) -> None:
        self.seconds, self._stage, self._start = dict[str, float](), "reading", cpu_seconds()

    def __call__(self, now: Progress) -> None:
        if now.stage != self._stage:
            self.end(now.stage)

    def end(self, following: str = "") -> dict[str, float]:
        now = cpu_seconds()
        self.seconds[self._stage] = self.seconds.get(self._stage, 0.0) + now - self._start
        self._stage, self._start = following, now
        return self.seconds


def timed(work: Callable[[Stages], Row]) -> Row:
    """Return the row of a run, with its CPU time, wall time, and CPU times of stages."""
    stages, began, cpu = Stages(), time.monotonic(), cpu_seconds()
    row = work(stages)
    times = {"wall_seconds": time.monotonic() - began, "cpu_seconds": cpu_seconds() - cpu}
    return row | times | {"cpu_seconds_of_stages": stages.end()}


def ours(photos: Path, out: Path, progress: Callable[[Progress], None]) -> Row:
    poses: FoundPoses = bn.find_poses(photos, out, overwrite=True, progress=progress)
    frame = None if poses.geo_frame is None else poses.geo_frame.crs
    return {
        "photos": poses.photos,
        "placed": poses.placed,
        "models": list(poses.models),
        "points": poses.points,
        "error": poses.reprojection_error,
        "frame": frame,
        "metres_from_gps": None if poses.geo_frame is None else poses.geo_frame.deviation,
        "doubt": poses.doubt,
    }


def colmap(photos: Path, work: Path, stages: Stages) -> Row:
    """Return the row of COLMAP's own matching and mapping of the keypoints that ``find_poses`` detects."""
    pycolmap = import_pycolmap(str(photos))
    listed, database = list_photos(photos_of(photos), None), work / "database.db"
    work.mkdir(parents=True, exist_ok=True)
    with job_context(stages), pycolmap.Database.open(database) as opened:
        if not opened.num_images():
            write_cameras(opened, listed, pycolmap)
        write_keypoints(opened, listed, pycolmap)
    stages.end("matching photos")
    matching = pycolmap.FeatureMatchingOptions(num_threads=1, use_gpu=False)
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = 0
    pairing = pycolmap.ExhaustivePairingOptions(block_size=20)
    pycolmap.match_exhaustive(database, matching, pairing, verification, device=pycolmap.Device.cpu)
    stages.end("placing photos")
    options = pycolmap.IncrementalPipelineOptions(
        num_threads=1, random_seed=0, extract_colors=False, min_model_size=LEAST_PHOTOS
    )
    models = pycolmap.incremental_mapping(database, work, work, options)
    best = max(models.values(), key=lambda model: (model.num_reg_images(), model.num_points3D()))
    for number in best.reg_image_ids():
        best.image(number).name = next(photo.file.name for photo in listed.photos if photo.number == number)
    (work / "best").mkdir(exist_ok=True)
    best.write_binary(work / "best")
    with pycolmap.Database.open(database) as opened:
        pairs = opened.num_matched_image_pairs()
    return {
        "photos": len(listed.photos),
        "placed": best.num_reg_images(),
        "models": sorted((model.num_reg_images() for model in models.values()), reverse=True),
        "points": best.num_points3D(),
        "error": best.compute_mean_reprojection_error(),
        "pairs": pairs,
    }


def centres(folder: Path, pycolmap: Any) -> dict[str, np.ndarray]:
    """Return the positions of the cameras of a model, by the names of their photos."""
    model = pycolmap.Reconstruction(folder)
    return {Path(model.image(n).name).name: model.image(n).projection_center() for n in model.reg_image_ids()}


def compare(a: dict[str, np.ndarray], b: dict[str, np.ndarray]) -> Row:
    """Return the distances between the cameras of two models after the best similarity, as fractions of their extent."""
    both = sorted(a.keys() & b.keys())
    first, second = (torch.from_numpy(np.array([each[name] for name in both])) for each in (a, b))
    away = torch.linalg.vector_norm(fit_similarity(first, second).apply(first) - second, dim=-1)
    extent = float(torch.linalg.vector_norm(second - second.mean(0), dim=-1).square().mean().sqrt())
    return {
        "cameras": len(both),
        "apart": float(away.median()) / extent,
        "apart_90": float(away.quantile(0.9)) / extent,
    }


def on_cluster(photos: Path, out: Path, kill: bool) -> Row:
    """Return the row of ``find_poses`` on a local cluster; with ``kill``, one of its processes is killed at half of the pairs."""
    from distributed import LocalCluster

    killed = list[int]()

    def run(stages: Stages) -> Row:
        with LocalCluster(n_workers=WORKERS, threads_per_worker=1, processes=True, dashboard_address=None) as local:

            def progress(now: Progress) -> None:
                stages(now)
                if kill and not killed and now.stage == "matching photos" and 2 * now.done >= (now.total or 0):
                    killed.append(local.workers[0].process.pid)
                    os.kill(killed[0], signal.SIGKILL)

            with bn.cluster(local.scheduler_address):
                return ours(photos, out, progress)

    return timed(run) | {"killed": len(killed)}


def prepared(dataset: Path, stages: Stages) -> Row:
    """Return the row of what training does with a dataset before the field."""
    with job_context(stages):
        read = read_views(dataset, DatasetOptions(split="all"))
        ready = prepare_views(read.views)
        estimate_bounds(ready.views, read.background)
        stages.end("trying the landmarks on images")
        assert ready.tracked is not None
        landmarks = tried_landmarks(ready.tracked, ready.views)
    return {"photos": len(read.views), "pairs": len(ready.tracked.matches), "landmarks": len(landmarks)}


def main() -> None:
    given = parser(__doc__, "photos_without_poses")
    given.add_argument("photos", nargs="+", metavar="PHOTOS[:PARTS]")
    given.add_argument("--work", type=Path, default=Path("photos_without_poses"), help="folder for models and rows")
    options = given.parse_args()
    one_thread()
    pycolmap, results = import_pycolmap("photos"), dict[str, Any]()
    parts: dict[str, Callable[[Path, Path], Row]] = {
        "ours": lambda photos, out: timed(lambda stages: ours(photos, out, stages)),
        "colmap": lambda photos, out: timed(lambda stages: colmap(photos, out, stages)),
        "cluster": lambda photos, out: on_cluster(photos, out, kill=False),
        "killed": lambda photos, out: on_cluster(photos, out, kill=True),
        "posed": lambda _, out: timed(lambda stages: prepared(out.with_name("ours"), stages)),
    }
    with RowStore(options.work / "rows.jsonl") as store:
        for scene in options.photos:
            folder, _, wanted = scene.partition(":")
            photos = Path(folder)
            name = photos.resolve().name if photos.name != "images" else photos.resolve().parent.name
            rows, base = dict[str, Row](), options.work / name
            for part in wanted.split(",") if wanted else parts:
                rows[part] = store.get([name, part], partial(parts[part], photos, base / part))
                rows[part]["cpu_seconds_a_photo"] = rows[part]["cpu_seconds"] / rows[part]["photos"]
                print(name, part, rows[part], flush=True)
            own = centres(base / "ours" / MODEL, pycolmap)
            if "colmap" in rows:
                rows["colmap"] |= compare(own, centres(base / "colmap" / "best", pycolmap))
            whole = (base / "ours" / "transforms.json").read_bytes()
            for part in {"cluster", "killed"} & rows.keys():
                rows[part]["equal"] = (base / part / "transforms.json").read_bytes() == whole
            if {"cluster", "killed"} <= rows.keys():
                rows["killed"]["times_as_long"] = rows["killed"]["cpu_seconds"] / rows["cluster"]["cpu_seconds"]
            results[name] = rows
    record(options.name, results)


if __name__ == "__main__":
    main()
