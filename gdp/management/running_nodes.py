"""Running nodes of this machine, as far as this user may ask them: found by their control sockets.

I/O. Control sockets are host-wide. A machine of a simulated topology is a network namespace, so nodes of other
namespaces count as other machines, unless the caller wants the whole host or no node runs in its own namespace.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from gdp.errors import GdpError
from gdp.intervals import ANSWER_S
from gdp.management.control_client import NotRunningError, ask_node, control_sockets
from gdp.names import Name
from gdp.state.control_protocol import Command, Response
from gdp.state.topic_rows import TopicRow, rows_from_fields

_ROLES: Final = frozenset({"switch", "leaf", "rib", "proxy"})  # as of a membership, without what reads one


@dataclass(frozen=True, slots=True)
class RunningNode:
    """A running node.

    Args:
        role: switch, rib or proxy.
        member_label: of its membership; empty: it has none.
        is_near: whether it runs in this network namespace, as far as this user may know.
    """

    socket: Path
    role: str
    name: Name
    member_label: str = ""
    is_near: bool = True

    @property
    def label(self) -> str:
        """Return its display name, such as ``proxy 75e…0fc``."""
        return f"{self.role} {self.name.short}"

    @property
    def title(self) -> str:
        """Return the label of its membership; without one its whole name."""
        return self.member_label or self.name.to_text()


@dataclass(frozen=True, slots=True)
class NodeTopics:
    """Answer of one node.

    Args:
        mono_s: monotonic second of the counts.
        left_out: how many names the node left out of its answer.
    """

    node: RunningNode
    mono_s: float
    rows: Sequence[TopicRow]
    left_out: int = 0


@dataclass(slots=True)
class Found:
    """Nodes that answered, and the reasons of those that did not."""

    nodes: list[RunningNode] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)


def find_running_nodes(sockets: Sequence[Path] = (), *, is_host: bool = False) -> Found:
    """Return the running nodes whose sockets this user may use.

    Args:
        sockets: control sockets that configurations name, apart from those in the usual directories.
        is_host: nodes of all network namespaces; else those of this process's and of ``sockets``, if any run.
    """
    found = Found()
    for path in [*control_sockets(), *sockets]:
        try:
            response = ask_node(path, Command.STATUS, ANSWER_S)
        except NotRunningError as error:
            if path in sockets:
                found.problems.append(str(error))
            continue
        except GdpError as error:
            found.problems.append(str(error))
            continue
        node = _node(path, response)
        if node is None or node in found.nodes:
            continue
        found.nodes.append(node)
    near = [each for each in found.nodes if each.is_near or each.socket in sockets]
    if near and not is_host:
        found.nodes = near
    found.nodes.sort(key=lambda node: (node.role, node.name))
    return found


def read_topics(found: Found) -> list[NodeTopics]:
    """Return the names that the nodes carry; a node that has ended meanwhile, or is a RIB, is left out."""
    answers = list[NodeTopics]()
    for node in found.nodes:
        if node.role == "rib":
            continue
        try:
            response = ask_node(node.socket, Command.TOPICS, ANSWER_S)
            if response.is_ok:
                answers.append(NodeTopics(node, *rows_from_fields(response.result)))
            elif (problem := f"{node.label}: {response.error}") not in found.problems:
                found.problems.append(problem)
        except NotRunningError:
            continue
        except GdpError as error:
            if str(error) not in found.problems:
                found.problems.append(str(error))
    return answers


def _is_near(pid: object) -> bool:
    """Return whether a process is in this network namespace; one that this user may not ask for counts as such."""
    try:
        return Path(f"/proc/{pid}/ns/net").stat().st_ino == Path("/proc/self/ns/net").stat().st_ino
    except OSError:
        return True


def _node(path: Path, response: Response) -> RunningNode | None:
    """Return the node of a status; None: it keeps no names, such as a supervisor or a relay."""
    role, name, label = (response.result.get(key) for key in ("role", "name", "label"))
    if not isinstance(role, str) or not isinstance(name, str) or role not in _ROLES:
        return None
    try:
        is_near = _is_near(response.result.get("pid"))
        return RunningNode(path, role, Name.from_text(name), str(label or ""), is_near)
    except GdpError:
        return None
