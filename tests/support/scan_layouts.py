"""Captures in the layouts of phone apps and of data sets, written from views whose poses, cameras and depth are known."""

from __future__ import annotations

import csv
import json
import zipfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import lzfse
import numpy as np
from scipy.spatial.transform import Rotation

from bidnerf_core.frames import View

OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
START = 1000.0  # seconds
PERIOD = 0.25  # seconds from one frame to the next


def pixels(view: View) -> np.ndarray:
    return np.asarray((view.frame.rgb * 255).round()).astype(np.uint8)


def metres(view: View) -> np.ndarray:
    assert view.frame.depth is not None
    return np.asarray(view.frame.depth, dtype=np.float64)


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


def record3d_files(views: Sequence[View]) -> dict[str, bytes]:
    """The members of a ``.r3d`` archive by name."""
    camera, (cx, cy) = views[0].frame.intrinsics, centre(views[0])
    metadata: dict[str, Any] = {
        "w": camera.width, "h": camera.height, "dw": camera.width, "dh": camera.height, "fps": 4,
        "K": [camera.fx, 0, 0, 0, camera.fy, 0, cx, cy, 1],  # column by column
        "perFrameIntrinsicCoeffs": [[camera.fx, camera.fy, cx, cy] for _ in views],
        "poses": [[*quaternion(opengl(view)), *matrix(view)[:3, 3].tolist()] for view in views],
        "initPose": [0, 0, 0, 1, 0, 0, 0],
        "frameTimestamps": [START + PERIOD * number for number in range(len(views))],
    }  # fmt: skip
    files = {"metadata": json.dumps(metadata).encode(), "icon": b"\xff\xd8"}
    for number, view in enumerate(views):
        files[f"rgbd/{number}.jpg"] = iio.imwrite("<bytes>", pixels(view), extension=".jpg", quality=97)
        files[f"rgbd/{number}.depth"] = lzfse.compress(metres(view).astype("<f4").tobytes())
        files[f"rgbd/{number}.conf"] = lzfse.compress(np.full(metres(view).shape, 2, np.uint8).tobytes())
    return files


def write_record3d(folder: Path, views: Sequence[View]) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    with zipfile.ZipFile(folder / "scan.r3d", "w") as archive:
        for name, content in record3d_files(views).items():
            archive.writestr(name, content)
    return folder / "scan.r3d"


def write_unpacked_record3d(folder: Path, views: Sequence[View]) -> Path:
    for name, content in record3d_files(views).items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content)
    return folder


def write_polycam(folder: Path, views: Sequence[View], corrected: bool = True) -> Path:
    prefix = "corrected_" if corrected else ""
    for kind in (f"{prefix}images", f"{prefix}cameras", "depth", "confidence"):
        (folder / "keyframes" / kind).mkdir(parents=True, exist_ok=True)
    for number, view in enumerate(views):
        stem, base, pose = str(round((START + PERIOD * number) * 1e6)), folder / "keyframes", opengl(view)
        camera, (cx, cy) = view.frame.intrinsics, centre(view)
        description = {
            "fx": camera.fx,
            "fy": camera.fy,
            "cx": cx,
            "cy": cy,
            "width": camera.width,
            "height": camera.height,
        }
        description |= {
            f"t_{row}{column}": float(pose[row, column]) for row in range(3) for column in range(4)
        }
        (base / f"{prefix}cameras" / f"{stem}.json").write_text(
            json.dumps(description | {"blur_score": 90.0})
        )
        iio.imwrite(base / f"{prefix}images" / f"{stem}.jpg", pixels(view), quality=97)
        iio.imwrite(base / "depth" / f"{stem}.png", millimetres(view))
        iio.imwrite(base / "confidence" / f"{stem}.png", np.full(metres(view).shape, 255, np.uint8))
    return folder


def write_arkit_polycam(folder: Path, views: Sequence[View]) -> Path:
    return write_polycam(folder, views, corrected=False)


def write_stray_scanner(folder: Path, views: Sequence[View]) -> Path:
    for kind in ("depth", "confidence"):
        (folder / kind).mkdir(parents=True, exist_ok=True)
    write_video(folder / "rgb.mp4", [pixels(view) for view in views])
    rows = ["timestamp, frame, x, y, z, qx, qy, qz, qw"]
    for number, view in enumerate(views):
        numbers = [*matrix(view)[:3, 3].tolist(), *quaternion(matrix(view))]
        rows.append(", ".join([repr(START + PERIOD * number), f"{number:06d}", *map(repr, numbers)]))
        iio.imwrite(folder / "depth" / f"{number:06d}.png", millimetres(view))
        iio.imwrite(folder / "confidence" / f"{number:06d}.png", np.full(metres(view).shape, 2, np.uint8))
    (folder / "odometry.csv").write_text("\n".join(rows) + "\n")
    camera, (cx, cy) = views[0].frame.intrinsics, centre(views[0])
    (folder / "camera_matrix.csv").write_text(
        f"{camera.fx}, 0.0, {cx}\n0.0, {camera.fy}, {cy}\n0.0, 0.0, 1.0\n"
    )
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
            for packet in stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")):
                container.mux(packet)
        for packet in stream.encode():
            container.mux(packet)


def write_twelve_scenes(folder: Path, views: Sequence[View]) -> Path:
    (folder / "data").mkdir(parents=True, exist_ok=True)
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
    for number, view in enumerate(views):
        base = folder / "data" / f"frame-{number:06d}"
        iio.imwrite(f"{base}.color.jpg", pixels(view), quality=97)
        iio.imwrite(f"{base}.depth.png", millimetres(view))
        np.savetxt(f"{base}.pose.txt", matrix(view), fmt="%.12g")
    return folder


def write_reality_capture(folder: Path, views: Sequence[View]) -> Path:
    """The rotation is Rz(-heading) Rx(pitch) Ry(roll) of a camera with OpenGL axes."""
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / "cameras.csv").open("w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(
            [
                "#name",
                "x",
                "y",
                "alt",
                "heading",
                "pitch",
                "roll",
                "f",
                "px",
                "py",
                "k1",
                "k2",
                "k3",
                "k4",
                "t1",
                "t2",
            ]
        )
        for number, view in enumerate(views):
            camera = view.frame.intrinsics
            yaw, pitch, roll = Rotation.from_matrix(opengl(view)[:3, :3]).as_euler("ZXY", degrees=True)
            longer = max(camera.width, camera.height)
            shift = [(camera.cx - camera.width / 2) / longer, (camera.cy - camera.height / 2) / longer]
            place = matrix(view)[:3, 3].tolist()
            rows.writerow(
                [
                    f"{number}.png",
                    *place,
                    -yaw,
                    pitch,
                    roll,
                    36 * camera.fx / longer,
                    *shift,
                    0,
                    0,
                    0,
                    0,
                    0,
                    0,
                ]
            )
            iio.imwrite(folder / f"{number}.png", pixels(view))
    return folder


def write_kitti(folder: Path, views: Sequence[View]) -> Path:
    """Sequence 07, whose colour camera is 6 cm to the right of camera 0."""
    sequence = folder / "sequences" / "07"
    (sequence / "image_2").mkdir(parents=True, exist_ok=True)
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
    for number, view in enumerate(views):
        iio.imwrite(sequence / "image_2" / f"{number:06d}.png", pixels(view))
    return sequence


def write_euroc(folder: Path, views: Sequence[View]) -> Path:
    """The camera is turned and moved on the body, and the truth has samples 3 ms before and after each image."""
    body = np.eye(4)
    body[:3, :3], body[:3, 3] = Rotation.from_euler("xyz", [0.2, -0.1, 1.5]).as_matrix(), [0.1, -0.02, 0.03]
    cam, truth = folder / "mav0" / "cam0", folder / "mav0" / "state_groundtruth_estimate0"
    (cam / "data").mkdir(parents=True)
    truth.mkdir()
    camera, (cx, cy) = views[0].frame.intrinsics, centre(views[0])
    rows = ",\n         ".join(", ".join(map(repr, row)) for row in body.tolist())
    (cam / "sensor.yaml").write_text(
        f"# General sensor definitions.\nsensor_type: camera\nT_BS:\n  cols: 4\n  rows: 4\n  data: [{rows}]\n"
        f"rate_hz: 20\nresolution: [{camera.width}, {camera.height}]\ncamera_model: pinhole\n"
        f"intrinsics: [{camera.fx}, {camera.fy}, {cx}, {cy}] #fu, fv, cu, cv\n"
        "distortion_model: radial-tangential\ndistortion_coefficients: [0.0, 0.0, 0.0, 0.0]\n"
    )
    images, poses = (
        ["#timestamp [ns],filename"],
        ["#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x []"],
    )
    for number, view in enumerate(views):
        stamp = 1403636579763555584 + round(PERIOD * number * 1e9)
        images.append(f"{stamp},{stamp}.png")
        iio.imwrite(cam / "data" / f"{stamp}.png", pixels(view))
        pose = matrix(view) @ np.linalg.inv(body)
        x, y, z, w = quaternion(pose)
        for offset in (-3_000_000, 3_000_000):
            numbers = [*pose[:3, 3].tolist(), w, x, y, z, *[0.0] * 9]
            poses.append(",".join([str(stamp + offset), *map(repr, numbers)]))
    (cam / "data.csv").write_text("\r\n".join(images) + "\r\n")
    (truth / "data.csv").write_text("\n".join(poses) + "\n")
    return folder


LAYOUTS: dict[str, tuple[str, Callable[[Path, Sequence[View]], Path], bool, bool]] = {
    "record3d": ("record3d", write_record3d, True, True),
    "record3d, unpacked": ("record3d", write_unpacked_record3d, True, True),
    "polycam": ("polycam", write_polycam, True, True),
    "polycam, not corrected": ("polycam", write_arkit_polycam, True, True),
    "stray-scanner": ("stray-scanner", write_stray_scanner, True, True),
    "twelve-scenes": ("twelve-scenes", write_twelve_scenes, True, False),
    "reality-capture": ("reality-capture", write_reality_capture, False, False),
    "kitti": ("kitti", write_kitti, False, True),
    "euroc": ("euroc", write_euroc, False, True),
}
"""The reader, what writes the layout, and whether it has depth and times."""
