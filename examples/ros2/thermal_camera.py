"""A node of ROS 2 (rclpy) that publishes thermal images for the poses that a simulator publishes.

It is a thin client of `thermorender serve`, and needs a sourced ROS 2:

    thermorender serve heath &
    python thermal_camera.py --ros-args -p port:=47800

Subscribed: `pose` (geometry_msgs/PoseStamped), the optical frame of the camera (x right, y down, z along the view) in a
frame of east, north, up at the scene's origin. Published: `thermal/image_raw` (sensor_msgs/Image, mono16, 10 mK of
apparent temperature per count from 0 K, as Gazebo's thermal camera) and `thermal/camera_info`. While a frame is
rendered, only the newest pose waits. The scene's time is that of the first pose. This project's tests do not run it.
"""

from array import array

import numpy as np
import rclpy
from geometry_msgs.msg import PoseStamped
from rclpy.node import Node
from sensor_msgs.msg import CameraInfo, Image

from thermorender import link

STEP_K = 0.01


class ThermalCamera(Node):
    def __init__(self):
        super().__init__("thermal_camera")
        port = self.declare_parameter("port", link.DEFAULT_PORT).value
        camera = self.declare_parameter("camera", "").value
        self.server = link.connect(port=port, wait_s=60.0)
        self.session = self.server.open(camera)
        self.focal_px = self.server.server["cameras"][camera or self.server.server["camera"]]["focal_length_px"]
        self.stamps, self.start_s = {}, None
        self.images = self.create_publisher(Image, "thermal/image_raw", 10)
        self.infos = self.create_publisher(CameraInfo, "thermal/camera_info", 10)
        self.create_subscription(PoseStamped, "pose", self.ask, 10)
        self.create_timer(0.002, self.publish)

    def ask(self, message):
        """Send a pose to the server; frames have the time of the pose."""
        stamp, place, turn = message.header.stamp, message.pose.position, message.pose.orientation
        pose = (place.x, place.y, place.z, turn.w, turn.x, turn.y, turn.z)
        time_s = stamp.sec + 1e-9 * stamp.nanosec
        self.start_s = time_s if self.start_s is None else self.start_s
        number = self.session.send(time_s - self.start_s, pose, products=("temperature",), latest=True)
        self.stamps[number] = stamp

    def publish(self):
        """Publish the frames that have arrived."""
        try:
            reply = self.server.poll()
        except link.LinkError as error:
            if error.code != link.Code.REFUSED:
                raise
            self.get_logger().warning(str(error))
            return
        if reply is None:
            return
        stamp = self.stamps[reply.id]
        self.stamps = {number: each for number, each in self.stamps.items() if number > reply.id}
        counts = np.clip(np.round(reply.temperature / STEP_K), 0, 65535).astype("<u2")
        image, info = Image(), CameraInfo()
        for each in (image, info):
            each.header.stamp, each.header.frame_id = stamp, "thermal_optical"
            each.height, each.width = counts.shape
        image.encoding, image.step, image.data = "mono16", 2 * image.width, array("B", counts.tobytes())
        # Without the lens's distortion and offset, which the server does not state; `fly --products mcap` has them.
        across, down = image.width / 2 - 0.5, image.height / 2 - 0.5
        info.k = [self.focal_px, 0.0, across, 0.0, self.focal_px, down, 0.0, 0.0, 1.0]
        info.p = [self.focal_px, 0.0, across, 0.0, 0.0, self.focal_px, down, 0.0, 0.0, 0.0, 1.0, 0.0]
        info.r = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
        self.images.publish(image)
        self.infos.publish(info)


def main():
    rclpy.init()
    node = ThermalCamera()
    try:
        rclpy.spin(node)
    finally:
        node.server.close()


if __name__ == "__main__":
    main()
