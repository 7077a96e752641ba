"""Settings of a session: a node's directory or a configuration file, and the options of ``gdp.open``.

I/O; loading reads files and changes nothing. ``gdp keygen node`` makes such a directory. A missing option comes from
the file of the same name (``robot/proxy.yaml`` for ``robot/proxy``) if it exists. Otherwise it comes from the
directory: ``root.crt``, ``delegations/``, and its own name for the device (``proxy0`` for ``proxy``).
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import ClassVar, Final

import orjson
from pydantic import Field, ValidationError

from gdp.config.config import LeaseSeconds
from gdp.config.schema import Directory, Domain, Ifname, Section, first_fault, load
from gdp.errors import LocalError
from gdp.intervals import ADVERTISEMENT
from gdp.runtime.busy_poll import SPIN_MAX_US, SPIN_US
from gdp.stores.keyring import DELEGATIONS, NODE_CERTIFICATE, ROOT_CERTIFICATE

MEMBER_KEYS: Final = {"identity", "domain", "iface", "delegations", "state", "lease_s", "busy_poll_us"}
_SUFFIXES: Final = (".yaml", ".yml")


class SessionConfig(Section):
    """``session.yaml``, or a ``proxy.yaml`` whose rules and graphs a session does not use."""

    renamed: ClassVar[Mapping[str, str]] = {"spin_us": "busy_poll_us"}

    identity: Directory
    domain: Domain
    iface: Ifname
    delegations: Directory | None = None
    state: Directory | None = None
    lease_s: LeaseSeconds = ADVERTISEMENT.lease_s
    busy_poll_us: int = Field(default=SPIN_US, ge=0, le=SPIN_MAX_US)
    # keys that only proxy.yaml and store.yaml use
    ros: object = None
    expose: object = None
    imports: object = Field(default=None, alias="import")
    record: object = None
    metrics: object = None
    sandbox: object = None
    holds: object = None

    @property
    def delegation_directory(self) -> Path:
        """Return the directory of the delegations."""
        return self.identity / DELEGATIONS if self.delegations is None else self.delegations


def settings_of(
    node: str | os.PathLike[str],
    *,
    iface: str | None = None,
    root: str | os.PathLike[str] | None = None,
    trusts: Sequence[str | os.PathLike[str]] | None = None,
    delegations: str | os.PathLike[str] | None = None,
    state: str | os.PathLike[str] | None = None,
    lease_s: float | None = None,
    busy_poll_us: int | None = None,
) -> SessionConfig:
    """Return the settings of a session; see ``gdp.open`` for the options.

    Raises:
        LocalError: the node does not exist, or an option is out of bounds.
        ConfigError: the configuration file is wrong.
    """
    path = Path(node).expanduser()
    values: dict[str, object] = {}
    if path.is_dir():
        if not (path / NODE_CERTIFICATE).is_file():
            raise LocalError(
                f"{path}: no node has its keys and membership here; make them with"
                f" 'gdp keygen node {path} --role proxy' and 'gdp cert issue'"
            )
        sibling = next((file for suffix in _SUFFIXES if (file := path.with_name(path.name + suffix)).is_file()), None)
        config = None if sibling is None else load(SessionConfig, sibling)
        if config is not None and config.identity.resolve() == path.resolve():
            values = config.model_dump(include=MEMBER_KEYS)
        else:
            values = {"identity": path, "iface": f"{path.name}0", "domain": {"root": path / ROOT_CERTIFICATE}}
    elif path.is_file():
        values = load(SessionConfig, path).model_dump(include=MEMBER_KEYS)
    else:
        raise LocalError(f"{path}: no such directory or file; give a node's directory, or its configuration file")
    options = {
        "iface": iface,
        "delegations": delegations,
        "state": state,
        "lease_s": lease_s,
        "busy_poll_us": busy_poll_us,
    }
    values |= {key: value for key, value in options.items() if value is not None}
    values["domain"] = _domain(values["domain"], root, trusts)
    try:
        return SessionConfig.model_validate_json(orjson.dumps(values, default=os.fspath), strict=True)
    except ValidationError as error:
        raise LocalError(f"{path}: {first_fault(error)}") from error


def _domain(
    found: object, root: str | os.PathLike[str] | None, trusts: Sequence[str | os.PathLike[str]] | None
) -> dict[str, object]:
    domain: dict[str, object] = dict(found) if isinstance(found, dict) else {}
    if root is not None:
        domain["root"] = Path(root)
    if trusts is not None:
        domain["trusts"] = [Path(each) for each in trusts]
    return domain
