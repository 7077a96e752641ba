"""Configuration of a proxy: rules (``proxy/config/rule.py``), graphs and devices.

I/O; loading reads files and changes nothing. A name that no rule matches stays local.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, ClassVar, Final, Literal, TypeAlias

from pydantic import (
    AfterValidator,
    Field,
    ValidationError,
    ValidationInfo,
    ValidatorFunctionWrapHandler,
    WrapValidator,
    model_validator,
)
from pydantic.config import JsonDict
from pydantic_core import InitErrorDetails, PydanticCustomError

from gdp.config.config import LeaseSeconds, UplinkPlane
from gdp.config.schema import (
    ControlSocket,
    Directory,
    Domain,
    Identity,
    Ifname,
    Metrics,
    NewFile,
    Sandbox,
    Section,
    StateFolder,
    load,
)
from gdp.errors import LocalError
from gdp.intervals import ADVERTISEMENT
from gdp.runtime.busy_poll import SPIN_MAX_US, SPIN_US
from proxy.config.drop_ins import DROP_INS, DropIns, add_drop_in_patterns, add_drop_in_rules
from proxy.config.graph import RosGraphConfig
from proxy.config.matching import Fault, clashes
from proxy.config.rule import REDUCTIONS, NamePatterns, NamePrefix, Owner, Rule, keep_owner
from proxy.config.status_topic import StatusTopicConfig
from proxy.serial.serializer import Encoding

__all__ = ["DIALECT", "Encoding", "ProxyConfig", "Record", "RosGraphConfig", "Rule"]

JsonSchema: TypeAlias = "dict[str, object]"

DIALECT: Final = "https://json-schema.org/draft/2020-12/schema"


def _one_or_several(value: object, validate: ValidatorFunctionWrapHandler, info: ValidationInfo) -> object:
    """Accept a single mapping for a list of one; its faults are reported at its own key."""
    if isinstance(value, dict):
        return (RosGraphConfig.model_validate(value, strict=True, context=info.context),)
    if not isinstance(value, list):
        raise ValueError("expected a mapping such as {endpoint: ros2, domain: 0}, or a list of such")
    return validate(tuple(value))


def _or_one(schema: JsonDict) -> None:
    schema["anyOf"] = [schema["items"], {"type": schema.pop("type"), "items": schema.pop("items")}]


class Record(Section):
    """Where what arrives is written."""

    path: NewFile = Field(description="File for what arrives; its directory must exist.")
    format: Literal["mcap", "ros1"] = Field(default="mcap", description="`ros1`: a bag.")
    split_bytes: int | None = Field(
        default=None, ge=1 << 20, description="Messages' bytes in one file; then `NAME_0`, `NAME_1` and so on."
    )
    split_s: float | None = Field(default=None, ge=1.0, description="Seconds of one file, likewise.")

    @property
    def is_split(self) -> bool:
        """Return whether there may be several files."""
        return self.split_bytes is not None or self.split_s is not None


class ProxyMetrics(Metrics):
    """Prometheus text of a proxy."""

    topic_names: bool = Field(
        default=False, description="Label topics with local names, for all users of the host to read."
    )


class Traces(Section):
    """Where OpenTelemetry spans of service calls go."""

    endpoint: str = Field(pattern=r"^https?://\S+$", description="OTLP over HTTP.")
    ratio: float = Field(default=1.0, ge=0.0, le=1.0, description="Share of calls traced; the same at both ends.")
    timeout_s: float = Field(default=2.0, gt=0.0, le=60.0, description="Limit of one request, seconds.")


class ProxyConfig(Section):
    """``proxy.yaml``. ``expose`` lists what leaves this machine, ``import`` what is wanted from elsewhere."""

    renamed: ClassVar[Mapping[str, str]] = {"spin_us": "busy_poll_us"}

    identity: Identity
    domain: Domain = Field(description="The trust domain, and the others whose members are believed.")
    iface: Ifname = Field(description="Device towards its switch: a name of `attach`, or a NIC.")
    delegations: Directory = Field(
        description="Directory of what owners gave this node; `gdp delegate install` fills it."
    )
    ros: Annotated[tuple[RosGraphConfig, ...], WrapValidator(_one_or_several)] = Field(
        default=(),
        description="ROS graphs to take part in, one or a list. Without: recordings only.",
        json_schema_extra=_or_one,
    )
    owner: Annotated[Owner | None, AfterValidator(keep_owner)] = Field(
        default=None, description="Owner's public key file, for rules without one."
    )
    prefix: NamePrefix = Field(
        default=None, description="Namespace of this machine on the overlay: /scan here is /robot1/scan elsewhere."
    )
    deny: Annotated[NamePatterns, AfterValidator(add_drop_in_patterns)] = Field(
        default=(),
        validate_default=True,
        description="Names and patterns that never cross, with or without prefix; `*` means hidden ones, too.",
    )
    expose: Annotated[tuple[Rule, ...], AfterValidator(add_drop_in_rules)] = Field(
        default=(), validate_default=True, description="Rules for what leaves this machine."
    )
    imports: Annotated[tuple[Rule, ...], AfterValidator(add_drop_in_rules)] = Field(
        default=(), alias="import", validate_default=True, description="Rules for what comes from elsewhere."
    )
    record: Record | None = Field(default=None, description="Write what arrives into a file.")
    status: StatusTopicConfig | None = Field(
        default=None, description="Latched local topic with who publishes, reads, serves and calls."
    )
    epochs: Literal["daily", "manual"] = Field(
        default="daily", description="New secrets of shared names each day (UTC), or only by hand."
    )
    state: StateFolder = None
    metrics: ProxyMetrics | None = Field(default=None, description="Prometheus text and probes.")
    traces: Traces | None = Field(default=None, description="Spans of service calls; needs the extra `otel`.")
    data_plane: UplinkPlane = Field(default="raw", description="`scapy` is slow, for learning.")
    lease_s: LeaseSeconds = Field(
        default=ADVERTISEMENT.lease_s, description="Lease of its advertisements, seconds; renewed after a third."
    )
    busy_poll_us: int = Field(
        default=SPIN_US,
        ge=0,
        le=SPIN_MAX_US,
        description="Microseconds of polling before a sleep, where most waits were shorter.",
    )
    control_socket: ControlSocket = None
    sandbox: Sandbox = True

    @classmethod
    def load(cls, path: Path) -> ProxyConfig:
        """Read ``proxy.yaml``, or the section ``proxy`` of ``machine.yaml``, and the rules of the drop-ins next to it.

        Raises:
            ConfigError: every error of a file, each with line and column.
        """
        drop_ins = DropIns.load(path)
        return load(cls, path, section="proxy", more={DROP_INS: drop_ins}, locate=drop_ins.locate)

    @classmethod
    def json_schema(cls) -> JsonSchema:
        """Return the JSON schema of the file, for editors."""
        stated: JsonSchema = {"items": {"required": ["owner"]}}
        either = [{"required": ["owner"]}, {"properties": {"expose": stated, "import": stated}}]
        return {**editor_schema(cls, "proxy.yaml"), "anyOf": either}

    def endpoint_of(self, rule: Rule) -> int:
        """Return the index in ``ros`` of a rule's graph; in a loaded file with any ``ros`` every rule has exactly one.

        Raises:
            LocalError: none, or more than one.
        """
        fitting = [index for index, end in enumerate(self.ros) if end.fits(rule)]
        if len(fitting) > 1:
            raise LocalError("several graphs under ros fit; say which: ros: 1 or 2, domain: its number")
        if not fitting:
            raise LocalError("none of the graphs under ros fits" if self.ros else "no graph is stated under ros")
        return fitting[0]

    @model_validator(mode="after")
    def _holds_together(self) -> ProxyConfig:
        errors: list[InitErrorDetails] = [
            {"type": PydanticCustomError("rule", "{why}", {"why": why}), "loc": key, "input": None}
            for key, why in self._faults()
        ]
        if errors:
            raise ValidationError.from_exception_data("proxy.yaml", errors)
        return self

    def _misplaced(self) -> Iterator[Fault]:
        """Yield the keys that have no meaning on their side."""
        for side, rules, only in (
            ("expose", self.expose, {"replication": "import"}),
            (
                "import",
                self.imports,
                dict.fromkeys(("keep", "readiness", "stop", "at_once", "signers", "state_node", *REDUCTIONS), "expose"),
            ),
        ):
            for index, rule in enumerate(rules):
                for key in only.keys() & rule.model_fields_set:
                    yield (side, index, key), f"this stands in rules under {only[key]}"
                if rule.state_node is not None and not rule.is_ordered:
                    yield (side, index, "state_node"), "this needs 'state: ordered'"
                if rule.history is not None and (rule.history.store is not None) != (side == "import"):
                    yield (side, index, "history"), "under import this has a 'store', under expose none"
                if rule.keep is not None and self.state is None:
                    yield (side, index, "keep"), "this needs 'state: FOLDER' of the file"
                for at, other in enumerate(rules[:index]):
                    key = "" if rule.keep is None or other.keep is None else rule.keep.disagreement(other.keep)
                    if key:
                        yield (side, index, "keep", key), f"{side}[{at}] states another one for the same capsule"
                for event in () if rule.keep is None else rule.keep.when:
                    if event.startswith("/") and not self._is_event(event):
                        yield (side, index, "keep", "when"), f"{event}: no rule of this file names such a topic or call"
                if side == "expose" and rule.stop is not None and rule.at_once != 1:
                    ordered, needs = "with 'state: ordered' nothing is broken off", "this needs 'at_once: 1'"
                    yield (side, index, "stop"), ordered if rule.is_ordered else needs
                if rule.is_ordered and rule.signers is not None:
                    yield (side, index, "signers"), "with 'state: ordered' each request counts alone"
                if rule.is_ordered and rule.at_once is not None:
                    yield (side, index, "at_once"), "with 'state: ordered' it is always 1"

    def _is_event(self, local: str) -> bool:
        """Return whether a topic has this name, an exposed service, or a goal or result of an exposed action."""
        action, _, part = local.rpartition("/")
        calls = {"service": local, "action": action if part in {"goal", "result"} else ""}
        is_topic = any(rule.kind == "topic" and rule.matches(local) for rule in (*self.expose, *self.imports))
        return is_topic or any(rule.kind in calls and rule.matches(calls[rule.kind]) for rule in self.expose)

    def _faults(self) -> Iterator[Fault]:
        if self.record is not None and not self.imports:
            yield ("record",), "there is nothing to record without a rule under import"
        try:
            wheres = [end.where for end in self.ros]
        except LocalError as error:
            yield ("ros",), str(error)
            return
        for index, where in enumerate(wheres):
            if where in wheres[:index]:
                yield ("ros", index), f"ros[{wheres.index(where)}] is the same graph"
        places: dict[int, int | None] = {}
        for side, rules in (("expose", self.expose), ("import", self.imports)):
            for index, rule in enumerate(rules):
                places[id(rule)] = None
                if not self.ros and rule.kind == "topic" and rule.ros is None and rule.domain is None:
                    continue  # recordings suffice for it
                try:
                    places[id(rule)] = self.endpoint_of(rule)
                except LocalError as error:
                    yield (side, index), str(error)
        yield from self._misplaced()
        yield from clashes(self.expose, self.imports, lambda rule: places[id(rule)])


def editor_schema(model: type[Section], title: str) -> JsonSchema:
    """Return the schema of a file; every key in it has a description."""
    schema = model.model_json_schema(by_alias=True)
    sections = schema.get("$defs", {})
    for each in (schema, *sections.values()):
        del each["title"]
        each["description"] = each["description"].replace("``", "`")
        for key in each["properties"].values():
            key.pop("title", None)  # derived from Python's names, and displayed in place of the keys
    return {"$schema": DIALECT, "title": title, **schema}
