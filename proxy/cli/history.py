"""Commands ``gdp store export`` and ``gdp store replay``: what a holder has of topics, as a recording, or live again.

I/O; the entry point of ``gdp recording`` has them.
"""

from __future__ import annotations

import re
import tempfile
from collections.abc import Iterator, Sequence
from datetime import datetime, timezone
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Annotated

import typer

from gdp.cli.node import Config, Json, Logs, MemberPlane, failing_clearly
from gdp.cli.store import ask
from gdp.client.participant import Topic
from gdp.errors import LocalError
from gdp.session.session import open_session
from gdp.trust.right import Right
from proxy.cli.tool_options import Node, print_json, print_text
from proxy.endpoints.core.endpoint import Origin
from proxy.node.history import PastMessage, TopicHistory, merged
from proxy.recordings.writer import BagWriter

_END_NS = (1 << 63) - 1
_SECONDS = re.compile(r"\d+(\.\d+)?")

Names = Annotated[list[str], typer.Argument(metavar="NAME...", help="Topics, as they were delegated, or hex digits.")]
Store = Annotated[str, typer.Option("--holder", metavar="SERVICE", help="The holder's service.")]
From = Annotated[str | None, typer.Option("--from", metavar="TIME", help="RFC 3339, or Unix seconds.")]
To = Annotated[str | None, typer.Option("--to", metavar="TIME", help="The same.")]
Output = Annotated[Path, typer.Option("--output", "-o", metavar="FILE", help="An .mcap file; .bag for ROS 1.")]


def export(
    names: Names,
    node: Node,
    output: Output,
    holder: Store = "store",
    from_: From = None,
    to: To = None,
    json: Json = False,
) -> None:
    """Write what a holder has of topics as one recording, in the order of their stamps.

    Exit 1: something is damaged, missing, or closed without a grant of its epoch; it is named.
    """
    with failing_clearly():
        is_whole = _export(names, node, holder, output, (_ns(from_, 0), _ns(to, _END_NS)), json=json)
    raise typer.Exit(0 if is_whole else 1)


def replay(
    names: Names,
    node: Node,
    config: Config,
    holder: Store = "store",
    from_: From = None,
    to: To = None,
    rate: Annotated[float, typer.Option(min=0.0, help="1: as it was; 0: as fast as readers confirm.")] = 1.0,
    data_plane: MemberPlane = None,
    json: Json = False,
    *,
    logs: Logs,
) -> None:
    """Replay what a holder has of topics onto the overlay, as ``gdp-replay`` does with a recording."""
    from proxy.cli.replay import replay as replay_recording

    with tempfile.TemporaryDirectory(prefix="gdp-history-") as folder:
        with failing_clearly():
            output = Path(folder) / "history.mcap"
            _export(names, node, holder, output, (_ns(from_, 0), _ns(to, _END_NS)), json=json)
        replay_recording(output, config, rate=rate, data_plane=data_plane, json=json, logs=logs)


def _export(
    names: Sequence[str], node: Path, holder: str, output: Path, span_ns: tuple[int, int], *, json: bool
) -> bool:
    """Write the recording, and report; return whether it has all."""
    with open_session(node) as session:
        histories = [
            TopicHistory(partial(ask, session, holder), topic, _name_of(topic, name), *span_ns)
            for name in names
            for topic in [session.core.resolve(name, Right.READ)]
        ]
        if not any(each.readers for each in histories):
            raise LocalError(f"{holder} has no capsule of {', '.join(names)}")
        count = _write(output, merged(histories))
    is_whole = True
    for history in histories:
        for reader in history.readers:
            findings = [each.words() for each in reader.audit.findings]
            lost = [f"messages {each.first} to {each.last} are in no record" for each in reader.lost]
            closed = [f"{number} records of epoch {epoch} are closed" for epoch, number in reader.opener.closed.items()]
            unread = [f"{number} messages: {why}" for why, number in history.unreadable.items()]
            problems = [*findings, *lost, *closed, *unread]
            is_whole &= not problems
            capsule = reader.descriptor.name.to_text()
            about = {"topic": history.name, "capsule": capsule, "signer": reader.descriptor.writer.name.to_text()}
            if json:
                print_json({"event": "capsule", **about, "records": reader.audit.records, "problems": problems})
            else:
                print_text(f"{history.name}: {reader.audit.records} records, signed by {about['signer']}")
                for problem in problems:
                    print_text(f"  {problem}")
    if json:
        print_json({"event": "done", "file": str(output), "messages": count})
    else:
        print_text(f"{count} messages are in {output}")
    return is_whole


def _write(output: Path, messages: Iterator[PastMessage]) -> int:
    """Write messages into a new recording; return how many."""
    first = next(messages, None)
    with BagWriter(output, 2 if first is None else first.channel.ros) as writer:
        for message in chain(() if first is None else (first,), messages):
            origin = Origin(message.stamp_ns, message.sequence)
            writer.write(writer.add(message.channel), message.stamp_ns, message.raw, origin)
    return writer.written


def _name_of(topic: Topic, name: str) -> str:
    metadata = topic.delegation.metadata
    return name if metadata is None else str(metadata.get("name", name))


def _ns(text: str | None, otherwise: int) -> int:
    """Return a time in Unix nanoseconds. Raises ``LocalError``: it is none."""
    if text is None:
        return otherwise
    if _SECONDS.fullmatch(text):
        return int(float(text) * 1e9)
    try:
        moment = datetime.fromisoformat(text.replace("Z", "+00:00"))
    except ValueError as error:
        raise LocalError(f"{text}: expected a time such as 2026-11-30T12:00:00Z, or Unix seconds") from error
    return int((moment if moment.tzinfo else moment.replace(tzinfo=timezone.utc)).timestamp() * 1e9)
