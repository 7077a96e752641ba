"""The configuration of a proxy: which local topics are global, under which names, in which form.

Place: shell; loading reads files and changes nothing. What no rule names stays local.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated, Final, Literal

from pydantic import AfterValidator, BeforeValidator, Field, ValidationInfo, field_validator, model_validator

from gdp.crypto.keys import PublicKey
from gdp.errors import GdpError, LocalError
from gdp.limits import MESSAGE_MAX_BYTES
from gdp.metadata import Metadata
from gdp.names import Name
from gdp.nodes.schema import Directory, Domain, Ifname, Metrics, NewFile, Section, load, relative
from gdp.nodes.spin import SPIN_MAX_US, SPIN_US

__all__ = ["Encoding", "ProxyConfig", "Record", "Rule"]

Encoding = Literal["json", "cbor", "cdr"]

_TYPE: Final = re.compile(r"[A-Za-z][A-Za-z0-9_]*/(?:msg|srv|action)/[A-Za-z][A-Za-z0-9_]*\Z")
_OWN_KEYS: Final = frozenset({"kind", "name", "type"})


def _type_name(text: str) -> str:
    if not _TYPE.match(text):
        raise ValueError("expected a type as ROS 2 writes it, such as sensor_msgs/msg/Image (for ROS 1 as well)")
    return text


def _extra_metadata(items: dict[str, str | int]) -> dict[str, str | int]:
    if _OWN_KEYS & items.keys():
        raise ValueError(f"{', '.join(sorted(_OWN_KEYS & items.keys()))}: state it as a key of the rule itself")
    try:
        Metadata({"kind": "topic", **items})
    except LocalError as error:
        raise ValueError(str(error)) from error
    return items


def _owner_key(value: object, info: ValidationInfo) -> object:
    """Read the public key file that ``owner`` names; anything but a text goes on to be refused as such."""
    if not isinstance(value, str):
        return value
    path = relative(Path(value), info)
    try:
        return PublicKey.from_pem(path.read_bytes())
    except OSError as error:
        raise ValueError(f"expected an owner's public key file: {path}: {error.strerror}") from error
    except GdpError as error:
        raise ValueError(f"expected an owner's public key file: {path}: {error}") from error


class Rule(Section):
    """One topic that crosses; its overlay name follows from kind, name, type, metadata and owner."""

    name: str = Field(min_length=1, max_length=512)
    kind: Literal["topic"] = "topic"
    type_name: Annotated[str, AfterValidator(_type_name)] = Field(alias="type")
    metadata: Annotated[dict[str, str | int], AfterValidator(_extra_metadata)] = Field(default_factory=dict)
    owner: Annotated[PublicKey, BeforeValidator(_owner_key)]
    encoding: Encoding = "json"
    reliable: bool = True
    latched: bool = False
    priority: Literal["normal", "urgent"] = "normal"
    max_bytes: int = Field(default=MESSAGE_MAX_BYTES, ge=1, le=MESSAGE_MAX_BYTES)
    is_global: bool = Field(default=True, alias="global")

    @property
    def overlay_metadata(self) -> Metadata:
        """Return the flat map that the name digests."""
        return Metadata({"kind": self.kind, "name": self.name, "type": self.type_name, **self.metadata})

    @property
    def overlay_name(self) -> Name:
        """Return the 256-bit name under which the topic is known everywhere."""
        return self.overlay_metadata.name(self.owner.compressed)


class Record(Section):
    """Where what arrives is written."""

    path: NewFile
    format: Literal["mcap", "ros1"] = "mcap"


class ProxyConfig(Section):
    """``proxy.yaml``. ``expose`` lists what leaves this machine, ``import`` what is wanted from elsewhere."""

    identity: Directory
    domain: Domain
    iface: Ifname
    delegations: Directory
    ros: Literal[1, 2] = 2
    expose: tuple[Rule, ...] = ()
    imports: tuple[Rule, ...] = Field(default=(), alias="import")
    record: Record | None = None
    metrics: Metrics | None = None
    spin_us: int = Field(default=SPIN_US, ge=0, le=SPIN_MAX_US)

    @classmethod
    def load(cls, path: Path) -> ProxyConfig:
        """Read ``proxy.yaml``.

        Raises:
            ConfigError: every error of the file, each with line and column.
        """
        return load(cls, path)

    @field_validator("expose", "imports")
    @classmethod
    def _each_name_once(cls, rules: tuple[Rule, ...]) -> tuple[Rule, ...]:
        seen: dict[Name, str] = {}
        for rule in rules:
            if rule.overlay_name in seen:
                raise ValueError(f"two rules give the same name: {rule.name} of {rule.type_name}")
            seen[rule.overlay_name] = rule.name
        return rules

    @model_validator(mode="after")
    def _what_is_recorded_is_imported(self) -> ProxyConfig:
        if self.record is not None and not self.imports:
            raise ValueError("record: there is nothing to record without a rule under import")
        return self
