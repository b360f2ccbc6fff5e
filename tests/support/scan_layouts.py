"""Captures in the layouts of phone apps and of data sets, written from views whose poses, cameras and depth are known."""

from __future__ import annotations

import json
import shutil
import warnings
import zipfile
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import imageio.v3 as iio
import lzfse
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from bidnerf_core.camera import Intrinsics
from bidnerf_core.datasets import open_dataset, open_sequence
from bidnerf_core.errors import InputError
from bidnerf_core.frames import Frame, View
from bidnerf_core.geometry import SE3
from optional import require
from sparse_model import to_binary, write_model
from tum_folder import Recorded, write_recording

OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
START = 1000.0  # seconds
PERIOD = 0.25  # seconds from one frame to the next
SMALL = Intrinsics(20.0, 21.0, 8.5, 6.25, 16, 12)


def small_views(count: int) -> list[View]:
    """Views of noise, with depth of 0.5 to 3 m in whole millimetres and random poses."""
    generator = torch.Generator().manual_seed(7)
    found = []
    for number in range(count):
        rgb = torch.randint(0, 256, (SMALL.height, SMALL.width, 3), generator=generator) / 255
        depth = torch.randint(500, 3000, (SMALL.height, SMALL.width), generator=generator) / 1000
        pose = SE3.exp(torch.randn(6, generator=generator, dtype=torch.float64))
        found.append(View(Frame(f"r_{number}", rgb, SMALL, depth), pose))
    return found


def pixels(view: View) -> np.ndarray:
    return np.asarray((view.frame.rgb * 255).round()).astype(np.uint8)


def metres(view: View) -> np.ndarray:
    return np.asarray(require(view.frame.depth), dtype=np.float64)


def millimetres(view: View) -> np.ndarray:
    return (metres(view) * 1000).round().astype(np.uint16)


def matrix(view: View) -> np.ndarray:
    """Camera to world, OpenCV axes."""
    return np.asarray(view.T_ref_camera.matrix())


def opengl(view: View) -> np.ndarray:
    return matrix(view) @ OPENGL


def quaternion(pose: np.ndarray) -> list[float]:
    return Rotation.from_matrix(pose[:3, :3]).as_quat().tolist()


def centre(view: View) -> tuple[float, float]:
    """The principal point, counted from the centre of the upper left pixel."""
    return view.frame.intrinsics.cx - 0.5, view.frame.intrinsics.cy - 0.5


def camera_keys(camera: Intrinsics) -> dict[str, float]:
    """The camera in the keys of ``transforms.json`` and ``camera.json``."""
    keys = {"fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx, "cy": camera.cy}
    lens = zip(("k1", "k2", "p1", "p2", "k3"), camera.distortion, strict=False)
    return {**keys, "w": camera.width, "h": camera.height, **dict(lens)}


def write_image(file: Path, image: np.ndarray) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    iio.imwrite(file, image, **({"quality": 97} if file.suffix == ".jpg" else {}))


# Phone apps


def record3d_files(views: Sequence[View]) -> dict[str, bytes]:
    """The members of a ``.r3d`` archive by name."""
    camera, (cx, cy) = views[0].frame.intrinsics, centre(views[0])
    metadata: dict[str, Any] = {
        "w": camera.width,
        "h": camera.height,
        "dw": camera.width,
        "dh": camera.height,
        "fps": 4,
        "K": [camera.fx, 0, 0, 0, camera.fy, 0, cx, cy, 1],  # column by column
        "perFrameIntrinsicCoeffs": [[camera.fx, camera.fy, cx, cy] for _ in views],
        "poses": [[*quaternion(opengl(view)), *matrix(view)[:3, 3].tolist()] for view in views],
        "initPose": [0, 0, 0, 1, 0, 0, 0],
        "frameTimestamps": [START + PERIOD * number for number in range(len(views))],
    }
    files = {"metadata": json.dumps(metadata).encode(), "icon": b"\xff\xd8"}
    for number, view in enumerate(views):
        files[f"rgbd/{number}.jpg"] = iio.imwrite("<bytes>", pixels(view), extension=".jpg", quality=97)
        files[f"rgbd/{number}.depth"] = lzfse.compress(metres(view).astype("<f4").tobytes())
        files[f"rgbd/{number}.conf"] = lzfse.compress(np.full(metres(view).shape, 2, np.uint8).tobytes())
    return files


def packed(folder: Path, files: dict[str, bytes], compression: int = zipfile.ZIP_STORED) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    with zipfile.ZipFile(folder / "scan.r3d", "w", compression) as archive:
        for name, content in files.items():
            archive.writestr(name, content)
    return folder / "scan.r3d"


def write_unpacked_record3d(folder: Path, views: Sequence[View]) -> Path:
    for name, content in record3d_files(views).items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content)
    return folder


def write_record3d_of_exr(folder: Path, views: Sequence[View]) -> Path:
    """Write the export as EXR files, of which depth is not read."""
    for name, content in record3d_files(views).items():
        if name == "metadata" or name.endswith(".jpg"):
            file = folder / name.replace("metadata", "metadata.json").replace("rgbd", "rgb")
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_bytes(content)
    (folder / "depth").mkdir()
    return folder


def write_polycam(folder: Path, views: Sequence[View], corrected: bool = True) -> Path:
    base, prefix = folder / "keyframes", "corrected_" if corrected else ""
    (base / f"{prefix}cameras").mkdir(parents=True, exist_ok=True)
    for number, view in enumerate(views):
        stem, pose = str(round((START + PERIOD * number) * 1e6)), opengl(view)
        camera, (cx, cy) = view.frame.intrinsics, centre(view)
        description: dict[str, float] = {"fx": camera.fx, "fy": camera.fy, "cx": cx, "cy": cy}
        description |= {"width": camera.width, "height": camera.height, "blur_score": 90.0}
        description |= {f"t_{row}{column}": pose[row, column] for row in range(3) for column in range(4)}
        (base / f"{prefix}cameras" / f"{stem}.json").write_text(json.dumps(description))
        write_image(base / f"{prefix}images" / f"{stem}.jpg", pixels(view))
        write_image(base / "depth" / f"{stem}.png", millimetres(view))
        write_image(base / "confidence" / f"{stem}.png", np.full(metres(view).shape, 255, np.uint8))
    return folder


def write_stray_scanner(folder: Path, views: Sequence[View]) -> Path:
    rows = ["timestamp, frame, x, y, z, qx, qy, qz, qw"]
    for number, view in enumerate(views):
        numbers = [*matrix(view)[:3, 3].tolist(), *quaternion(matrix(view))]
        rows.append(", ".join([repr(START + PERIOD * number), f"{number:06d}", *map(repr, numbers)]))
        write_image(folder / "depth" / f"{number:06d}.png", millimetres(view))
        write_image(folder / "confidence" / f"{number:06d}.png", np.full(metres(view).shape, 2, np.uint8))
    write_video(folder / "rgb.mp4", [pixels(view) for view in views])
    (folder / "odometry.csv").write_text("\n".join(rows) + "\n")
    camera, (cx, cy) = views[0].frame.intrinsics, centre(views[0])
    (folder / "camera_matrix.csv").write_text(f"{camera.fx}, 0.0, {cx}\n0.0, {camera.fy}, {cy}\n0.0, 0.0, 1.0\n")
    return folder


def write_video(file: Path, images: Sequence[np.ndarray], rate: int = 4) -> None:
    """Write images as a video of the highest quality, with a key frame every fifth."""
    import av

    with av.open(str(file), "w") as container:
        stream = container.add_stream("mpeg4", rate=rate)
        stream.height, stream.width = images[0].shape[:2]
        stream.pix_fmt, stream.codec_context.gop_size = "yuv420p", 5
        stream.codec_context.qmin = stream.codec_context.qmax = 1
        for image in images:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        container.mux(stream.encode())


# Data sets


def write_tum(folder: Path, views: Sequence[View], start: float = START, period: float = PERIOD) -> Path:
    """A recording of the TUM RGB-D benchmark whose folder has its camera."""
    write_recording(folder, [Recorded(start + period * number, view) for number, view in enumerate(views)])
    (folder / "camera.json").write_text(json.dumps(camera_keys(views[0].frame.intrinsics)))
    return folder


def write_seven_scenes(folder: Path, views: Sequence[View]) -> Path:
    """A sequence whose depth is that of the colour camera."""
    write_frames(folder, views, "png")
    (folder / "camera.json").write_text(json.dumps(camera_keys(views[0].frame.intrinsics)))
    return folder


def write_twelve_scenes(folder: Path, views: Sequence[View]) -> Path:
    write_frames(folder / "data", views, "jpg")
    camera, (cx, cy) = views[0].frame.intrinsics, centre(views[0])
    calibration = f"{camera.fx} 0 {cx} 0 0 {camera.fy} {cy} 0 0 0 1 0 0 0 0 1"
    lines = ["m_versionNumber = 4", "m_sensorName = StructureSensor"]
    for kind in ("color", "depth"):
        lines += [f"m_{kind}Width = {camera.width}", f"m_{kind}Height = {camera.height}"]
        lines += [f"m_calibration{kind.capitalize()}Intrinsic = {calibration}"]
    (folder / "info.txt").write_text("\n".join(lines) + "\n")
    last = len(views) - 1
    (folder / "split.txt").write_text(
        f"sequence0 [frames=2]  [start=0 ; end=1]\nsequence1 [frames={last - 1}]  [start=2 ; end={last}]\n"
    )
    return folder


def write_frames(folder: Path, views: Sequence[View], suffix: str) -> None:
    for number, view in enumerate(views):
        stem = f"frame-{number:06d}"
        write_image(folder / f"{stem}.color.{suffix}", pixels(view))
        write_image(folder / f"{stem}.depth.png", millimetres(view))
        np.savetxt(folder / f"{stem}.pose.txt", matrix(view), fmt="%.17g")


def write_reality_capture(folder: Path, views: Sequence[View]) -> Path:
    """The rotation is Rz(-heading) Rx(pitch) Ry(roll) of a camera with OpenGL axes."""
    rows = ["#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2"]
    for number, view in enumerate(views):
        camera = view.frame.intrinsics
        yaw, pitch, roll = Rotation.from_matrix(opengl(view)[:3, :3]).as_euler("ZXY", degrees=True)
        longer = max(camera.width, camera.height)
        shift = [(camera.cx - camera.width / 2) / longer, (camera.cy - camera.height / 2) / longer]
        numbers = [*matrix(view)[:3, 3], -yaw, pitch, roll, 36 * camera.fx / longer, *shift, *[0] * 6]
        rows.append(",".join([f"{number}.png", *map(str, numbers)]))
        write_image(folder / f"{number}.png", pixels(view))
    (folder / "cameras.csv").write_text("\n".join(rows) + "\n", newline="\r\n")
    return folder


def write_kitti(folder: Path, views: Sequence[View]) -> Path:
    """Sequence 07, whose colour camera is 6 cm to the right of camera 0."""
    sequence = folder / "sequences" / "07"
    for number, view in enumerate(views):
        write_image(sequence / "image_2" / f"{number:06d}.png", pixels(view))
    (folder / "poses").mkdir()
    camera, (cx, cy) = views[0].frame.intrinsics, centre(views[0])
    shift = np.eye(4)
    shift[0, 3] = 0.06  # of camera 2 in camera 0
    projections = [
        f"P{number}: {camera.fx} 0 {cx} {-camera.fx * 0.06 * (number == 2)} 0 {camera.fy} {cy} 0 0 0 1 0"
        for number in range(4)
    ]
    (sequence / "calib.txt").write_text("\n".join([*projections, "Tr: 1 0 0 0 0 1 0 0 0 0 1 0"]) + "\n")
    (sequence / "times.txt").write_text("".join(f"{PERIOD * number:e}\n" for number in range(len(views))))
    poses = [(matrix(view) @ np.linalg.inv(shift))[:3].ravel() for view in views]
    np.savetxt(folder / "poses" / "07.txt", poses, fmt="%.12g")
    return sequence


def write_euroc(folder: Path, views: Sequence[View]) -> Path:
    """The camera is turned and moved on the body, and the truth has samples 3 ms before and after each image."""
    body = np.eye(4)
    body[:3, :3], body[:3, 3] = Rotation.from_euler("xyz", [0.2, -0.1, 1.5]).as_matrix(), [0.1, -0.02, 0.03]
    cam, truth = folder / "mav0" / "cam0", folder / "mav0" / "state_groundtruth_estimate0"
    images = ["#timestamp [ns],filename"]
    poses = ["#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x []"]
    for number, view in enumerate(views):
        stamp = 1403636579763555584 + round(PERIOD * number * 1e9)
        images.append(f"{stamp},{stamp}.png")
        write_image(cam / "data" / f"{stamp}.png", pixels(view))
        pose = matrix(view) @ np.linalg.inv(body)
        x, y, z, w = quaternion(pose)
        for offset in (-3_000_000, 3_000_000):
            numbers = [*pose[:3, 3].tolist(), w, x, y, z, *[0.0] * 9]
            poses.append(",".join([str(stamp + offset), *map(repr, numbers)]))
    truth.mkdir()
    (cam / "data.csv").write_text("\n".join(images) + "\n", newline="\r\n")
    (truth / "data.csv").write_text("\n".join(poses) + "\n")
    camera, (cx, cy) = views[0].frame.intrinsics, centre(views[0])
    rows = ",\n         ".join(", ".join(map(repr, row)) for row in body.tolist())
    (cam / "sensor.yaml").write_text(
        f"# General sensor definitions.\nsensor_type: camera\nT_BS:\n  cols: 4\n  rows: 4\n  data: [{rows}]\n"
        f"rate_hz: 20\nresolution: [{camera.width}, {camera.height}]\ncamera_model: pinhole\n"
        f"intrinsics: [{camera.fx}, {camera.fy}, {cx}, {cy}] #fu, fv, cu, cv\n"
        "distortion_model: radial-tangential\ndistortion_coefficients: [0.0, 0.0, 0.0, 0.0]\n"
    )
    return folder


# What other programs write


def write_nerfstudio(folder: Path, views: Sequence[View]) -> Path:
    """Write images, depth, and one ``transforms.json``."""
    content: dict[str, Any] = {
        "camera_model": "OPENCV",
        **camera_keys(views[0].frame.intrinsics),
        "frames": [],
    }
    for view in views:
        frame = {"file_path": f"images/{view.frame.name}.png", "transform_matrix": opengl(view).tolist()}
        write_image(folder / frame["file_path"], pixels(view))
        if view.frame.depth is not None:
            frame["depth_file_path"] = f"depth/{view.frame.name}.png"
            write_image(folder / frame["depth_file_path"], millimetres(view))
        content["frames"].append(frame)
    (folder / "transforms.json").write_text(json.dumps(content))
    return folder


def edit_keys(file: Path, **changes: Any) -> None:
    """Set keys of a JSON object; None takes them away."""
    new = json.loads(file.read_text()) | changes
    file.write_text(json.dumps({key: value for key, value in new.items() if value is not None}))


def edit_frame(file: Path, number: int = 1, **changes: Any) -> None:
    """Set keys of a frame of ``transforms.json``; None takes them away."""
    frames = json.loads(file.read_text())["frames"]
    frames[number] = {k: v for k, v in (frames[number] | changes).items() if v is not None}
    edit_keys(file, frames=frames)


def write_scannet_pp(folder: Path, views: Sequence[View]) -> Path:
    """Write a scene of ScanNet++, whose last image is the test, beside undistorted copies of the images."""
    data = write_nerfstudio(folder / "dslr/nerfstudio", views)
    frames = json.loads((data / "transforms.json").read_text())["frames"]
    named = [{**frame, "file_path": Path(frame["file_path"]).name, "depth_file_path": None} for frame in frames]
    edit_keys(data / "transforms.json", frames=named[:-1], test_frames=named[-1:])
    shutil.copytree(data / "images", folder / "dslr/resized_undistorted_images")
    (data / "images").rename(folder / "dslr/resized_images")
    return folder


def write_colmap(folder: Path, views: Sequence[View], binary: bool = False) -> Path:
    """A project without points."""
    camera, names = views[0].frame.intrinsics, [f"{view.frame.name}.png" for view in views]
    for name, view in zip(names, views, strict=True):
        write_image(folder / "images" / name, pixels(view))
    lens = [*camera.distortion, 0, 0, 0, 0][:4]
    numbers = [camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy, *lens]
    posed = [(name, 1, view.T_ref_camera, "1.5 2.5 -1") for name, view in zip(names, views, strict=True)]
    write_model(folder / "sparse/0", [f"1 OPENCV {' '.join(map(str, numbers))}"], posed)
    if binary:
        to_binary(folder / "sparse/0")
    return folder


def write_scannet(folder: Path, views: Sequence[View]) -> Path:
    camera, (cx, cy) = views[0].frame.intrinsics, centre(views[0])
    (folder / "pose").mkdir()
    (folder / "intrinsic").mkdir()
    for number, view in enumerate(views):
        write_image(folder / "color" / f"{number}.jpg", pixels(view))
        write_image(folder / "depth" / f"{number}.png", millimetres(view))
        np.savetxt(folder / "pose" / f"{number}.txt", matrix(view), fmt="%.17g")
    intrinsics = np.array([[camera.fx, 0, cx, 0], [0, camera.fy, cy, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    for kind in ("color", "depth"):
        np.savetxt(folder / "intrinsic" / f"intrinsic_{kind}.txt", intrinsics, fmt="%.17g")
    return folder


def write_llff(folder: Path, views: Sequence[View]) -> Path:
    """The axes of the pose point down, right and backwards; the principal point is the centre."""
    camera, rows = views[0].frame.intrinsics, []
    for number, view in enumerate(views):
        write_image(folder / "images" / f"{number:03d}.png", pixels(view))
        right, down, forward, position = matrix(view)[:3].T
        about = np.array([camera.height, camera.width, camera.fx])
        rows.append([*np.stack([down, right, -forward, position, about], 1).ravel(), 0.1, 9.0])
    np.save(folder / "poses_bounds.npy", np.array(rows))
    return folder


def write_replica(folder: Path, views: Sequence[View]) -> Path:
    camera, (cx, cy) = views[0].frame.intrinsics, centre(views[0])
    for number, view in enumerate(views):
        write_image(folder / "room0/results" / f"frame{number:06d}.jpg", pixels(view))
        write_image(folder / "room0/results" / f"depth{number:06d}.png", millimetres(view))
    about = {
        "w": camera.width,
        "h": camera.height,
        "fx": camera.fx,
        "fy": camera.fy,
        "cx": cx,
        "cy": cy,
        "scale": 1000.0,
    }
    (folder / "cam_params.json").write_text(json.dumps({"camera": about}))
    np.savetxt(folder / "room0/traj.txt", [matrix(view).ravel() for view in views], fmt="%.17g")
    return folder / "room0"


def write_opensfm(folder: Path, views: Sequence[View]) -> Path:
    camera = views[0].frame.intrinsics
    side = max(camera.width, camera.height)
    about = {
        "projection_type": "brown",
        "width": camera.width,
        "height": camera.height,
        "focal_x": camera.fx / side,
        "focal_y": camera.fy / side,
        "c_x": (camera.cx - camera.width / 2) / side,
        "c_y": (camera.cy - camera.height / 2) / side,
        **dict(zip(("k1", "k2", "p1", "p2", "k3"), (*camera.distortion, *[0.0] * 5), strict=False)),
    }
    shots = {}
    for number, view in enumerate(views):
        write_image(folder / "images" / f"{number}.png", pixels(view))
        T = np.linalg.inv(matrix(view))
        turn = Rotation.from_matrix(T[:3, :3]).as_rotvec().tolist()
        time = START + PERIOD * number
        shots[f"{number}.png"] = {
            "rotation": turn,
            "translation": T[:3, 3].tolist(),
            "camera": "c",
            "capture_time": time,
        }
    (folder / "reconstruction.json").write_text(json.dumps([{"cameras": {"c": about}, "shots": shots}]))
    return folder


def write_metashape(folder: Path, views: Sequence[View]) -> Path:
    camera = views[0].frame.intrinsics
    k1, k2, p1, p2, k3 = (*camera.distortion, *[0.0] * 5)[:5]
    values = {
        "f": camera.fy,
        "b1": camera.fx - camera.fy,
        "cx": camera.cx - camera.width / 2,
        "cy": camera.cy - camera.height / 2,
        "k1": k1,
        "k2": k2,
        "k3": k3,
        "p1": p2,
        "p2": p1,
    }
    size = f'<resolution width="{camera.width}" height="{camera.height}"/>'
    lens = "".join(f"<{key}>{value}</{key}>" for key, value in values.items())
    cameras = ""
    for number, view in enumerate(views):
        write_image(folder / "images" / f"IMG_{number}.png", pixels(view))
        rows = " ".join(map(repr, matrix(view).ravel().tolist()))
        cameras += f'<camera id="{number}" sensor_id="0" label="IMG_{number}"><transform>{rows}</transform></camera>'
    sensor = f'<sensor id="0" type="frame">{size}<calibration type="frame" class="adjusted">{size}{lens}</calibration></sensor>'
    chunk = f"<chunk><sensors>{sensor}</sensors><cameras>{cameras}</cameras></chunk>"
    (folder / "cameras.xml").write_text(
        f'<?xml version="1.0" encoding="UTF-8"?><document version="2.0.0">{chunk}</document>'
    )
    return folder


def write_ace(folder: Path, views: Sequence[View], nsvf: bool = False, split: str = "") -> Path:
    """Images of one split, or in the folder itself, with their calibrations as matrices."""
    part = folder / split
    for number, view in enumerate(views):
        name = f"frame_{number:05d}"
        write_image(part / "rgb" / f"{name}.png", pixels(view))
        write_image(part / "depth" / f"{name}.png", millimetres(view))
        calibration = part / "intrinsics.txt" if nsvf else part / "calibration" / f"{name}.txt"
        pose = part / ("pose" if nsvf else "poses") / f"{name}.txt"
        for file, numbers in ((pose, matrix(view)), (calibration, view.frame.intrinsics.matrix())):
            file.parent.mkdir(parents=True, exist_ok=True)
            np.savetxt(file, numbers, fmt="%.17g")
    return folder


def write_cambridge(folder: Path, views: Sequence[View]) -> Path:
    """Every eighth frame, the first among them, is a test; the model lists other endings than those of the images."""
    listed: dict[str, list[str]] = {"train": [], "test": []}
    model = []
    for number, view in enumerate(views):
        write_image(folder / "seq1" / f"frame{number:05d}.png", pixels(view))
        x, y, z, w = quaternion(np.linalg.inv(matrix(view)))
        centre_of_camera = " ".join(map(repr, matrix(view)[:3, 3].tolist()))
        listed["train" if number % 8 else "test"].append(
            f"seq1/frame{number:05d}.png {centre_of_camera} {w} {x} {y} {z}"
        )
        model.append(f"seq1/frame{number:05d}.jpg\t{view.frame.intrinsics.fx} {w} {x} {y} {z} {centre_of_camera} 0 0")
    for split, rows in listed.items():
        head = ["Visual Landmark Dataset V1", "ImageFile, Camera Position [X Y Z W P Q R]", ""]
        (folder / f"dataset_{split}.txt").write_text("\n".join([*head, *rows]) + "\n")
    (folder / "reconstruction.nvm").write_text("\n".join(["NVM_V3", "", f"{len(views)}", *model, "", "0"]) + "\n")
    return folder


def write_vsfm(folder: Path, views: Sequence[View]) -> Path:
    """A model of VisualSFM alone."""
    write_cambridge(folder, views)
    for split in ("train", "test"):
        (folder / f"dataset_{split}.txt").unlink()
    return folder


def write_map_free(folder: Path, views: Sequence[View]) -> Path:
    poses, intrinsics = ["# frame qw qx qy qz tx ty tz"], []
    for number, view in enumerate(views):
        name, c, T = f"seq1/frame_{number:05d}.jpg", view.frame.intrinsics, np.linalg.inv(matrix(view))
        write_image(folder / name, pixels(view))
        x, y, z, w = quaternion(T)
        poses.append(f"{name} {w} {x} {y} {z} {' '.join(map(repr, T[:3, 3].tolist()))}")
        intrinsics.append(f"{name} {c.fx} {c.fy} {c.cx} {c.cy} {c.width} {c.height}")
    (folder / "poses.txt").write_text("\n".join(poses) + "\n")
    (folder / "intrinsics.txt").write_text("\n".join(intrinsics) + "\n")
    return folder


def write_rtabmap(folder: Path, views: Sequence[View], of_robot: bool = False) -> Path:
    """Write an export of RTAB-Map; ``of_robot``: with poses of a robot, on which the camera is turned and moved."""
    T_robot_camera = np.eye(4)
    T_robot_camera[:3] = [[0, 0, 1, 0.1], [-1, 0, 0, 0.02], [0, -1, 0, 0.3]]
    rows, camera, (cx, cy) = ["#timestamp x y z qx qy qz qw id"], views[0].frame.intrinsics, centre(views[0])
    (folder / "rtabmap_calib").mkdir(parents=True)
    for number, view in enumerate(views):
        stamp, pose = f"{START + PERIOD * number:.6f}", matrix(view)
        if of_robot:
            pose = pose @ np.linalg.inv(T_robot_camera)
        rows.append(" ".join([stamp, *map(repr, [*pose[:3, 3].tolist(), *quaternion(pose)]), str(number + 1)]))
        write_image(folder / "rtabmap_rgb" / f"{stamp}.jpg", pixels(view))
        write_image(folder / "rtabmap_depth" / f"{stamp}.png", millimetres(view))
        (folder / "rtabmap_calib" / f"{stamp}.yaml").write_text(
            f"%YAML:1.0\n---\nimage_width: {camera.width}\nimage_height: {camera.height}\n"
            f"camera_matrix:\n   rows: 3\n   cols: 3\n   data: [ {camera.fx}, 0., {cx}, 0., {camera.fy}, {cy}, 0., 0., 1. ]\n"
            f"local_transform:\n   rows: 3\n   cols: 4\n   data: {T_robot_camera[:3].ravel().tolist()}\n"
        )
    (folder / f"rtabmap_{'' if of_robot else 'camera_'}poses.txt").write_text("\n".join(rows) + "\n")
    return folder


class Layout(NamedTuple):
    reader: str
    write: Callable[[Path, Sequence[View]], Path]
    depth: bool = True
    times: bool = False
    lossless: bool = True  # 8 bits of colour come back as they were
    unit: str | None = "metres"
    options: Mapping[str, Any] = MappingProxyType({})  # of ``open_dataset``


LAYOUTS = {
    "record3d": Layout(
        "record3d", lambda folder, views: packed(folder, record3d_files(views)), times=True, lossless=False
    ),
    "record3d, unpacked": Layout("record3d", write_unpacked_record3d, times=True, lossless=False),
    "record3d, EXR": Layout("record3d", write_record3d_of_exr, depth=False, times=True, lossless=False),
    "polycam": Layout("polycam", write_polycam, times=True, lossless=False),
    "polycam, not corrected": Layout("polycam", partial(write_polycam, corrected=False), times=True, lossless=False),
    "stray-scanner": Layout("stray-scanner", write_stray_scanner, times=True, lossless=False),
    "tum": Layout("tum", write_tum, times=True),
    "seven-scenes": Layout("seven-scenes", write_seven_scenes, options={"register_depth": False}),
    "twelve-scenes": Layout("twelve-scenes", write_twelve_scenes, lossless=False),
    "reality-capture": Layout("reality-capture", write_reality_capture, depth=False, unit=None),
    "kitti": Layout("kitti", write_kitti, depth=False, times=True),
    "euroc": Layout("euroc", write_euroc, depth=False, times=True),
    "scannet": Layout("scannet", write_scannet, lossless=False),
    "replica": Layout("replica", write_replica, lossless=False),
    "llff": Layout("llff", write_llff, depth=False, unit=None),
    "opensfm": Layout("opensfm", write_opensfm, depth=False, times=True, unit=None),
    "metashape": Layout("metashape", write_metashape, depth=False, unit=None),
    "ace": Layout("ace", write_ace),
    "nsvf": Layout("ace", partial(write_ace, nsvf=True)),
    "cambridge": Layout("cambridge", write_cambridge, depth=False),
    "vsfm": Layout("cambridge", write_vsfm, depth=False, unit=None),
    "map-free": Layout("cambridge", write_map_free, depth=False, lossless=False),
    "rtabmap": Layout("rtabmap", write_rtabmap, times=True, lossless=False),
    "rtabmap, of a robot": Layout("rtabmap", partial(write_rtabmap, of_robot=True), times=True, lossless=False),
    "transforms": Layout("transforms", write_nerfstudio, unit=None),
    "colmap": Layout("colmap", write_colmap, depth=False, unit=None),
    "colmap, binary": Layout("colmap", partial(write_colmap, binary=True), depth=False, unit=None),
}


# What is said of them


def read_all(folder: Path, **options: Any) -> dict[str, View]:
    """Return all views of a dataset by name."""
    dataset = open_dataset(folder, **options)
    return {view.frame.name: view for split in dataset.splits for view in dataset.views(split)}


def every_frame(folder: Path, **options: Any) -> object:
    return list(open_sequence(folder, **options))


def remarks_of(folder: Path, **options: Any) -> list[str]:
    """Return the remarks that opening and reading a dataset causes."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        read_all(folder, **options)
    said = [str(warning.message) for warning in caught]
    assert not any("\n" in text for text in said)
    return said


def message(folder: Path, read: Callable[..., object] = read_all, **options: Any) -> str:
    """Return the one line that is said of a capture that cannot be read, which names it."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with pytest.raises(InputError) as caught:
            read(folder, **options)
    assert "\n" not in str(caught.value)
    assert str(folder) in str(caught.value)
    return str(caught.value)
