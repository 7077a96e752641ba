"""Two real nodes of the demonstration, in a graph of their own on this machine."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys

import pytest

pytest.importorskip("rclpy", reason="needs ROS 2's rclpy")

from fog.launch.interface_discovery import free_domain
from fog_demo.caller import Tally


def test_the_robot_is_answered_by_the_machine_and_both_end_cleanly() -> None:
    environment = {
        **os.environ,
        "ROS_DOMAIN_ID": str(free_domain()),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "FOG_MACHINE": "m7",
    }
    echo = subprocess.Popen([sys.executable, "-m", "fog_demo.echo"], env=environment, stderr=subprocess.DEVNULL)
    try:
        words = ["--ros-args", "-p", "calls:=10", "-p", "rate_hz:=50", "-p", "report_s:=60"]
        caller = subprocess.run(
            [sys.executable, "-m", "fog_demo.caller", *words],
            env=environment,
            stdout=subprocess.PIPE,
            check=True,
            timeout=30,
        )
    finally:
        echo.send_signal(signal.SIGINT)
        left = echo.wait(10)
    last = json.loads(caller.stdout.splitlines()[-1])
    assert (last["answered"], last["failed"], last["wrong"], last["done"]) == (10, 0, 0, True)
    assert last["by_machine"] == {"m7": 10}
    assert left == 0


def test_a_second_ctrl_c_cuts_nothing() -> None:
    environment = {
        **os.environ,
        "ROS_DOMAIN_ID": str(free_domain()),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
    }
    words = [sys.executable, "-m", "fog_demo.caller", "--ros-args", "-p", "report_s:=0.2"]
    caller = subprocess.Popen(words, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert caller.stdout is not None
    caller.stdout.readline()
    caller.send_signal(signal.SIGINT)
    while not json.loads(caller.stdout.readline())["done"]:
        pass  # a line that came before the signal
    caller.send_signal(signal.SIGINT)
    _, complaints = caller.communicate(timeout=20)
    assert (caller.returncode, complaints) == (0, "")


def test_a_wrong_answer_is_counted() -> None:
    stats = Tally(calls=2)
    stats.answered(True, Tallied(success=False, message="a"), 0.001, 5.0)
    line = json.loads(stats.line(done=False))
    assert (line["wrong"], line["under_way"], line["median_ms"]) == (1, 1, 1.0)


def test_the_longest_silence_since_the_line_before_is_reported() -> None:
    stats = Tally()
    for now_s in (5.0, 5.5, 5.6):
        stats.answered(True, Tallied(success=True, message="a"), 0.001, now_s)
    assert json.loads(stats.line(done=False))["silence_ms"] == 500.0
    assert json.loads(stats.line(done=True))["silence_ms"] == 0.0


class Tallied:
    """Response of a service."""

    def __init__(self, *, success: bool, message: str) -> None:
        self.success = success
        self.message = message
