"""ROS service that returns the name of its machine: ``/echo``, ``std_srvs/srv/SetBool``.

I/O; needs rclpy. The response is {success: value of the request, message: the machine}; the environment variable
``FOG_MACHINE`` names the machine. Parameter ``delay_s``: time until a response.
"""

from __future__ import annotations

import os
import signal
import time

import rclpy
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.executors import ExternalShutdownException
from std_srvs.srv import SetBool


def main() -> None:
    """Serve until Ctrl-C or SIGTERM."""
    machine = os.environ.get("FOG_MACHINE", "")
    rclpy.init()
    node = rclpy.create_node("echo")
    delay_s = float(node.declare_parameter("delay_s", 0.0, ParameterDescriptor(dynamic_typing=True)).value)

    def answer(request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        if delay_s:
            time.sleep(delay_s)
        response.success, response.message = request.data, machine
        return response

    node.create_service(SetBool, "/echo", answer)
    node.get_logger().info("ready")
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # a terminal and its launch both send one: the second cuts nothing
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
