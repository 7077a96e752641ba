"""Robot's node: has a grasp planned for each recorded frame, and checks it.

I/O; needs rclpy, NumPy, SciPy and OpenCV. Parameters: ``frames``: folder of the frames, those of the clone by default;
``rounds``: how often each is sent; ``timeout_s``: of one request. Exit status: 0 all grasps are right, 1 one is not,
or did not come, 2 the frames cannot be read, or Ctrl-C came before the end.
"""

from __future__ import annotations

import signal
import sys
import time
from pathlib import Path

import rclpy
from rcl_interfaces.msg import ParameterDescriptor
from rcl_interfaces.srv import SetParameters
from rclpy.executors import ExternalShutdownException

from grasp.frames import Frame, is_right, read_frames
from grasp.messages import SERVICE, grasp_in, request_of

__all__ = ["main"]

_FRAMES = Path(__file__).resolve().parents[3] / "scripts" / "data" / "rgbd"


def main() -> None:
    """Send every frame, print one line for each, and end."""
    rclpy.init()
    node = rclpy.create_node("client")
    folder = Path(node.declare_parameter("frames", str(_FRAMES)).value)
    rounds = int(node.declare_parameter("rounds", 1).value)
    timeout_s = float(node.declare_parameter("timeout_s", 30.0, ParameterDescriptor(dynamic_typing=True)).value)
    code = 2
    try:
        code = _ask_all(node, read_frames(folder) * rounds, timeout_s)
    except FileNotFoundError as error:
        node.get_logger().error(f"{error}: no such depth image (name a folder with -p frames:=FOLDER)")
    except (KeyboardInterrupt, ExternalShutdownException):
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # a terminal and its launch both send one: the second cuts nothing
    node.destroy_node()
    rclpy.try_shutdown()
    sys.exit(code)


def _ask_all(node: rclpy.node.Node, frames: list[Frame], timeout_s: float) -> int:
    planner = node.create_client(SetParameters, SERVICE)
    while not planner.wait_for_service(timeout_sec=1.0):
        node.get_logger().info(f"waiting for {SERVICE}")
    right = 0
    for number, frame in enumerate(frames, 1):
        begun_s = time.monotonic()
        future = planner.call_async(request_of(frame))
        rclpy.spin_until_future_complete(node, future, timeout_sec=timeout_s)
        if not future.done():
            planner.remove_pending_request(future)
            print(f"frame {number}: no answer within {timeout_s:g} s", flush=True)
            continue
        try:
            grasp, machine = grasp_in(future.result())
        except ValueError as error:
            print(f"frame {number}: refused: {error}", flush=True)
            continue
        if grasp is None:
            print(f"frame {number}: no grasp found", flush=True)
            continue
        is_good = is_right(grasp, frame)
        right += is_good
        print(
            f"frame {number}: row {grasp.row:.1f}, column {grasp.column:.1f}, {grasp.depth_m:.2f} m away,"
            f" {grasp.width_m:.2f} m wide, quality {grasp.quality:.2f}: {'right' if is_good else 'wrong'};"
            f" planned on {machine or 'this machine'} in {time.monotonic() - begun_s:.2f} s",
            flush=True,
        )
    print(f"{right} of {len(frames)} grasps are right", flush=True)
    return int(right < len(frames))


if __name__ == "__main__":
    main()
