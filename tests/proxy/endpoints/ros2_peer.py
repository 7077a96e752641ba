"""Real rclpy node in a child process, controlled line by line; run as a script, it imports nothing of ours.

Each command is one line of Python with these names: ``node``, ``publish``, ``listen``, ``serve``, ``client``,
``heard``; the answer is one line of JSON.
"""

from __future__ import annotations

import json
import sys
import threading

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import serialize_message


def main() -> None:
    """Serve commands until the input ends."""
    rclpy.init()
    node = rclpy.create_node(sys.argv[1])
    heard: dict[str, list[str]] = {}
    kept: list[object] = []

    def profile(word: str, depth: int = 10) -> QoSProfile:
        qos = QoSProfile(depth=depth)
        if "best_effort" in word:
            qos.reliability = ReliabilityPolicy.BEST_EFFORT
        if "transient_local" in word:
            qos.durability = DurabilityPolicy.TRANSIENT_LOCAL
        return qos

    def listen(kind: type, topic: str, word: str = "", depth: int = 10) -> None:
        heard[topic] = []
        take = heard[topic].append
        kept.append(node.create_subscription(kind, topic, lambda m: take(m.hex()), profile(word, depth), raw=True))

    def echo(kind: type, topic: str, back: str) -> None:
        out = node.create_publisher(kind, back, 100)
        kept.append(node.create_subscription(kind, topic, out.publish, 100, raw=True))

    def talk(kind: type, topic: str, word: str = "", depth: int = 10) -> object:
        kept.append(node.create_publisher(kind, topic, profile(word, depth)))
        return kept[-1]

    executor = SingleThreadedExecutor()
    executor.add_node(node)
    names = {
        "node": node, "heard": heard, "listen": listen, "talk": talk, "echo": echo, "kept": kept, "rclpy": rclpy,
        "serialize": serialize_message,
    }  # fmt: skip
    thread = threading.Thread(target=executor.spin, daemon=True)
    thread.start()
    for line in sys.stdin:
        try:
            result = None
            if line.startswith("!"):
                exec(line[1:].replace("\\n", "\n"), names)
            else:
                result = eval(line, names)
            print(json.dumps(result, default=repr), flush=True)
        except Exception as error:  # the test gets every error, whatever its type
            print(json.dumps(f"ERROR {error!r}"), flush=True)
    executor.shutdown()
    thread.join(5)
    rclpy.try_shutdown()


if __name__ == "__main__":
    main()
