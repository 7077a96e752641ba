"""``ros2 run gdp_proxy proxy``: reads ROS parameters, and becomes ``gdp-proxy`` with them.

I/O. The process is replaced, so that a launch's signals reach the proxy itself. Exit code 2: a parameter is wrong, or
the Python package gdp-ros is not installed.
"""

from __future__ import annotations

import importlib.util
import os
import sys
from collections.abc import Mapping, Sequence
from typing import Final, NoReturn

__all__ = ["command_line", "main"]

_NODE: Final = "gdp_proxy"
_WRONG: Final = 2
_DEFAULTS: Final[Mapping[str, object]] = {
    "config": "",
    "await_iface": 60.0,
    "data_plane": "",
    "check": False,
    "verbose": False,
}


def command_line(parameters: Mapping[str, object]) -> list[str]:
    """Return the words of ``gdp-proxy`` for these parameters.

    Raises:
        ValueError: ``config`` is missing, or a value has the wrong type.
    """
    values = {**_DEFAULTS, **parameters}
    for name, default in _DEFAULTS.items():
        is_number = isinstance(default, float) and type(values[name]) is int
        if type(values[name]) is not type(default) and not is_number:
            raise ValueError(f"{name}: expected {type(default).__name__}, not {values[name]!r}")
    if not values["config"]:
        raise ValueError("config: required; ros2 run gdp_proxy proxy --ros-args -p config:=/etc/gdp/proxy.yaml")
    words = ["--config", str(values["config"]), "--await-iface", str(values["await_iface"])]
    words += ["--data-plane", str(values["data_plane"])] if values["data_plane"] else []
    return words + [f"--{name}" for name in ("check", "verbose") if values[name]]


def main(arguments: Sequence[str] | None = None) -> NoReturn:
    """Read the parameters of this process, and run the proxy."""
    try:
        words = command_line(_parameters(sys.argv if arguments is None else arguments))
    except ValueError as error:
        sys.exit(_refused(str(error)))
    if importlib.util.find_spec("proxy") is None:
        sys.exit(_refused("the Python package gdp-ros is missing; run: pip install 'gdp-ros[proxy]'"))
    sys.stdout.flush()
    os.execv(sys.executable, [sys.executable, "-m", "proxy.cli.proxy", *words])


def _parameters(arguments: Sequence[str]) -> dict[str, object]:
    """Return the stated parameters, by a node that exists only for this moment."""
    import rclpy
    from rclpy.signals import SignalHandlerOptions

    rclpy.init(args=list(arguments), signal_handler_options=SignalHandlerOptions.NO)
    try:
        node = rclpy.create_node(
            _NODE, automatically_declare_parameters_from_overrides=True, start_parameter_services=False
        )
        try:
            return {name: node.get_parameter(name).value for name in _DEFAULTS if node.has_parameter(name)}
        finally:
            node.destroy_node()
    finally:
        rclpy.shutdown()


def _refused(text: str) -> int:
    sys.stderr.write(f"gdp_proxy: {text}\n")
    return _WRONG
