"""rclpy without a router: nav_msgs/Odometry, 90 numbers, over Fast DDS on this host, reliable, every sample kept."""

import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import rclpy
from nav_msgs.msg import Odometry
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy

from benchmarks.compare.case import TOPIC, Case
from benchmarks.compare.fields import FIELDS

PACKAGES = [
    "ros-jazzy-rclpy==7.1.6",
    "ros-rmw-fastrtps-cpp==8.4.3",
    "ros-fastrtps==2.14.5",
    "ros-jazzy-nav-msgs==5.3.6",
]

SECOND = 1_000_000_000
EVERY_SAMPLE = QoSProfile(
    history=HistoryPolicy.KEEP_ALL, reliability=ReliabilityPolicy.RELIABLE, depth=0
)
os.environ.update(ROS_DOMAIN_ID="77", ROS_AUTOMATIC_DISCOVERY_RANGE="LOCALHOST")


@contextmanager
def publish(case: Case) -> Iterator[list[Callable[[int], None]]]:
    rclpy.init()
    node = rclpy.create_node("publisher")
    publisher = node.create_publisher(Odometry, TOPIC, EVERY_SAMPLE)
    while not publisher.get_subscription_count():
        time.sleep(0.05)

    def send(stamp: int) -> None:
        message = Odometry()
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp, SECOND)
        position, velocity = message.pose.pose.position, message.twist.twist.linear
        position.x, position.y, position.z = FIELDS["x"], FIELDS["y"], FIELDS["z"]
        velocity.x, velocity.y, velocity.z = FIELDS["vx"], FIELDS["vy"], FIELDS["vz"]
        publisher.publish(message)

    yield [send]
    node.destroy_node()
    rclpy.shutdown()


def receive(case: Case, ready: Callable[[], None], seen: Callable[[int], bool]) -> None:
    rclpy.init()
    node = rclpy.create_node("reader")
    wanted = True

    def on_message(message: Odometry) -> None:
        nonlocal wanted
        stamp = message.header.stamp
        wanted = seen(stamp.sec * SECOND + stamp.nanosec if message.pose.pose.position.x else 0)

    node.create_subscription(Odometry, TOPIC, on_message, EVERY_SAMPLE)
    # `rclpy.spin_once` adds the node to an executor at each call
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    ready()
    while wanted:
        executor.spin_once()
    node.destroy_node()
    rclpy.shutdown()
