"""Our poses and covariances, put through the formulae of other software, give the same residuals."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

import bidnerf as bn
from bidnerf.results import PosedImage, normalized_error_squared
from bidnerf_core.camera import CameraBatch, Intrinsics
from bidnerf_core.errors import InputError
from bidnerf_core.geometry import SE3
from bidnerf_core.localization import Localization, Outcome
from optional import require
from photo_files import noise, write_photo

CAMERA = Intrinsics(400.0, 410.0, 321.5, 238.0, 640, 480, (0.05, -0.02, 0.003, 0.004))
GENERATOR = torch.Generator().manual_seed(11)


def random(*shape: int) -> torch.Tensor:
    return torch.randn(shape, generator=GENERATOR, dtype=torch.float64)


FOUND = SE3.exp(random(6))
UPDATE = 1e-4 * random(6)
TRUE = FOUND.retract(UPDATE)
ROOT = random(6, 6)
COVARIANCE = 1e-6 * (ROOT @ ROOT.mT + 0.1 * torch.eye(6, dtype=torch.float64))


def found(covariance: torch.Tensor | None = COVARIANCE) -> Localization:
    return Localization(
        FOUND, Outcome.CONVERGED, "", 1, 0.1, 0.0, "auto", SE3.stack([FOUND]), torch.zeros(1), covariance
    )


def mahalanobis(residual: np.ndarray, covariance: torch.Tensor | None) -> float:
    return float(residual @ np.linalg.solve(require(covariance).numpy(), residual))


EXPECTED = float(normalized_error_squared(FOUND, TRUE, COVARIANCE))


def ros_residual() -> np.ndarray:
    """Positions and rotations about the fixed axes of the world, as geometry_msgs/PoseWithCovariance has it."""
    turn = Rotation.from_matrix((TRUE.rotation @ FOUND.rotation.mT).numpy()).as_euler("xyz")  # extrinsic
    return np.concatenate([(TRUE.translation - FOUND.translation).numpy(), turn])


def test_the_residual_in_ros_is_the_same() -> None:
    assert mahalanobis(ros_residual(), found().covariance_in("ros")) == pytest.approx(EXPECTED, rel=1e-3)
    assert mahalanobis(ros_residual(), found().covariance) != pytest.approx(EXPECTED, rel=0.1)


def test_the_residual_in_gtsam_is_the_same() -> None:
    """``Pose3::Logmap`` in closed form: rotation first, then V^-1 t, of the motion in the camera's frame."""
    between = FOUND.inverse() @ TRUE
    omega = Rotation.from_matrix(between.rotation.numpy()).as_rotvec()
    angle, w = float(np.linalg.norm(omega)), np.cross(np.eye(3), -omega).T
    t = between.translation.numpy()
    shift = t - 0.5 * w @ t + (1 - angle / (2 * np.tan(angle / 2))) / angle**2 * w @ w @ t
    residual = np.concatenate([omega, shift])
    assert mahalanobis(residual, found().covariance_in("GTSAM")) == pytest.approx(EXPECTED, rel=1e-9)


def test_gtsam_itself_agrees() -> None:
    gtsam = pytest.importorskip("gtsam")

    def pose(T: SE3) -> Any:
        return gtsam.Pose3(gtsam.Rot3.Quaternion(*T.quaternion("wxyz").tolist()), T.translation.numpy())

    covariance = require(found().covariance_in("gtsam"))
    np.testing.assert_allclose(pose(FOUND).matrix(), FOUND.matrix().numpy(), atol=1e-12)
    factor = gtsam.PriorFactorPose3(0, pose(FOUND), gtsam.noiseModel.Gaussian.Covariance(covariance.numpy()))
    values = gtsam.Values()
    values.insert(0, pose(TRUE))
    assert 2 * factor.error(values) == pytest.approx(EXPECTED, rel=1e-6)


@pytest.mark.parametrize("coefficients", [4, 5, 8, 12, 14])
def test_one_camera_is_undistorted_as_a_batch_is(coefficients: int) -> None:
    """OpenCV undistorts the pixels of one camera, kornia those of a batch of cameras."""
    lens = (0.1, -0.05, 0.001, 0.002, 0.01, 0.02, 0.01, 0.001, 0.001, 0.002, 0.001, 0.002, 0.02, 0.01)[:coefficients]
    camera = Intrinsics(400.0, 410.0, 321.5, 238.0, 640, 480, lens)
    pixels = torch.rand(500, 2, generator=GENERATOR, dtype=torch.float64) * torch.tensor([640.0, 480.0])
    batch = CameraBatch.of([camera]).unproject(pixels, torch.zeros(500, dtype=torch.long))
    torch.testing.assert_close(camera.unproject(pixels), batch, rtol=0, atol=1e-13)


@pytest.mark.parametrize("lens", [(), (0.05, -0.02, 0.003, 0.004), (0.05, -0.02, 0.003, 0.004, 0.01)])
def test_colmap_reads_our_images_txt(lens: tuple[float, ...], tmp_path: Path) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    camera = Intrinsics(400.0, 410.0, 321.5, 238.0, 640, 480, lens)
    files = [write_photo(tmp_path / "photos" / name, noise(12, 16), 1) for name in ("a/one.png", "b/one.png")]
    poses = [FOUND, TRUE @ SE3.exp(random(6))]
    images = [PosedImage(f"{n}", n, camera, T, file) for n, (T, file) in enumerate(zip(poses, files, strict=True))]
    (tmp_path / "model").mkdir()
    bn.write_poses(tmp_path / "model" / "images.txt", images)
    model = pycolmap.Reconstruction(str(tmp_path / "model"))
    read = [model.images[number] for number in (1, 2)]
    assert [image.name for image in read] == ["a/one.png", "b/one.png"]
    point = torch.tensor([0.3, -0.2, 2.0], dtype=torch.float64)
    for image, T in zip(read, poses, strict=True):
        world = T.apply(point)
        pose = image.cam_from_world() if callable(image.cam_from_world) else image.cam_from_world
        np.testing.assert_allclose(pose * world.numpy(), point.numpy(), atol=1e-9)
        pixel = model.cameras[image.camera_id].img_from_cam(point.numpy())
        np.testing.assert_allclose(pixel, camera.project(point).numpy(), atol=1e-6)
    bn.write_poses(tmp_path / "model" / "images.txt", images[:1])  # our own are replaced
    (tmp_path / "model" / "cameras.txt").write_text("# Camera list with one line of data per camera:\n")
    with pytest.raises(InputError, match=r"cameras\.txt: would be replaced"):
        bn.write_poses(tmp_path / "model" / "images.txt", images)


def test_quaternions_are_those_of_scipy() -> None:
    T = SE3.exp(3 * random(20, 6))
    ours = T.quaternion("xyzw")
    theirs = Rotation.from_matrix(T.rotation.numpy()).as_quat(canonical=True)
    np.testing.assert_allclose(ours.numpy(), theirs, atol=1e-9)
    assert torch.equal(T.quaternion("wxyz").roll(-1, dims=-1), ours)
    for order in ("xyzw", "wxyz"):
        back = SE3.from_quaternion(2 * T.quaternion(order), T.translation, order)
        torch.testing.assert_close(back.matrix(), T.matrix(), atol=1e-9, rtol=0)
    with pytest.raises(InputError, match="order is 'xyz'"):
        T.quaternion("xyz")  # type: ignore[arg-type]
    with pytest.raises(InputError, match="length 0"):
        SE3.from_quaternion(torch.zeros(4), torch.zeros(3), "xyzw")
