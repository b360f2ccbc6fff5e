"""Train a map as a user would, and measure it on frames that training never saw.

    python benchmarks/map_quality.py DATA --out MAP --name map_lego [-- OPTIONS OF bidnerf train]

Records wall time, CPU time and peak memory of ``bidnerf train`` as a process, the size of the map, and on the test split the
PSNR of images, the absolute error of depth where depth was measured, and the number of samples per ray. A map cannot know the
exposure of a photo that it was not trained on: PSNR is measured as rendered, and after the gain and the offset per colour
channel that fit the photo best. The poses of test frames may be as inaccurate as those of training frames were: PSNR is also
measured at poses of the test frames that are refined with the map's landmarks, and on training frames at the poses in the map;
both with the motion of a rolling shutter, where one was found. The errors that the landmarks had in their own trial are recorded
too.
Coarser levels are judged on every fifth frame. A field that offers ``dense``, itself without the selection of samples that
makes it fast, is compared with that on every fifth frame. ``--test-frames-only`` leaves out training frames, poses by
landmarks and ``dense``, for backends that take minutes to render an image. ``--without-depth`` withholds the measured depth of
a ``transforms_train.json`` from the training, and uses that of the test split for judging.
"""

from __future__ import annotations

import json
import resource
import statistics
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import _lab
import torch
from jaxtyping import Float
from kornia.metrics import psnr, ssim
from torch import Tensor

from bidnerf_core.captures import RowMotion, apply_stored_poses, moved_cameras, refinement_updates
from bidnerf_core.datasets import open_dataset
from bidnerf_core.fields import RadianceField, SceneBounds, device_of, levels, render_image
from bidnerf_core.frames import View
from bidnerf_core.geometry import SE3
from bidnerf_core.io import to_plain
from bidnerf_core.localization import LandmarkMatcher, Loop
from bidnerf_core.maps import Map, load_map

LEAST_LANDMARKS = 30
"""Minimum number of landmarks from which the pose of a test frame is refined."""


def train(data: Path, out: Path, options: list[str]) -> dict[str, float]:
    """Return wall seconds, CPU seconds and peak resident memory (GiB) of the training process."""
    command = [sys.executable, "-c", "import sys; from bidnerf.cli import main; sys.exit(main())"]
    began = time.perf_counter()
    subprocess.run([*command, "train", str(data), "--out", str(out), "--overwrite", *options], check=True)
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return {
        "seconds": time.perf_counter() - began,
        "cpu_seconds": used.ru_utime + used.ru_stime,
        "peak_resident_GiB": used.ru_maxrss / 2**20,
    }


def train_without_depth(data: Path, out: Path, options: list[str]) -> dict[str, float]:
    """Train on a copy of the dataset whose training frames name no depth, see ``train``."""
    with TemporaryDirectory() as folder:
        copy = Path(folder) / data.name
        copy.mkdir()
        for entry in data.iterdir():
            (copy / entry.name).symlink_to(entry.resolve())
        listed = json.loads((data / "transforms_train.json").read_text())
        for frame in listed["frames"]:
            frame.pop("depth_file_path", None)
        (copy / "transforms_train.json").unlink()
        (copy / "transforms_train.json").write_text(json.dumps(listed))
        return train(copy, out, options)


def fit_colours(rgb: Float[Tensor, "*p 3"], photo: Float[Tensor, "*p 3"]) -> Float[Tensor, "*p 3"]:
    """Apply to ``rgb`` the gain and offset per channel that best fit ``rgb`` to ``photo`` (least squares).

    The gain and offset serve as the colour transform of an image outside the training set.
    """
    x, y = rgb.reshape(-1, 3).double(), photo.reshape(-1, 3).double()
    around = x - x.mean(0)
    gain = (around * y).sum(0) / around.square().sum(0).clamp(min=1e-12)
    fitted = (rgb.double() - x.mean(0)) * gain + y.mean(0)
    return fitted.to(rgb)


def judge(field: RadianceField, bounds: SceneBounds, views: list[View]) -> dict[str, float | None]:
    """Return the mean PSNR (as rendered, and after ``fit_colours``) and SSIM, and statistics of the depth error.

    These are the median and 90th percentile of the absolute error (metres) over measured pixels, and the median of its ratio
    to the measured depth.
    """
    quality, fitted, likeness, errors, ratios, missing, measured = [], [], [], [], [], 0, 0
    for view in views:
        image = render_image(field, view.frame.intrinsics, view.T_ref_camera, bounds, motion=view.motion)
        quality.append(float(psnr(image.rgb, view.frame.rgb, 1.0)))
        fitted.append(float(psnr(fit_colours(image.rgb, view.frame.rgb).clamp(0, 1), view.frame.rgb, 1.0)))
        pair = [i.permute(2, 0, 1)[None] for i in (image.rgb, view.frame.rgb)]
        likeness.append(float(ssim(*pair, window_size=11).mean()))
        if view.frame.depth is not None:
            known = view.frame.depth > 0
            errors.append((image.depth - view.frame.depth).abs()[known])
            ratios.append(errors[-1] / view.frame.depth[known])
            missing += int((known & (image.depth == 0)).sum())
            measured += int(known.sum())
    depth = torch.cat(errors) if errors else torch.zeros(0)
    return {
        "frames": len(views),
        "psnr_mean_dB": statistics.fmean(quality),
        "psnr_lowest_dB": min(quality),
        "psnr_fitted_mean_dB": statistics.fmean(fitted),
        "ssim_mean": statistics.fmean(likeness),
        "samples_per_ray": samples_per_ray(field, bounds, views),
        "depth_error_median": float(depth.median()) if len(depth) else None,
        "relative_depth_error_median": float(torch.cat(ratios).median()) if errors else None,
        "depth_error_p90": float(depth.quantile(0.9)) if 0 < len(depth) < 2**24 else None,
        "share_of_measured_pixels_without_rendered_depth": missing / measured if measured else None,
    }


@torch.no_grad()
def samples_per_ray(field: RadianceField, bounds: SceneBounds, views: list[View]) -> float:
    """Return the mean number of queried samples over every fourth pixel along each axis, including rays that miss the scene."""
    taken, rays, device = 0, 0, device_of(field)
    for view in views:
        ray = view.frame.intrinsics.unproject(view.frame.intrinsics.pixel_centres())[::4, ::4].reshape(-1, 3)
        T = view.T_ref_camera.to(dtype=torch.float32, device=device)
        turned = T.rotate((ray / torch.linalg.vector_norm(ray, dim=-1, keepdim=True)).to(device))
        taken += int(field.sampler(bounds.rays(T.translation.expand_as(turned), turned)).valid.sum())
        rays += len(turned)
    return taken / rays


def at_landmark_poses(stored: Map, views: list[View]) -> dict[str, Any] | None:
    """Return the quality at the poses near the given ones that fit the map's landmarks best, and the distances between both.

    Frames that show too few landmarks are left out of both ``given`` and ``refined``.
    """
    if stored.landmarks is None:
        return None
    matcher, placed, given, updates = LandmarkMatcher(stored.landmarks), [], [], []
    for view in views:
        T = view.T_ref_camera.to("cpu", torch.float64)
        found = Loop([View(view.frame, SE3.identity())], matcher).at(T)
        if found is not None and found.evidence.inliers >= LEAST_LANDMARKS:
            given.append(view)
            placed.append(View(view.frame, found.T_world_rig, motion=found.motion))
            updates.append((T.inverse() @ found.T_world_rig).log())
    if not placed:
        return None
    translation, rotation = (torch.linalg.vector_norm(p, dim=-1) for p in torch.stack(updates).split(3, dim=-1))
    return {
        "translation_median": float(translation.median()),
        "rotation_deg_median": float(rotation.rad2deg().median()),
        "given": judge(stored.field, stored.bounds, given),
        "refined": judge(stored.field, stored.bounds, placed),
    }


def moved_median(updates: Sequence[Tensor | RowMotion | None]) -> dict[str, float] | None:
    """Return the median translation (metres) and rotation (degrees) of updates or motions; None if there are none."""
    known = [torch.as_tensor(update, dtype=torch.float64) for update in updates if update is not None]
    if not known:
        return None
    translation, rotation = torch.linalg.vector_norm(torch.stack(known).unflatten(-1, (2, 3)), dim=-1).T
    return {
        "translation": statistics.median(translation.tolist()),
        "rotation_deg": statistics.median(rotation.rad2deg().tolist()),
    }


def on_training_frames(stored: Map, data: Path) -> dict[str, float | None]:
    """Return the quality on a few training frames, at their poses in the map."""
    views = open_dataset(data, stored.bounds.background).views("train")
    return judge(
        stored.field, stored.bounds, apply_stored_poses(views, stored.info.cameras)[:: max(1, len(views) // 20)]
    )


def beside_dense(field: RadianceField, bounds: SceneBounds, views: list[View]) -> dict[str, Any] | None:
    """Return the quality of the field and of its slow ``dense`` counterpart on every fifth frame."""
    dense = getattr(field, "dense", None)
    if dense is None:
        return None
    return {name: judge(f, bounds, views[::5]) for name, f in (("field", field), ("dense", dense))}


def main() -> None:
    parser = _lab.parser(__doc__)
    parser.add_argument("data", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--keep", action="store_true", help="judge the map that is there already")
    parser.add_argument(
        "--without-depth", action="store_true", help="train on the colours of transforms_train.json alone"
    )
    parser.add_argument(
        "--test-frames-only",
        action="store_true",
        help="judge the levels on test frames at their given poses only",
    )
    parser.add_argument("--results", type=Path, default=_lab.RESULTS, help="folder of the record")
    parser.add_argument("--device", default="cpu", help="where images are rendered; to train there too: -- --device")
    words = sys.argv[1:]
    end = words.index("--") if "--" in words else len(words)
    given = parser.parse_args(words[:end])
    trained = train_without_depth if given.without_depth else train
    training = {} if given.keep else trained(given.data, given.out, words[end + 1 :])
    stored = load_map(given.out, given.device)
    views = open_dataset(given.data, stored.bounds.background).views("test")
    results = {
        "backend": stored.info.backend,
        "trained_without_depth": given.without_depth,
        "config": stored.info.config,
        "training": training,
        "training_seconds_in_map": stored.info.seconds,
        "map_MiB": sum(f.stat().st_size for f in given.out.iterdir()) / 2**20,
        "levels": [
            judge(level, stored.bounds, views if level is stored.field else views[::5])
            for level in levels(stored.field)
        ],
    }
    if stored.landmarks is not None:
        results["images_held_out_of_landmarks"] = to_plain(stored.landmarks.trial)
    if not given.test_frames_only:
        results["at_landmark_poses"] = at_landmark_poses(stored, views)
        results["training_frames"] = on_training_frames(stored, given.data)
    if stored.info.pose_refinement is not None:
        moved = moved_cameras(stored.info.cameras)
        results["pose_refinement"] = to_plain(stored.info.pose_refinement)
        results["pixels_moved_median"] = statistics.median(m.pixels for m in moved) if moved else 0.0
        results["moved_median"] = moved_median(refinement_updates(stored.info.cameras))
        results["motion_median"] = moved_median([camera.motion for camera in stored.info.cameras])
    if not given.test_frames_only and (compared := beside_dense(stored.field, stored.bounds, views)):
        results["beside_dense"] = compared
    _lab.record(given.name, results, stored.info.config.get("seed", 0), given.results)
    print({k: v for k, v in results.items() if k != "config"})


if __name__ == "__main__":
    main()
