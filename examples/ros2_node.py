"""A ROS 2 node that republishes a running sensor's results; needs a machine with ROS 2 (rclpy) and tubesight[stream].

Start the sensor with ``tubesight live ... --websocket``, then ``python ros2_node.py ws://127.0.0.1:8765/``.
Lengths are metres and angles radians, as REP 103 asks for; the frame is `tube_base`, with +z along the tube as it
leaves its clamp, and the tip is the frame `tube_tip` below it (REP 105 leaves both to the robot's own tree).
"""

from __future__ import annotations

import sys

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped, TransformStamped
from nav_msgs.msg import Path
from rclpy.node import Node
from scipy.spatial.transform import Rotation
from tf2_ros import TransformBroadcaster

from tubesight.client import Result, results
from tubesight.geometry.pose import turn_onto

FRAME, TIP = "tube_base", "tube_tip"


class Tube(Node):
    """Publishes pose and path where the status is ok, and diagnostics always."""

    def __init__(self) -> None:
        super().__init__("tubesight")
        self._pose = self.create_publisher(PoseWithCovarianceStamped, "~/tip", 1)
        self._path = self.create_publisher(Path, "~/curve", 1)
        self._state = self.create_publisher(DiagnosticArray, "/diagnostics", 1)
        self._frames = TransformBroadcaster(self)

    def publish(self, result: Result) -> None:
        """Publish one result."""
        now = self.get_clock().now().to_msg()
        state = DiagnosticStatus(name="tubesight", message=result.message.status, hardware_id="cameras")
        state.level = DiagnosticStatus.OK if result else DiagnosticStatus.ERROR
        state.values = [KeyValue(key="notes", value="; ".join(result.message.notes))]
        array = DiagnosticArray(status=[state])
        array.header.stamp = now
        self._state.publish(array)
        if not result:
            return
        pose = PoseWithCovarianceStamped()
        pose.header.stamp, pose.header.frame_id = now, FRAME
        p, q = pose.pose.pose.position, pose.pose.pose.orientation
        p.x, p.y, p.z = (result.tip_mm / 1e3).tolist()
        turn = Rotation.from_matrix(turn_onto(np.array(result.message.tip_direction)))
        q.x, q.y, q.z, q.w = turn.as_quat().tolist()
        covariance = np.zeros((6, 6))
        covariance[:3, :3] = np.diag((result.sd_tip_mm / 1e3) ** 2)
        pose.pose.covariance = covariance.ravel().tolist()
        self._pose.publish(pose)
        frame = TransformStamped(header=pose.header, child_frame_id=TIP)
        frame.transform.translation.x, frame.transform.translation.y, frame.transform.translation.z = p.x, p.y, p.z
        frame.transform.rotation = q
        self._frames.sendTransform(frame)
        path = Path(header=pose.header)
        for point in (result.curve_mm / 1e3).tolist():
            at = PoseStamped(header=pose.header)
            at.pose.position.x, at.pose.position.y, at.pose.position.z = point
            path.poses.append(at)
        self._path.publish(path)


def main() -> None:
    """Publish until the sensor ends."""
    rclpy.init()
    node = Tube()
    for result in results(sys.argv[1] if len(sys.argv) > 1 else "ws://127.0.0.1:8765"):
        node.publish(result)
        rclpy.spin_once(node, timeout_sec=0.0)


if __name__ == "__main__":
    main()
