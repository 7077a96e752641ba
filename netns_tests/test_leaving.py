"""Real proxy that gets SIGUSR1 while a real ROS 2 server works: the response arrives, then the process ends."""

from __future__ import annotations

import shutil
import signal

import pytest

from netns_tests.live_pair import Crossing, pair_of
from tests.proxy.endpoints.ros2_net import needs

needs("std_srvs")
if shutil.which("nsenter") is None or shutil.which("setpriv") is None:
    pytest.skip("nsenter or setpriv is not installed (util-linux)", allow_module_level=True)

pytestmark = pytest.mark.netns

SET_BOOL = "std_srvs/srv/SetBool"


def test_a_proxy_that_leaves_answers_what_is_under_way_and_ends() -> None:
    with pair_of(Crossing("/slow", SET_BOOL, "a", "b", "service")) as pair:
        server, client, proxy = pair.node("a"), pair.node("b"), pair.proxy("a")
        server.tell(
            "!from std_srvs.srv import SetBool\nimport time\nasked = []\n"
            "def answer(request, response):\n"
            " asked.append(1); time.sleep(2); response.success = True; response.message = 'done'\n"
            " return response\n"
            "serving = node.create_service(SetBool, '/slow', answer)"
        )
        client.tell(
            "!from std_srvs.srv import SetBool\nanswers = []\ncaller = node.create_client(SetBool, '/slow')\n"
            "def ask():\n"
            " request = SetBool.Request(data=True)\n"
            " caller.call_async(request).add_done_callback(lambda future: answers.append(future.result().message))"
        )
        client.waits_for("caller.service_is_ready()", True)
        client.tell("!ask()")
        server.waits_for("len(asked)", 1)
        proxy.end(signal.SIGUSR1)  # and wait for its end
        client.waits_for("answers", ["done"])
        assert "leaving" in proxy.said
