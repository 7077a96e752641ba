"""Rule that no file states: of one topic, service or action of a node, from the rule of kind ``node`` about it.

Sans-I/O.
"""

from __future__ import annotations

from pydantic import PrivateAttr

from gdp.config.offered_qos import OfferedQos
from gdp.ros_names import Interface
from proxy.config.rule import Rule


class BroughtRule(Rule):
    """Rule with the options and the owner of a node's; until ``of`` it is about all names."""

    _stated: Rule | None = PrivateAttr(default=None)

    @classmethod
    def by(cls, node_rule: Rule) -> BroughtRule:
        """Return the rule of all that a node has, whatever its kind."""
        rule = cls.model_construct(**{**dict(node_rule), "name": "/**", "remap": None})
        rule._stated, rule._denied = node_rule, node_rule._denied
        return rule

    def of(self, kind: Interface, local_name: str, type_name: str, offered: OfferedQos | None = None) -> BroughtRule:
        """Return the rule of one name."""
        return self.model_copy(update={"kind": kind, "name": local_name, "type_name": type_name, "offered": offered})


def stated(rule: Rule) -> Rule:
    """Return the rule as it is in the file: itself, or that of the node that brings it."""
    return (rule._stated or rule) if isinstance(rule, BroughtRule) else rule
