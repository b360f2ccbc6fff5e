"""The ROS 2 node: images, camera infos, depth and TF in; poses with covariances, TF and diagnostics out.

It needs a ROS 2 installation (``rclpy``, ``tf2_ros``, ``message_filters``); all computations are in
``bridge`` and ``conversions``.
"""

from __future__ import annotations

from typing import Any

import torch

from bidnerf_core.errors import InputError
from bidnerf_core.maps import Localizer, load_map
from bidnerf_ros2.bridge import ERROR, Bridge, Estimate, diagnosis, fill_pose
from bidnerf_ros2.conversions import fill, transform_of

PARAMETERS: dict[str, Any] = {
    "map": "",  # folder of the map
    "map_frame": "map",  # the name of the map's frame in TF
    "odom_frame": "",  # frame of an odometry in TF; empty: none, and the images are tracked
    "base_frame": "",  # frame whose pose is published; empty: the images' optical frame
    "use_depth": True,  # subscribe to depth
    "rectified": False,  # whether the images are free of distortion
    "rate": 10.0,  # Hz, of TF and of polling for answers
    "slop": 0.02,  # seconds between an image and its depth
}


def main(arguments: list[str] | None = None) -> None:
    """Run the node until it is interrupted."""
    import rclpy

    rclpy.init(args=arguments)
    node = make_node()
    try:
        rclpy.spin(node)
    except KeyboardInterrupt:
        pass
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


def make_node() -> Any:
    """Return the node. Imports ROS here, so that the package can be imported without it."""
    import message_filters
    import rclpy.duration
    import tf2_ros
    from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
    from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
    from rclpy.node import Node
    from rclpy.qos import qos_profile_sensor_data
    from sensor_msgs.msg import CameraInfo, Image

    class LocalizationNode(Node):  # type: ignore[misc]
        """Localizes ``image`` with ``camera_info`` and ``depth``; publishes ``pose``, TF and ``/diagnostics``."""

        def __init__(self) -> None:
            super().__init__("bidnerf")
            self.options = {name: self.declare_parameter(name, value).value for name, value in PARAMETERS.items()}
            if not self.options["map"]:
                raise InputError("parameter map is empty", expected="the folder of a map")
            self.bridge = Bridge(Localizer(load_map(self.options["map"])), bool(self.options["odom_frame"]))
            self.optical_frame, self.info = "", None
            self.buffer = tf2_ros.Buffer()
            self.listener = tf2_ros.TransformListener(self.buffer, self)
            self.broadcaster = tf2_ros.TransformBroadcaster(self)
            self.poses = self.create_publisher(PoseWithCovarianceStamped, "pose", 10)
            self.diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
            self.create_subscription(CameraInfo, "camera_info", self.on_info, qos_profile_sensor_data)
            if self.options["use_depth"]:
                both = [
                    message_filters.Subscriber(self, Image, topic, qos_profile=qos_profile_sensor_data)
                    for topic in ("image", "depth")
                ]
                self.together = message_filters.ApproximateTimeSynchronizer(both, 10, self.options["slop"])
                self.together.registerCallback(self.on_image)
            else:
                self.create_subscription(Image, "image", self.on_image, qos_profile_sensor_data)
            self.create_timer(1.0 / self.options["rate"], self.on_timer)

        def on_info(self, info: Any) -> None:
            self.info = info

        def on_image(self, image: Any, depth: Any = None) -> None:
            if self.info is None:
                return
            self.optical_frame = image.header.frame_id
            T_odom_camera = None
            if self.bridge.has_odometry:
                T_odom_camera = self.transform(self.options["odom_frame"], self.optical_frame, image.header.stamp)
                if T_odom_camera is None:
                    return
            try:
                self.bridge.give(image, self.info, depth, T_odom_camera, self.options["rectified"])
            except InputError as error:
                self.publish_status(image.header.stamp, ERROR, str(error), {})

        def transform(self, target: str, source: str, stamp: Any) -> Any:
            """Return T_target_source at a time, or None if TF does not know it."""
            try:
                wait = rclpy.duration.Duration(seconds=0.0)
                return transform_of(self.buffer.lookup_transform(target, source, stamp, wait).transform)
            except tf2_ros.TransformException as error:
                self.get_logger().warning(f"no transform from {source} to {target}: {error}", throttle_duration_sec=5.0)
                return None

        def on_timer(self) -> None:
            for answer in self.bridge.answers():
                self.publish(answer)
            correction = self.bridge.T_map_odom
            if correction is not None:
                self.broadcast(self.options["odom_frame"], correction, self.get_clock().now().to_msg())

        def publish(self, answer: Estimate) -> None:
            found = answer.found
            level, text, values = diagnosis(found)
            self.publish_status(answer.stamp, level, text, values)
            if not found.converged or found.covariance is None:
                return  # never a pose that the method itself did not accept
            base = self.options["base_frame"]
            T_camera_base = self.transform(self.optical_frame, base, answer.stamp) if base else None
            if base and T_camera_base is None:
                return
            message = PoseWithCovarianceStamped()
            message.header.stamp, message.header.frame_id = answer.stamp, self.options["map_frame"]
            fill_pose(message.pose, found, T_camera_base)
            self.poses.publish(message)
            if not self.bridge.has_odometry:
                pose = found.T_world_camera.to("cpu", torch.float64)
                if T_camera_base is not None:
                    pose = pose @ T_camera_base
                self.broadcast(base or self.optical_frame, pose, answer.stamp)

        def broadcast(self, child: str, pose: Any, stamp: Any) -> None:
            message = TransformStamped()
            message.header.stamp, message.header.frame_id = stamp, self.options["map_frame"]
            message.child_frame_id = child
            fill(message.transform, pose)
            self.broadcaster.sendTransform(message)

        def publish_status(self, stamp: Any, level: int, text: str, values: dict[str, str]) -> None:
            message, status = DiagnosticArray(), DiagnosticStatus()
            message.header.stamp = stamp
            status.level, status.name, status.message = bytes([level]), "bidnerf: localization", text
            status.hardware_id = self.options["map"]
            status.values = [KeyValue(key=key, value=value) for key, value in values.items()]
            message.status = [status]
            self.diagnostics.publish(message)

        def destroy_node(self) -> None:
            self.bridge.close()
            super().destroy_node()

    return LocalizationNode()
