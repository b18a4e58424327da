"""ROS 2 node that localises a robot in a floor plan: `/lalaloc/pose` and the transform `map -> odom`.

This sample was not run on a robot or with ROS 2: the tests run it with stand-ins for ROS's own packages. All that is
computed is in `lalaloc_client.planar`, which needs no ROS. Needs rclpy, tf2_ros and `lalaloc[client]`.

    python3 localise_node.py --ros-args -p url:=http://127.0.0.1:8000 -p plan:=ID -p camera_forward_m:=0.2
"""

# ROS's packages come with ROS.
# pyright: reportMissingImports=false

from __future__ import annotations

import rclpy
from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
from nav_msgs.msg import Odometry
from rclpy.node import Node
from sensor_msgs.msg import CompressedImage
from tf2_ros import TransformBroadcaster

from lalaloc_client import Client, ClientError
from lalaloc_client.frames import ros_covariance
from lalaloc_client.planar import FloorTransform, base_covariance, map_from_base, map_from_odom, motion_between, of_ros


class LocaliseNode(Node):
    """Follows the robot from photograph to photograph; odometry fills the time between them."""

    def __init__(self) -> None:
        super().__init__("lalaloc")
        declared = {
            "url": "http://127.0.0.1:8000",
            "plan": "",
            "key": "",
            "camera_height_m": 1.2,
            "min_probability": 0.5,
        }
        mount = {"camera_forward_m": 0.0, "camera_left_m": 0.0, "camera_yaw": 0.0}
        values = {name: self.declare_parameter(name, value).value for name, value in {**declared, **mount}.items()}
        self.min_probability = values["min_probability"]
        self.mount = FloorTransform(values["camera_forward_m"], values["camera_left_m"], values["camera_yaw"])
        self.client = Client(values["url"], api_key=values["key"] or None)
        self.tracker = self.client.track(values["plan"], camera_height_m=values["camera_height_m"])
        self.tracker.begin()
        self.odometry: FloorTransform | None = None
        self.at_photograph: FloorTransform | None = None
        self.poses = self.create_publisher(PoseWithCovarianceStamped, "lalaloc/pose", 10)
        self.transforms = TransformBroadcaster(self)
        self.create_subscription(Odometry, "odom", self.on_odometry, 10)
        # One photograph is localised at a time; a queue of one holds the newest.
        self.create_subscription(CompressedImage, "image/compressed", self.on_photograph, 1)

    def on_odometry(self, message: Odometry) -> None:
        """Keep the newest pose by odometry."""
        place, turn = message.pose.pose.position, message.pose.pose.orientation
        self.odometry = of_ros(place.x, place.y, (turn.x, turn.y, turn.z, turn.w))

    def on_photograph(self, message: CompressedImage) -> None:
        """Localise a photograph, and correct the odometry if the answer is sure enough."""
        if self.odometry is None:
            return
        odom_from_base, before = self.odometry, self.at_photograph
        motion = None if before is None else motion_between(before, odom_from_base, self.mount)
        try:
            session = self.tracker.add(bytes(message.data), motion)
        except ClientError as error:
            self.get_logger().warning(str(error))
            return
        self.at_photograph = odom_from_base
        pose = session.pose
        if pose is None or pose.probability < self.min_probability:
            return
        self.publish(message.header.stamp, pose, odom_from_base)

    def publish(self, stamp, pose, odom_from_base: FloorTransform) -> None:
        """Publish the base in the map with its covariance, and `map -> odom`."""
        base = map_from_base(pose, self.mount)
        stated = PoseWithCovarianceStamped()
        stated.header.stamp, stated.header.frame_id = stamp, "map"
        stated.pose.pose.position.x, stated.pose.pose.position.y = base.x_m, base.y_m
        _set(stated.pose.pose.orientation, base)
        stated.pose.covariance = list(ros_covariance(base_covariance(pose.covariance, pose, self.mount)))
        self.poses.publish(stated)
        correction, sent = map_from_odom(pose, self.mount, odom_from_base), TransformStamped()
        sent.header.stamp, sent.header.frame_id, sent.child_frame_id = stamp, "map", "odom"
        sent.transform.translation.x, sent.transform.translation.y = correction.x_m, correction.y_m
        _set(sent.transform.rotation, correction)
        self.transforms.sendTransform(sent)


def _set(quaternion, transform: FloorTransform) -> None:
    quaternion.x, quaternion.y, quaternion.z, quaternion.w = transform.orientation


def main() -> None:
    """Run the node until it is interrupted."""
    rclpy.init()
    node = LocaliseNode()
    try:
        rclpy.spin(node)
    finally:
        node.tracker.end()
        node.client.close()
        rclpy.shutdown()


if __name__ == "__main__":
    main()
