"""Rules of a member without configured ones: each name that its delegations let it read, call or publish.

Sans-I/O. Doors and tools have no configuration of what crosses: the owners' delegations say it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from pydantic import ValidationError

from gdp.client.participant import Topic
from gdp.config.schema import first_fault
from gdp.crypto.keys import PublicKey
from gdp.errors import GdpError
from gdp.trust.right import Right
from proxy.config.rule import Rule

_OWN_KEYS = ("kind", "name", "type")


@dataclass(frozen=True, slots=True)
class DelegatedRules:
    """Rules of the one endpoint of such a member.

    Attributes:
        left_out: names of delegations that no ROS name fits, with the reason.
    """

    expose: Sequence[Rule]
    imports: Sequence[Rule]
    left_out: Sequence[tuple[str, str]] = ()

    def endpoint_of(self, rule: Rule) -> int:
        """Return 0, the only endpoint."""
        del rule
        return 0

    def may_publish(self, topic: str, type_name: str) -> str:
        """Return why clients may not publish a topic; empty: they may."""
        return _missing(self.expose, "publish", "topic", topic, type_name)

    def may_read(self, topic: str, type_name: str) -> str:
        """Return why clients may not read a topic; an empty type fits any."""
        return _missing(self.imports, "read", "topic", topic, type_name)

    def may_call(self, name: str, kind: Literal["service", "action"] = "service") -> str:
        """Return why clients may not call a service or an action."""
        return _missing(self.imports, "call", kind, name, "")

    def type_of(self, topic: str) -> str:
        """Return the type of a topic that clients may publish; empty: none."""
        return next((rule.type_name for rule in self.expose if rule.name == topic), "")


def _missing(rules: Sequence[Rule], right: str, kind: str, name: str, type_name: str) -> str:
    types = [rule.type_name for rule in rules if (rule.kind, rule.name) == (kind, name)]
    if types and type_name in ("", *types):
        return ""
    if types:
        return f"its type is {types[0]}, not {type_name}"
    return (
        f"this door has no delegation to {right} it; the owner makes one with 'gdp delegate name --right {right}"
        f" --kind {kind} --name {name} --type {type_name or 'TYPE'} ...'"
    )


def rules_of(held: Sequence[Topic]) -> DelegatedRules:
    """Return the rules that delegations with metadata give; every other one names its reason."""
    expose, imports, left_out = list[Rule](), list[Rule](), list[tuple[str, str]]()
    for topic in held:
        metadata, rights = topic.delegation.metadata, topic.delegation.rights
        if metadata is None:
            left_out.append((topic.name.short, "the delegation does not state the name's metadata"))
            continue
        try:
            rule = Rule.model_validate(
                {
                    "kind": metadata["kind"],
                    "name": metadata["name"],
                    "type": metadata["type"],
                    "metadata": {key: value for key, value in metadata.items() if key not in _OWN_KEYS},
                    "owner": PublicKey.from_compressed(topic.delegation.subject.owner_key),
                    "encoding": "cdr",
                }
            )
        except (KeyError, ValidationError, GdpError) as error:
            first = first_fault(error) if isinstance(error, ValidationError) else f"no {error}"
            left_out.append((str(metadata.get("name", topic.name.short)), first))
            continue
        if rule.kind == "topic" and Right.PUBLISH in rights:
            expose.append(rule)
        if Right.READ in rights if rule.kind == "topic" else Right.CALL in rights:
            imports.append(rule)
    return DelegatedRules(expose, imports, left_out)
