"""Rule of ``proxy.yaml``: a name that crosses, with its overlay name and its options.

Section of a configuration file. Validation reads the owner's public key and changes nothing.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Final, Literal

from pydantic import (
    AfterValidator,
    BeforeValidator,
    ConfigDict,
    Field,
    PrivateAttr,
    ValidationInfo,
    WithJsonSchema,
    field_validator,
)
from pydantic.config import JsonDict, JsonValue
from pydantic_core import PydanticCustomError

from gdp.client.send_options import RATE_MAX_BITS_S, RATE_MIN_BITS_S, WEIGHT_MAX, Priority, SendOptions
from gdp.config.offered_qos import OfferedQos
from gdp.config.schema import Section, relative
from gdp.crypto.keys import PublicKey
from gdp.errors import GdpError, LocalError
from gdp.intervals import DAY_S, HOUR_S
from gdp.limits import MESSAGE_MAX_BYTES
from gdp.metadata import SALT, Metadata
from gdp.names import Name
from gdp.ros_names import (
    NAME_FORM,
    NAME_MAX_CHARS,
    PATTERN_FORM,
    PREFIX_FORM,
    TYPE_FORMS,
    Kind,
    covers,
    fits_kind,
    is_name,
    is_pattern,
    leaves_out,
    matches,
    meets,
    prefixed,
    unprefixed,
)
from gdp.service.replication import Mode, Replication
from gdp.stores.files import read_private
from proxy.config.control import SomeControl
from proxy.config.frames import Frames
from proxy.config.history import SomeHistory
from proxy.config.keep import Keep
from proxy.config.readiness import Readiness
from proxy.config.reduction import CLOUD, IMAGE, QUALITY, Region, SomeAdapt, SomeCompress
from proxy.serial.serializer import Encoding
from proxy.wire.message import PictureFormat

_OWNER: Final = "owner"  # key of the validation context
CALL_S: Final = 5.0
COPIES_MAX: Final = 1_024
AT_ONCE_MAX: Final = 65_536
RATE_MAX_HZ: Final = 1e6
VOXEL_MAX_M: Final = 1e3
DOMAIN_MAX: Final = 232  # ports of a higher domain would exceed 65535; DDSI-RTPS 2.5, section 9.6.2

REDUCTIONS: Final = ("compress", "image", "quality", "voxel_m", "region", "adapt")  # keys about sending less
_OWN_KEYS: Final = ("kind", "name", "type")
_OF_KINDS: Final = {  # keys that only the rules of these kinds have
    "topics": (
        "reliable",
        "latched",
        "offered",
        "history",
        "keep",
        "max_hz",
        "deadline_ms",
        "repair",
        "readers",
        "frames",
        "stamps",
        "control",
        *REDUCTIONS,
    ),
    "services and actions": ("timeout_s", "on_timeout", "replication", "readiness", "sign"),
    "services": ("stop", "at_once", "state", "state_node"),
}


def _extra_metadata(items: dict[str, str | int]) -> dict[str, str | int]:
    if own := sorted(items.keys() & set(_OWN_KEYS)):
        raise ValueError(f"{', '.join(own)}: state it as a key of the rule itself")
    try:
        Metadata({"kind": "topic", **items})
    except LocalError as error:
        raise ValueError(str(error)) from error
    return items


def _owner_key(value: object, info: ValidationInfo) -> object:
    """Read the public key file that ``owner`` names; a value that is not text is passed on and refused as such.

    A rule without ``owner`` has that of its file, which ``keep_owner`` stored.
    """
    if value is None:
        of_file = info.context.get(_OWNER) if isinstance(info.context, dict) else None
        if of_file is None:
            raise PydanticCustomError("missing", "Field required")
        return of_file
    if not isinstance(value, str):
        return value
    path = relative(Path(value), info)
    try:
        return PublicKey.from_pem(path.read_bytes())
    except OSError as error:
        raise ValueError(f"expected an owner's public key file: {path}: {error.strerror}") from error
    except GdpError as error:
        raise ValueError(f"expected an owner's public key file: {path}: {error}") from error


def keep_owner(owner: PublicKey | None, info: ValidationInfo) -> PublicKey | None:
    """Store the owner of a file for its rules, which are validated after it with the same context."""
    if isinstance(info.context, dict):
        info.context[_OWNER] = owner
    return owner


def _without_default(schema: JsonDict) -> None:
    schema.pop("default", None)


def _salt(value: object, info: ValidationInfo) -> object:
    """Read the private file that ``salt_file`` names; a value that is not text is passed on and refused as such."""
    if not isinstance(value, str):
        return value
    if SALT in info.data.get("metadata", {}):
        raise ValueError("the salt stands under metadata as well: leave one of them out")
    path = relative(Path(value), info)
    try:
        salt = read_private(path).decode().strip()
    except (LocalError, UnicodeDecodeError) as error:
        raise ValueError(f"expected a private file with the salt as text: {error}") from error
    if not salt:
        raise ValueError(f"expected a private file with the salt as text: {path}: empty")
    return salt


def _prefix(text: str | None) -> str | None:
    """Return a namespace prefix; ``ValueError``: it is none."""
    if text is not None and (len(text) > NAME_MAX_CHARS or re.fullmatch(PREFIX_FORM, text) is None):
        raise ValueError("expected a namespace without its first slash, such as robot1 or fleet/robot1")
    return text


def _local_name(example: str) -> AfterValidator:
    """Return the validator of a full name on this machine, or none."""

    def checked(text: str | None) -> str | None:
        if text is not None and not is_name(text):
            raise ValueError(f"expected a full ROS name, such as {example}")
        return text

    return AfterValidator(checked)


def _name_pattern(text: str) -> str:
    if not is_name(text) and not is_pattern(text):
        raise ValueError("expected a full ROS name, such as /camera/image, or a pattern: /camera/* or /camera/**")
    return text


NamePattern = Annotated[
    str,
    AfterValidator(_name_pattern),
    Field(json_schema_extra={"pattern": f"^{PATTERN_FORM}$", "maxLength": NAME_MAX_CHARS}),
]
NamePatterns = tuple[NamePattern, ...]
_NAME: Final = Field(json_schema_extra={"pattern": f"^{NAME_FORM}$", "maxLength": NAME_MAX_CHARS})
NamePrefix = Annotated[
    str | None,
    AfterValidator(_prefix),
    Field(json_schema_extra={"pattern": f"^{PREFIX_FORM}$", "maxLength": NAME_MAX_CHARS}),
]
Owner = Annotated[PublicKey, BeforeValidator(_owner_key), WithJsonSchema({"type": "string", "minLength": 1})]
Salt = Annotated[str | None, BeforeValidator(_salt), Field(max_length=4_096, repr=False)]
ExtraMetadata = Annotated[dict[str, str | int], AfterValidator(_extra_metadata)]
CallSeconds = Annotated[float, Field(gt=0, le=DAY_S)]


def _by_kind(kind: Kind) -> JsonValue:
    """Return the JSON schema of the rules of one kind; a rule without ``kind`` is about a topic."""
    foreign = [key for kinds, keys in _OF_KINDS.items() if kind not in kinds for key in keys]
    then: JsonDict = {"type": {"pattern": f"^(?:|{TYPE_FORMS[kind][0]})$"}, **dict.fromkeys(foreign, False)}
    condition: JsonDict = {"properties": {"kind": {"const": kind}}, "required": [] if kind == "topic" else ["kind"]}
    return {"if": condition, "then": {"properties": then}}


class Spread(Section):
    """How requests are spread over a service's servers."""

    mode: Literal["all", "some", "hedged", "nearest"] = Field(
        default="all", description="Imported calls: which servers get a request."
    )
    copies: int = Field(default=2, ge=1, le=COPIES_MAX, description="With `some`: how many servers.")
    budget: float = Field(
        default=0.02, ge=0, le=1, description="With `hedged`: most second copies, as a share of requests."
    )


class Rule(Section):
    """What crosses: one topic, service, action or node, or all of a pattern. A node brings what it has.

    The 256-bit names follow from kind, name, type, metadata and owner.
    """

    model_config = ConfigDict(json_schema_extra={"allOf": [_by_kind(kind) for kind in TYPE_FORMS]})

    kind: Kind = Field(default="topic", description="What it is about.")
    name: NamePattern = Field(description="Full ROS name that all sides know, or a pattern.")
    type_name: str = Field(
        default="",
        alias="type",
        description="As ROS 2 writes it, for ROS 1 too. Empty: of graph, recording or delegation.",
    )
    remap: Annotated[str | None, _local_name("/camera/image"), _NAME] = Field(
        default=None, description="Its name on this machine; not with a pattern."
    )
    prefix: NamePrefix = Field(
        default=None, description="Namespace in front of `name` on the overlay. Empty: none. `null`: the file's."
    )
    metadata: ExtraMetadata = Field(
        default_factory=dict,
        description="What else the name digests: text or whole numbers.",
        json_schema_extra={"propertyNames": {"not": {"enum": list(_OWN_KEYS)}}},
    )
    salt: Salt = Field(
        default=None, alias="salt_file", description="Private file with a text that the name digests as `salt`."
    )
    owner: Owner = Field(
        default=None,
        validate_default=True,
        description="Owner's public key file. `null`: the file's; not in drop-ins.",
        json_schema_extra=_without_default,
    )
    encoding: Encoding = Field(default="json", description="How messages travel; the sender's choice holds.")
    fields_differ: Literal["strict", "default"] = Field(
        default="strict",
        alias="fields",
        description="Where two machines define a type differently: refuse, or fill missing fields and drop others.",
    )
    wants_reliable: bool | None = Field(
        default=None, alias="reliable", description="Topics: readers ask for what they miss. `null`: by QoS."
    )
    wants_latched: bool | None = Field(
        default=None, alias="latched", description="Topics: late joiners get the last message. `null`: by QoS."
    )
    offered: OfferedQos | None = Field(
        default=None, description="Imported topics: QoS until a publisher is known; by `gdp import`, or by hand."
    )
    history: SomeHistory = Field(
        default=None,
        description="What is kept for late joiners; a number: messages. Imported topics: `from-store`, or a `store`.",
    )
    keep: Keep | None = Field(
        default=None, description="Exposed topics: a capsule of all messages, here and at a holder; needs `state`."
    )
    max_hz: float | None = Field(
        default=None, gt=0, le=RATE_MAX_HZ, description="Topics: most messages a second; others are counted."
    )
    deadline_ms: float | None = Field(
        default=None,
        gt=0,
        le=1_000 * HOUR_S,
        description="Exposed best-effort topics: time to leave whole. `null`: by QoS.",
    )
    repair: Literal["never", "in-time"] = Field(
        default="in-time", description="Exposed best-effort topics: send lost parts again in time."
    )
    readers: Literal["together", "own-pace"] = Field(
        default="together",
        description="Exposed best-effort topics: all wait for the slowest, or each gets what its path carries.",
    )
    weight: int = Field(default=1, ge=1, le=WEIGHT_MAX, description="Share of a full path at the same `priority`.")
    max_bits_s: float | None = Field(
        default=None, ge=RATE_MIN_BITS_S, le=RATE_MAX_BITS_S, description="Most bits of frames a second from here."
    )
    max_bytes: int = Field(
        default=MESSAGE_MAX_BYTES,
        ge=1,
        le=MESSAGE_MAX_BYTES,
        description="Larger messages, as ROS wrote them, are counted only.",
    )
    frames: Frames | None = Field(default=None, description="Imported topics: names of coordinate frames here.")
    stamps: Literal["as-sent", "local"] = Field(
        default="as-sent", description="Imported topics: stamps of headers, by the sender's clock or by that of here."
    )
    control: SomeControl = Field(
        default=None, description="Imported topics: one far publisher is heard. Exposed: services to take control."
    )
    compress: SomeCompress = Field(default=None, description="Exposed topics: compressed bodies.")
    image: PictureFormat | None = Field(
        default=None, description="Exposed sensor_msgs/msg/Image: travels so; needs the extra `images`."
    )
    quality: int = Field(default=QUALITY, ge=1, le=100, description="With `image: jpeg`: its quality.")
    voxel_m: float | None = Field(
        default=None,
        gt=0,
        le=VOXEL_MAX_M,
        description="Exposed sensor_msgs/msg/PointCloud2: edge of voxels with one point each, metres.",
    )
    region: Region | None = Field(default=None, description="Exposed images and point clouds: the part that crosses.")
    adapt: SomeAdapt = Field(default=None, description="Exposed topics: rate and JPEG quality follow the path.")
    timeout_s: CallSeconds | None = Field(
        default=CALL_S, description="Calls: seconds for an answer; an action's result has no limit."
    )
    on_timeout: Literal["empty", "silent"] = Field(
        default="empty", description="Imported ROS 2 calls: response of zeros, or none."
    )
    replication: Spread = Field(
        default_factory=Spread, description="Imported calls: which of several servers get a request."
    )
    readiness: Readiness | None = Field(default=None, description="Exposed calls: probe of the local server.")
    stop: Annotated[str | None, _local_name("/plan/stop"), _NAME] = Field(
        default=None,
        description="Exposed services, `at_once: 1`: local std_srvs/srv/Trigger to call when no client waits.",
    )
    at_once: int | None = Field(
        default=None, ge=1, le=AT_ONCE_MAX, description="Exposed services: requests that the server has at a time."
    )
    state: Literal["none", "ordered"] = Field(
        default="none", description="Services, both sides: every server gets all requests in one order."
    )
    state_node: Annotated[str | None, _local_name("/plan/stop"), _NAME] = Field(
        default=None, description="Then: local node whose byte array parameter `state` it is."
    )
    priority: Priority = Field(default="normal", description="Rank on a full path.")
    paths: Literal[1, 2, "spread"] = Field(
        default=1, description="Both sides: frames twice over disjoint paths, or large messages shared out."
    )
    fec: Literal["auto", "never"] = Field(default="auto", description="Repeats and parity against measured loss.")
    sign: Literal["always", "session"] = Field(
        default="always", description="Calls, both sides: a secret of the proxies replaces signatures."
    )
    ros: Literal[1, 2] | None = Field(default=None, description="Which ROS, where several graphs fit.")
    domain: int | None = Field(
        default=None, ge=0, le=DOMAIN_MAX, description="Which ROS 2 domain, where several graphs fit."
    )
    is_global: bool = Field(default=True, alias="global", description="The tier above learns the name.")

    _denied: tuple[str, ...] = PrivateAttr(default=())
    _is_of_recording: bool = PrivateAttr(default=False)

    def within(self, prefix: str | None, denied: tuple[str, ...]) -> Rule:
        """Return the rule as it applies in a file.

        Args:
            prefix: the file's namespace; it applies where the rule has none of its own.
            denied: patterns of names that never cross.
        """
        rule = self.model_copy(update={"prefix": prefix or ""} if self.prefix is None else {})
        rule._denied = denied
        return rule

    def of_recording(self, changes: Mapping[str, object]) -> Rule:
        """Return the rule for a recording: with these changes, and patterns that take whatever was recorded."""
        rule = self.model_copy(update=changes)
        rule._is_of_recording = True
        return rule

    @property
    def extra(self) -> dict[str, str | int]:
        """Return the metadata that the name digests in addition to kind, name and type."""
        return self.metadata if self.salt is None else {**self.metadata, SALT: self.salt}

    @property
    def is_pattern(self) -> bool:
        """Return whether the rule is about all names of a pattern."""
        return "*" in self.name

    @property
    def local(self) -> str:
        """Return the local name, or the pattern of local names."""
        return self.remap or self.name

    @property
    def reliable(self) -> bool:
        """Return ``wants_reliable`` for a source that does not state it."""
        return self.wants_reliable is not False

    @property
    def latched(self) -> bool:
        """Return ``wants_latched`` for a source that does not state it."""
        return self.wants_latched is True

    @property
    def overlay_metadata(self) -> Metadata:
        """Return the flat map that the name digests.

        Raises:
            LocalError: a pattern, or a rule without a type: its names depend on the live graph.
        """
        if self.is_pattern or not self.type_name:
            what = "a pattern" if self.is_pattern else "a rule without a type"
            raise LocalError(f"{self.name}: {what} has no name of its own; state a full name and its type")
        return self.metadata_of(self.local, self.type_name)

    @property
    def overlay_name(self) -> Name:
        """Return the 256-bit overlay name."""
        return self.overlay_metadata.name(self.owner.compressed)

    @property
    def is_strict(self) -> bool:
        """Return whether both sides must have the same fields."""
        return self.fields_differ == "strict"

    @property
    def is_ordered(self) -> bool:
        """Return whether the rule is about a service that keeps state."""
        return self.state == "ordered"

    @property
    def spread(self) -> Replication:
        """Return how requests are distributed over servers."""
        return Replication(Mode(self.replication.mode), self.replication.copies, self.replication.budget)

    def send_options(self, deadline_s: float | None = None) -> SendOptions:
        """Return how messages leave this machine.

        Args:
            deadline_s: what the local publishers state; it holds where the rule has no deadline.
        """
        return SendOptions(
            deadline_s=deadline_s if self.deadline_ms is None else self.deadline_ms / 1_000,
            weight=self.weight,
            priority=self.priority,
            max_bits_s=self.max_bits_s,
            repairs=self.repair == "in-time",
            own_pace=self.readers == "own-pace",
            fec=self.fec == "auto",
            history_bytes=None if self.history is None else self.history.max_bytes,
            history_age_s=None if self.history is None else self.history.age_s,
        )

    def means(self, local_name: str) -> bool:
        """Return whether the rule is about a local name, denied or not."""
        if not self.is_pattern:
            return local_name == self.local
        return matches(self.name, local_name) and not self.leaves_out(local_name)

    def leaves_out(self, local_name: str) -> bool:
        """Return whether the rule is a pattern that does not mean this name only because every node has it."""
        is_match = self.is_pattern and not self._is_of_recording and matches(self.name, local_name)
        return is_match and leaves_out(self.name, self.kind, local_name)

    def denied_by(self, local_name: str) -> str | None:
        """Return the pattern under ``deny`` that covers a local name or its name on the overlay; None: none does."""
        names = (local_name, self.global_name_of(local_name))
        return next((pattern for pattern in self._denied if any(covers(pattern, name) for name in names)), None)

    @property
    def is_denied(self) -> bool:
        """Return whether the rule is about one name, and that never crosses."""
        return not self.is_pattern and self.denied_by(self.local) is not None

    def matches(self, local_name: str) -> bool:
        """Return whether the rule applies to a local name."""
        return self.means(local_name) and self.denied_by(local_name) is None

    def fits_type(self, type_name: str) -> bool:
        """Return whether the rule accepts this type; an empty type on either side is unknown and fits."""
        return not self.type_name or not type_name or self.type_name == type_name

    def global_name_of(self, local_name: str) -> str:
        """Return the name that all sides use for a local name that ``matches``."""
        return prefixed(self.prefix, local_name if self.is_pattern else self.name)

    def metadata_of(self, local_name: str, type_name: str) -> Metadata:
        """Return the metadata that the overlay name of a matching local name digests."""
        own = {"kind": self.kind, "name": self.global_name_of(local_name), "type": type_name}
        return Metadata({**own, **self.extra})

    def overlay_name_of(self, local_name: str, type_name: str) -> Name:
        """Return the 256-bit overlay name of a matching local name."""
        return self.metadata_of(local_name, type_name).name(self.owner.compressed)

    def local_of(self, metadata: Metadata) -> str | None:
        """Return the local name that this metadata describes, None if the rule does not apply to it.

        The nodes of a pattern that another machine exposes have one name, that pattern; of these a rule may take some.
        The owner is not in the metadata: compare ``overlay_name_of`` as well, or use ``matching.imported``.
        """
        name, type_name = metadata.get("name"), metadata.get("type")
        if metadata["kind"] != self.kind or not isinstance(name, str) or not isinstance(type_name, str):
            return None
        if {key: value for key, value in metadata.items() if key not in _OWN_KEYS} != self.extra:
            return None
        if not fits_kind(type_name, self.kind) or not self.fits_type(type_name):
            return None
        own = unprefixed(self.prefix, name)
        if own is None:
            return None
        if self.kind == "node" and is_pattern(own):
            local = own if meets(own, self.name) else None
        elif self.is_pattern:
            local = own if matches(self.name, own) else None
        else:
            local = self.local if own == self.name else None
        return None if local is None or self.denied_by(local) is not None else local

    @field_validator("type_name")
    @classmethod
    def _type(cls, text: str, info: ValidationInfo) -> str:
        kind: Kind | None = info.data.get("kind")
        if text and kind is not None and not fits_kind(text, kind):
            raise ValueError(
                f"expected the type of {'an' if kind == 'action' else 'a'} {kind} as ROS 2 writes it,"
                f" such as {TYPE_FORMS[kind][1]} (for ROS 1 as well)"
            )
        return text

    @field_validator("remap")
    @classmethod
    def _remap(cls, text: str | None, info: ValidationInfo) -> str | None:
        if text is not None and is_pattern(info.data.get("name", "")):
            raise ValueError("a pattern cannot be remapped; write a rule for each name")
        return text

    @field_validator("*")
    @classmethod
    def _is_of_kind(cls, value: object, info: ValidationInfo) -> object:
        field = str(info.field_name)
        for kinds, keys in _OF_KINDS.items():
            if (cls.model_fields[field].alias or field) in keys and info.data.get("kind", kinds) not in kinds:
                raise ValueError(f"only {kinds} have this")
        return value

    @field_validator("history")
    @classmethod
    def _is_latched(cls, value: object, info: ValidationInfo) -> object:
        if value is not None and info.data.get("wants_latched") is False:
            raise ValueError("this keeps messages for late joiners; leave out 'latched: false'")
        return value

    @field_validator("image", "voxel_m", "region")
    @classmethod
    def _is_of_type(cls, value: object, info: ValidationInfo) -> object:
        types = {"image": (IMAGE,), "voxel_m": (CLOUD,), "region": (IMAGE, CLOUD)}[str(info.field_name)]
        type_name = info.data.get("type_name", "")
        if value is not None and type_name and type_name not in types:
            raise ValueError(f"only topics of {' or '.join(types)} have this")
        return value

    @field_validator("quality")
    @classmethod
    def _is_of_jpeg(cls, value: int, info: ValidationInfo) -> int:
        if info.data.get("image", "jpeg") != "jpeg":
            raise ValueError("this needs 'image: jpeg'")
        return value
