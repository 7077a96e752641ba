"""Replicas of ``replicas.py``: ordinary rclpy nodes without knowledge of the overlay.

Process of its own, started in a field (``scripts/experiments/field.py``) as ``serve``.

The type is ``rcl_interfaces/srv/ListParameters``, because its request has content (``Number`` in ``tasks.py``). The
answer names the number of the request, the machine, and how many requests to this service the machine has had. One in
``slow_in`` requests takes ``slow_s`` more; with ``threads`` it delays no other.
"""

from __future__ import annotations

import random
import time
from collections import Counter
from functools import partial
from typing import Final

from peers.jsonl import say
from rcl_interfaces.srv import ListParameters
from rclpy.callback_groups import ReentrantCallbackGroup
from ros_endpoint import End, Settings, reliable, run_role

_DEPTH: Final = 1_000


def serve(end: End, settings: Settings) -> None:
    """Answer until killed."""
    machine, group = str(settings["machine"]), ReentrantCallbackGroup()
    slow_in, slow_s = int(str(settings.get("slow_in", 0))), float(str(settings.get("slow_s", 0.0)))
    had: Counter[str] = Counter()

    def answer(
        name: str, request: ListParameters.Request, response: ListParameters.Response
    ) -> ListParameters.Response:
        if not had:
            say(event="serving")
        had[name] += 1
        if slow_in and random.randrange(slow_in) == 0:
            time.sleep(slow_s)
        response.result.names = [str(request.depth), machine, str(had[name])]
        return response

    for name in str(settings["services"]).split():
        end.node.create_service(
            ListParameters, name, partial(answer, name), qos_profile=reliable(_DEPTH), callback_group=group
        )
    say(event="ready")
    end.run()


if __name__ == "__main__":
    run_role({"serve": serve})
