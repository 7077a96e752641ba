"""Gathering of the facts about one name: from the nodes of this machine, and through them from the far ones.

I/O. The near proxy asks the network (``gdp/diagnosis/survey.py``). Further nodes of this machine are asked directly,
which works while the network is torn.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

from gdp.diagnosis.facts import Facts
from gdp.diagnosis.survey import ROLES, Survey
from gdp.diagnosis.view import short
from gdp.errors import LocalError
from gdp.host.ros_processes import ros_processes
from gdp.intervals import PROMPT_S
from gdp.limits import DIAGNOSTIC_REPLY_MAX_BYTES
from gdp.management.control_client import NodeConnection, NotRunningError, find_control_socket
from gdp.state.state_answers import ASK
from gdp.stores.keyring import CARD, load_card

# A long request has many frames, any of which may be lost: the last attempt is for what was cut.
_REPLY_BYTES: Final = (2_500, 2_500, DIAGNOSTIC_REPLY_MAX_BYTES)


@dataclass(frozen=True, slots=True)
class LocalDirectory:
    """A node of this machine: ``place`` is its directory, label or control socket, as the user knows it."""

    place: str
    socket: Path
    role: str = ""  # as far as known while it does not run


class FactGathering:
    """Connections to the nodes of this machine for one question.

    Args:
        asked: the name as the user typed it.
        near: the proxy that asks.
        others: further nodes of this machine.
    """

    def __init__(self, asked: str, near: LocalDirectory, others: Sequence[LocalDirectory] = ()) -> None:
        self._asked = asked
        self._near = near
        self._others = others

    def sample(self, *, with_host: bool = True) -> Facts:
        """Return what every node that answers knows now.

        Args:
            with_host: look at the ROS processes of this host, too, where a local node is missing; that takes a second.
        """
        survey, pid = Survey(self._asked), None
        with ExitStack() as stack:
            near: NodeConnection | None = None
            with _listed_if_silent(self._near, survey):
                near = self._connect(self._near, survey, stack)
            if near is not None:
                with _listed_if_silent(self._near, survey):
                    status = near.status()
                    pid = status.get("pid")
                    reply = near.ask(ASK, target=str(status.get("name")), body={"q": self._asked})
                    survey.add("proxy", _result(reply), is_near=True)
            for each in self._others:
                with _listed_if_silent(each, survey):
                    self._ask_directly(each, survey, stack)
            if near is not None:
                with _listed_if_silent(self._near, survey):
                    for round_, role in enumerate(ROLES):
                        self._ask_round(near, role, survey.targets(round_), survey, is_near=round_ == 0)
        facts = survey.facts()
        return self._with_host(facts, pid if isinstance(pid, int) else None) if with_host else facts

    def _connect(self, node: LocalDirectory, survey: Survey, stack: ExitStack) -> NodeConnection | None:
        try:
            return stack.enter_context(NodeConnection(node.socket))
        except NotRunningError:
            survey.add_silent(node.role or "node", node.place, "no process serves its control socket", is_down=True)
        return None

    def _ask_directly(self, node: LocalDirectory, survey: Survey, stack: ExitStack) -> None:
        """Ask a node of this machine through its own socket."""
        connection = self._connect(node, survey, stack)
        if connection is None:
            return
        status, near = connection.status(), survey.near
        own, role = str(status.get("name")), str(status.get("role"))
        reply = connection.ask(ASK, target=own, name=survey.name, body={"q": self._asked})
        is_its_switch = near is None or near.switch in ("", own)
        survey.add(role, _result(reply), is_near=is_its_switch and role in ("switch", "leaf"))

    def _ask_round(
        self, near: NodeConnection, role: str, targets: Sequence[str], survey: Survey, *, is_near: bool
    ) -> None:
        arguments = {"name": survey.name, "body": {"q": self._asked}, "timeout_s": PROMPT_S}
        left = list(targets)
        for reply_bytes in _REPLY_BYTES:
            requests = [(ASK, {**arguments, "target": each, "reply_bytes": reply_bytes}) for each in left]
            replies = dict(zip(left, near.ask_all(requests) if requests else (), strict=True))
            is_last = reply_bytes == _REPLY_BYTES[-1]
            left = [each for each, reply in replies.items() if _is_lacking(reply, is_last=is_last)]
            for target, reply in replies.items():
                if target in left:
                    continue
                if result := _result(reply):
                    survey.add(str(reply.get("role")), result, is_near=is_near)
                else:
                    survey.add_silent(role, short(target), str(reply.get("error") or "it withholds facts"))
        for target in left:
            survey.add_silent(role, short(target), "no answer")

    def _with_host(self, facts: Facts, pid: int | None) -> Facts:
        """Add the ROS processes of this host, where a near flow has no local node."""
        near = next((each for each in facts.proxies if each.is_near), None)
        if near is None or not near.ros_domains or all(flow.nodes for flow in near.flows):
            return facts
        proxies = frozenset[int]() if pid is None else frozenset({pid})
        return replace(facts, processes=ros_processes(proxies, pid), graph_domain=near.ros_domains[0])


def local_directory(place: str) -> LocalDirectory:
    """Return a node by its directory or control socket. Raises ``LocalError``: it is none."""
    path = Path(place)
    if path.is_socket():
        return LocalDirectory(place, path)
    socket = find_control_socket(path)
    role = load_card(path / CARD).stranger.role.value if (path / CARD).exists() else ""
    return LocalDirectory(place, socket, "switch" if role == "leaf" else role)


@contextmanager
def _listed_if_silent(node: LocalDirectory, survey: Survey) -> Iterator[None]:
    """List a node that refuses a request, or ends, among those not asked."""
    try:
        yield
    except LocalError as error:
        survey.add_silent(node.role or "node", node.place, str(error))


def _is_lacking(reply: Mapping[str, object], *, is_last: bool) -> bool:
    return reply.get("state") != "answered" or (reply.get("cut") is True and not is_last)


def _result(reply: Mapping[str, object]) -> Mapping[str, object]:
    result = reply.get("result")
    return result if isinstance(result, dict) and not reply.get("error") else {}
