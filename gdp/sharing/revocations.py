"""Revocations on their way to the switches: files in the ``revocations`` folder of a switch of this machine.

I/O. The switch verifies the files and floods their statements to its neighbours, at once if it runs, else at its start.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path

from gdp.config.config import SwitchConfig
from gdp.errors import LocalError
from gdp.intervals import RELOAD_S
from gdp.management.control_client import NotRunningError, ask_node, find_control_socket
from gdp.state.control_protocol import Command
from gdp.stores.files import public, write_all


def publish_revocations(path: Path, statements: Sequence[bytes]) -> bool:
    """Give revocations to the switch that ``switch.yaml`` describes; return whether it runs.

    Raises:
        ConfigError: ``path`` is not the configuration of a switch.
        LocalError: the configuration names no ``revocations`` folder, or the files cannot be written.
    """
    config = SwitchConfig.load(path)
    if config.revocations is None:
        raise LocalError(f"{path}: a revocation needs a folder; state revocations: DIR, and restart the switch")
    files = {f"{hashlib.sha256(wire).hexdigest()[:32]}.revoke": public(wire) for wire in statements}
    write_all(config.revocations, files, force=True)
    try:
        answer = ask_node(config.control_socket or find_control_socket(config.identity), Command.RELOAD, RELOAD_S)
    except NotRunningError:
        return False
    if not answer.is_ok:
        raise LocalError(f"the switch does not spread the revocation: {answer.error}")
    return True
