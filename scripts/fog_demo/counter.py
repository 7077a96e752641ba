"""ROS service with state, in the form of ``docs/how-to/state.md``: ``/count``, ``std_srvs/srv/SetBool``.

I/O; needs rclpy. A request with ``data: true`` adds one; the response's message is the count. The node's parameter
``state``, a byte array, is the count as eight bytes: reading it saves the state, writing it restores it.
"""

from __future__ import annotations

import signal
import struct
from collections.abc import Sequence
from typing import Final

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.parameter import Parameter
from std_srvs.srv import SetBool

_COUNT: Final = struct.Struct("<Q")
_STATE: Final = "state"


def main() -> None:
    """Serve until Ctrl-C or SIGTERM."""
    rclpy.init()
    node = rclpy.create_node("counter")
    node.declare_parameter(_STATE, _bytes_of(0))

    def answer(request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        count = _count_in(node.get_parameter(_STATE).value) + request.data
        node.set_parameters([Parameter(_STATE, Parameter.Type.BYTE_ARRAY, _bytes_of(count))])
        response.success, response.message = True, str(count)
        return response

    node.create_service(SetBool, "/count", answer)
    node.get_logger().info("ready")
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # a terminal and its launch both send one: the second cuts nothing
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


def _bytes_of(count: int) -> list[bytes]:
    """Return the state in rclpy's form of a byte array: a list of single bytes."""
    return [bytes([each]) for each in _COUNT.pack(count)]


def _count_in(state: Sequence[bytes]) -> int:
    count: int = _COUNT.unpack(b"".join(state))[0]
    return count


if __name__ == "__main__":
    main()
