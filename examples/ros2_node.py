"""A ROS 2 node that acts with an exported policy, without JAX: observations in, actions out, at a fixed rate.

    python examples/ros2_node.py --ros-args -p model:=runs/NAME/policy.npz -p seconds_per_step:=0.05

It reads ``std_msgs/Float32MultiArray`` from ``observation`` and publishes the same from ``action``. When observations stop
coming or are wrong it publishes zeros, which should stop the robot; use what does on yours.
"""

import numpy as np
import rclpy
from rclpy.node import Node
from std_msgs.msg import Float32MultiArray

import rejeu


class PolicyNode(Node):
    """Acts on the newest observation once every step."""

    def __init__(self) -> None:
        super().__init__("rejeu_policy")
        self.declare_parameter("model", "policy.npz")
        self.declare_parameter("seconds_per_step", 0.05)
        self.seconds = self.get_parameter("seconds_per_step").value
        self.policy = rejeu.load_policy(self.get_parameter("model").value)
        self.observation, self.received = None, -np.inf
        self.publisher = self.create_publisher(Float32MultiArray, "action", 1)
        self.create_subscription(Float32MultiArray, "observation", self.receive, 1)
        self.create_timer(self.seconds, self.act)

    def now(self) -> float:
        """Returns the time in seconds."""
        return self.get_clock().now().nanoseconds * 1e-9

    def receive(self, message: Float32MultiArray) -> None:
        """Keeps an observation."""
        self.observation, self.received = np.array(message.data, np.float32), self.now()

    def act(self) -> None:
        """Publishes an action, or zeros if the newest observation is more than two steps old or invalid."""
        action = np.zeros(self.policy.action_space.shape, np.float32)
        if self.now() - self.received <= 2 * self.seconds:
            if self.policy.observation_space.shape == self.observation.shape and np.isfinite(self.observation).all():
                action, _ = self.policy.predict(self.observation)
            else:
                self.get_logger().error(f"expected {self.policy.observation_space}, received {self.observation}")
        self.publisher.publish(Float32MultiArray(data=action.ravel().tolist()))


if __name__ == "__main__":
    rclpy.init()
    rclpy.spin(PolicyNode())
