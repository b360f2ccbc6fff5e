"""The bridge localizes messages in the background, and the node runs on stand-ins of the packages of ROS."""

from __future__ import annotations

import sys
import time
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

import bags
from bidnerf import SE3, Localization, Outcome
from bidnerf_ros2 import node as nodes
from bidnerf_ros2.bridge import OK, WARN, Bridge, Estimate, diagnosis, fill_pose
from bidnerf_ros2.conversions import transform_of

POSE = SE3.exp(torch.tensor([0.1, 0.2, 0.3, 0.4, -0.5, 0.6], dtype=torch.float64))
COVARIANCE = torch.diag(torch.tensor([1e-4] * 3 + [1e-6] * 3, dtype=torch.float64))


def answer(outcome: Outcome = Outcome.CONVERGED, covariance: torch.Tensor | None = COVARIANCE) -> Localization:
    losses = torch.zeros(1, dtype=torch.float64)
    return Localization(POSE, outcome, "because", 1, 0.1, 0.0, "auto", SE3.stack([POSE]), losses, covariance)


class Standing:
    """A localizer that finds the same pose in every frame."""

    map = SimpleNamespace(has_distances=True)

    def __init__(self) -> None:
        self.starts: list[SE3 | None] = []

    def __call__(self, frame: Any, start: SE3 | None = None) -> Localization:
        self.starts.append(start)
        return answer()


def messages(stamp: float = 1.0) -> tuple[Any, Any, Any]:
    colour, depth = np.zeros((24, 32, 3), np.uint8), np.full((24, 32), 1500, np.uint16)
    return (
        bags.image(bags.ROS2, stamp, colour, "rgb8"),
        bags.camera_info(bags.ROS2, stamp, 30, 30, 15.5, 11.5, 32, 24),
        bags.image(bags.ROS2, stamp, depth, "16UC1"),
    )


def waited(bridge: Bridge) -> list[Estimate]:
    until = time.monotonic() + 10
    while not (found := bridge.answers()):
        assert time.monotonic() < until
        time.sleep(0.01)
    return found


def test_the_correction_belongs_to_the_odometry_of_the_image() -> None:
    localizer: Any = Standing()
    bridge = Bridge(localizer, has_odometry=True)
    T_odom_camera = SE3.exp(torch.tensor([1.0, 0, 0, 0, 0, 0.2], dtype=torch.float64))
    assert bridge.T_map_odom is None
    assert bridge.give(*messages(), T_odom_camera)
    (found,) = waited(bridge)
    assert (found.stamp.sec, found.stamp.nanosec) == (1, 0)
    bridge.close()
    correction = bridge.T_map_odom
    assert torch.allclose((correction @ T_odom_camera).matrix(), POSE.matrix())


def test_poses_have_the_covariance_of_their_frame() -> None:
    pose = SimpleNamespace(position=SimpleNamespace(), orientation=SimpleNamespace())
    message = SimpleNamespace(pose=pose, covariance=None)
    fill_pose(message, answer())
    assert torch.allclose(transform_of(pose).matrix(), POSE.matrix())
    assert np.reshape(message.covariance, (6, 6)) == pytest.approx(COVARIANCE.numpy())  # the same along all axes
    T_camera_base = SE3.exp(torch.tensor([0.0, 0.0, -2.0, 0, 0, 0], dtype=torch.float64))
    fill_pose(message, answer(), T_camera_base)
    assert np.trace(np.reshape(message.covariance, (6, 6))[:3, :3]) == pytest.approx(3e-4 + 2 * 2.0**2 * 1e-6)
    with pytest.raises(ValueError, match="without covariance"):
        fill_pose(message, answer(covariance=None))


def test_a_rejected_answer_is_a_warning() -> None:
    assert diagnosis(answer())[0] == OK
    level, text, values = diagnosis(answer(Outcome.AMBIGUOUS))
    assert (level, text) == (WARN, "ambiguous: because")
    assert values["sigma of position (m)"] == "0.0173"


class Anything:
    """A message, or anything else of ROS: attributes come into being when they are first used."""

    def __init__(self, *_: Any, **values: Any) -> None:
        self.__dict__.update(values)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        found = self.__dict__[name] = Anything()
        return found

    def __call__(self, *_: Any, **__: Any) -> Any:
        return Anything()


class FakeNode:
    parameters: dict[str, Any] = {}  # noqa: RUF012 (set by the test)

    def __init__(self, name: str) -> None:
        self.published: dict[str, list[Any]] = {}

    def declare_parameter(self, name: str, value: Any) -> Any:
        return SimpleNamespace(value=self.parameters.get(name, value))

    def create_publisher(self, kind: Any, topic: str, depth: int) -> Any:
        self.published[topic] = []
        return SimpleNamespace(publish=self.published[topic].append)

    def create_subscription(self, *_: Any) -> None: ...
    def create_timer(self, *_: Any) -> None: ...
    def destroy_node(self) -> None: ...
    def get_logger(self) -> Any:
        return Anything()

    def get_clock(self) -> Any:
        return Anything()


@pytest.fixture
def ros(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """Stand-ins for the packages of ROS; the list receives the transforms that are broadcast."""
    sent: list[Any] = []

    class TransformException(Exception): ...

    T_odom_camera = SimpleNamespace(
        transform=SimpleNamespace(
            translation=SimpleNamespace(x=1.0, y=0.0, z=0.0),
            rotation=SimpleNamespace(x=0.0, y=0.0, z=0.0, w=1.0),
        )
    )
    parts: dict[str, dict[str, Any]] = {
        "rclpy": {},
        "rclpy.duration": {"Duration": Anything},
        "rclpy.node": {"Node": FakeNode},
        "rclpy.qos": {"qos_profile_sensor_data": None},
        "message_filters": {"Subscriber": Anything, "ApproximateTimeSynchronizer": Anything},
        "tf2_ros": {
            "Buffer": lambda: SimpleNamespace(lookup_transform=lambda *_: T_odom_camera),
            "TransformListener": Anything,
            "TransformBroadcaster": lambda _: SimpleNamespace(sendTransform=sent.append),
            "TransformException": TransformException,
        },
        "diagnostic_msgs": {},
        "geometry_msgs": {},
        "sensor_msgs": {},
        "diagnostic_msgs.msg": dict.fromkeys(("DiagnosticArray", "DiagnosticStatus", "KeyValue"), Anything),
        "geometry_msgs.msg": dict.fromkeys(("PoseWithCovarianceStamped", "TransformStamped"), Anything),
        "sensor_msgs.msg": dict.fromkeys(("CameraInfo", "Image"), Anything),
    }
    for name, values in parts.items():
        module = ModuleType(name)
        vars(module).update(values)
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.setattr(sys.modules["rclpy"], "duration", sys.modules["rclpy.duration"], raising=False)
    monkeypatch.setattr(nodes, "load_map", lambda _: None)
    monkeypatch.setattr(nodes, "Localizer", lambda _: Standing())
    return sent


def test_the_node_publishes_poses_and_the_correction(ros: list[Any]) -> None:
    FakeNode.parameters = {"map": "MAP", "odom_frame": "odom"}
    node = nodes.make_node()
    image, info, depth = messages()
    node.on_image(image, depth)  # no camera info yet
    node.on_info(info)
    node.on_image(image, depth)
    until = time.monotonic() + 10
    while not node.published["pose"] and time.monotonic() < until:
        node.on_timer()
        time.sleep(0.01)
    node.destroy_node()
    node.on_timer()
    (pose,) = node.published["pose"]
    assert pose.header.frame_id == "map"
    assert pose.header.stamp.sec == 1
    assert torch.allclose(transform_of(pose.pose.pose).matrix(), POSE.matrix())
    (status,) = node.published["/diagnostics"][0].status
    assert status.level == b"\0"
    assert (ros[-1].header.frame_id, ros[-1].child_frame_id) == ("map", "odom")
    T_odom_camera = SE3(torch.eye(3, dtype=torch.float64), torch.tensor([1.0, 0, 0], dtype=torch.float64))
    assert torch.allclose((transform_of(ros[-1].transform) @ T_odom_camera).matrix(), POSE.matrix())


def test_messages_that_cannot_be_used_are_diagnosed(ros: list[Any]) -> None:
    FakeNode.parameters = {"map": "MAP", "odom_frame": "odom"}
    node = nodes.make_node()
    image, info, depth = messages()
    image.encoding = "bayer_rggb8"
    node.on_info(info)
    node.on_image(image, depth)
    (status,) = node.published["/diagnostics"][0].status
    assert status.level == bytes([2])
    assert "bayer_rggb8" in status.message
    node.destroy_node()
