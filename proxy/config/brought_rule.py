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
    _is_near: bool = PrivateAttr(default=False)

    @classmethod
    def by(cls, node_rule: Rule, *, is_near: bool = False) -> BroughtRule:
        """Return the rule of all that a node has, whatever its kind; ``is_near``: the node is of this graph."""
        rule = cls.model_construct(**{**dict(node_rule), "name": "/**", "remap": None})
        rule._stated, rule._denied, rule._is_near = node_rule, node_rule._denied, is_near
        return rule

    @property
    def awaits_demand(self) -> bool:
        """Return whether a name of a node here crosses only while a machine with far nodes uses it."""
        return self._is_near and self._stated is not None and self._stated.is_pattern

    @property
    def is_lazy(self) -> bool:
        """Return whether a name of a far node is used only while a local node uses it."""
        return not self._is_near and self._stated is not None and self._stated.is_pattern

    def of(self, kind: Interface, local_name: str, type_name: str, offered: OfferedQos | None = None) -> BroughtRule:
        """Return the rule of one name."""
        return self.model_copy(update={"kind": kind, "name": local_name, "type_name": type_name, "offered": offered})


def stated(rule: Rule) -> Rule:
    """Return the rule as it is in the file: itself, or that of the node that brings it."""
    return (rule._stated or rule) if isinstance(rule, BroughtRule) else rule
