"""Cloud's node: plans a grasp for each request of ``/grasp``.

I/O; needs rclpy, NumPy, SciPy and OpenCV. The environment variable ``FOG_MACHINE`` names the machine. The planner
keeps no state, so each replica gives the same answer.
"""

from __future__ import annotations

import os
import signal

import rclpy
from rcl_interfaces.srv import SetParameters
from rclpy.executors import ExternalShutdownException

from grasp.messages import SERVICE, frame_of, refusal, response_of
from grasp.sampler import plan_grasp

__all__ = ["main"]

_SEED = 1


def main() -> None:
    """Serve until Ctrl-C or SIGTERM."""
    machine = os.environ.get("FOG_MACHINE", "")
    rclpy.init()
    node = rclpy.create_node("planner")

    def plan(request: SetParameters.Request, response: SetParameters.Response) -> SetParameters.Response:
        del response
        try:
            frame = frame_of(request)
        except ValueError as error:
            return refusal(str(error))
        return response_of(plan_grasp(frame.depth, frame.mask, frame.focal, _SEED), machine)

    node.create_service(SetParameters, SERVICE, plan)
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
