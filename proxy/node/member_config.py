"""Configuration of a member that has no rules: a door, or a tool."""

from __future__ import annotations

import os
from pathlib import Path

import orjson
from pydantic import ValidationError

from gdp.config.schema import first_fault
from gdp.errors import LocalError
from gdp.session.settings import MEMBER_KEYS, settings_of
from proxy.config.config import ProxyConfig


def member_config(node: Path, iface: str | None, delegations: Path | None) -> tuple[ProxyConfig, Path]:
    """Return the configuration of such a member, and the directory of its delegations.

    Args:
        node: its directory, or its configuration file; rules and graphs in that are not used.

    Raises:
        LocalError: the node does not exist, or its files are wrong.
    """
    settings = settings_of(node, iface=iface, delegations=delegations)
    directory = settings.delegation_directory
    if not directory.is_dir():
        raise LocalError(f"{directory}: no delegations; install one with 'gdp delegate install FILE --node {node}'")
    values = settings.model_dump(include=MEMBER_KEYS) | {"delegations": directory}
    try:
        return ProxyConfig.model_validate_json(orjson.dumps(values, default=os.fspath)), directory
    except ValidationError as error:
        raise LocalError(f"{node}: {first_fault(error)}") from error
