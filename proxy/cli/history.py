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

from gdp.capsule.holder import HolderAnswer, HolderRequest
from gdp.capsule.opening import NamedMark
from gdp.capsule.windows import Mark
from gdp.cli.node import Config, Json, Logs, MemberPlane, failing_clearly, report
from gdp.client.participant import Topic
from gdp.errors import LocalError
from gdp.session.protocol.nearest_holder import NearestHolder
from gdp.session.session import Session, open_session
from gdp.trust.right import Right
from proxy.cli.replay import SkipEmpty, WaitReaders
from proxy.cli.replay import replay as replay_recording
from proxy.cli.tool_options import Node, print_json, print_text
from proxy.endpoints.core.endpoint import Origin
from proxy.node.history import History, PastMessage, marks_of
from proxy.recordings.folder_writer import write_folder
from proxy.recordings.writer import BagWriter

_MARK = "mark:"
_END_NS = (1 << 63) - 1
_SECONDS = re.compile(r"\d+(\.\d+)?")

Names = Annotated[list[str], typer.Argument(metavar="NAME...", help="Topics, as they were delegated, or hex digits.")]
Store = Annotated[
    list[str] | None,
    typer.Option("--holder", metavar="SERVICE", help="A holder. Repeatable: the nearest is read. Default: store."),
]
From = Annotated[str | None, typer.Option("--from", metavar="TIME", help="RFC 3339, Unix seconds, or mark:NAME.")]
To = Annotated[str | None, typer.Option("--to", metavar="TIME", help="The same.")]
Output = Annotated[
    Path, typer.Option("--output", "-o", metavar="FILE", help="An .mcap file, .bag for ROS 1, else a folder (rosbag2).")
]


def export(
    names: Names,
    node: Node,
    output: Output,
    holder: Store = None,
    from_: From = None,
    to: To = None,
    mark: Annotated[
        str | None, typer.Option(metavar="NAME", help="Each window of this event is a recording: FILE-1, FILE-2, ...")
    ] = None,
    json: Json = False,
) -> None:
    """Write what a holder has of topics as one recording, in the order of their stamps.

    The mark of a call has the client after its name, that of a goal the goal's id: 'mark:/drive/goal' is the last goal.

    Exit 1: something is damaged, missing, or closed without a grant of its epoch; it is named.
    """
    with failing_clearly():
        is_whole, count = _export(names, node, holder or ["store"], output, (from_, to, mark), json=json)
        if json:
            print_json({"event": "done", "file": str(output), "messages": count})
        else:
            print_text(f"{count} messages are in {output}")
    raise typer.Exit(0 if is_whole else 1)


def replay(
    names: Names,
    node: Node,
    config: Config,
    holder: Store = None,
    from_: From = None,
    to: To = None,
    rate: Annotated[float, typer.Option(min=0.0, help="1: as it was; 0: as fast as readers confirm.")] = 1.0,
    skip_empty: SkipEmpty = None,
    wait_readers: WaitReaders = 15.0,
    data_plane: MemberPlane = None,
    json: Json = False,
    *,
    logs: Logs,
) -> None:
    """Replay what a holder has of topics onto the overlay, as ``gdp-replay`` does with a recording.

    Exit 1: as of ``export`` and of ``gdp-replay``.
    """
    with tempfile.TemporaryDirectory(prefix="gdp-history-") as folder:
        with failing_clearly():
            output = Path(folder) / "history.mcap"
            is_whole, _ = _export(names, node, holder or ["store"], output, (from_, to, None), json=json)
        try:
            replay_recording(
                output, config, rate, skip_empty, wait_readers, data_plane=data_plane, json=json, logs=logs
            )
        except typer.Exit as ended:
            raise typer.Exit(ended.exit_code or (0 if is_whole else 1)) from ended


def _export(
    names: Sequence[str], node: Path, holders: Sequence[str], output: Path, span: Sequence[str | None], *, json: bool
) -> tuple[bool, int]:
    """Write the recordings, and report; return whether they have all, and how many messages they have."""
    from_, to, mark = span
    if mark is not None and (from_ or to):
        raise LocalError("--mark states both ends of each recording; leave out --from and --to")
    is_whole, count = True, 0
    with open_session(node) as session:
        nearest = session.core.nearest_holder(holders)
        ask_holder = partial(_ask, session, nearest)
        topics = [session.core.resolve(name, Right.READ) for name in names]
        is_marked = mark is not None or any(text is not None and text.startswith(_MARK) for text in (from_, to))
        marks = [mark for topic in topics for mark in marks_of(ask_holder, topic)] if is_marked else []
        titles = [_name_of(topic, name) for name, topic in zip(names, topics, strict=True)]
        spans = {output: (_ns(from_, 0, marks), _ns(to, _END_NS, marks, is_end=True))}
        if mark is not None:
            windows = enumerate(_windows(mark, marks), 1)
            spans = {output.with_stem(f"{output.stem}-{at}"): (each.from_ns, each.to_ns) for at, each in windows}
        for file, (from_ns, to_ns) in spans.items():
            history = History(ask_holder, list(zip(topics, titles, strict=True)), from_ns, to_ns)
            if not history.readers:
                raise LocalError(f"{', '.join(holders)}: no capsule of {', '.join(names)}")
            written = _write(file, history.messages())
            count += written
            is_whole &= _report(history, json=json)
            if mark is not None:
                report("window", f"{written} messages are in {file}", json=json, file=str(file), messages=written)
    for choice in nearest.choices:
        print_json({"event": "holder", **choice._asdict()}) if json else print_text(choice.words())
    return is_whole, count


def _report(history: History, *, json: bool) -> bool:
    """Report what was read of the capsules; return whether that is all."""
    is_whole = True
    for reader in history.readers:
        of = {each: history.names[each] for each in reader.descriptor.topics if each in history.names}
        findings = [each.words() for each in reader.audit.findings]
        lost = [f"{of[each.topic]}: messages {each.first} to {each.last} are in no record" for each in reader.lost]
        closed = [f"{number} records of epoch {epoch} are closed" for epoch, number in reader.opener.closed.items()]
        unread = [
            f"{of[each]}: {count} messages: {why}" for each in of for why, count in history.unreadable[each].items()
        ]
        problems = [*findings, *lost, *closed, *unread]
        is_whole &= not problems
        topic, capsule = ", ".join(of.values()), reader.descriptor.name.to_text()
        about = {"topic": topic, "capsule": capsule, "signer": reader.descriptor.writer.name.to_text()}
        if json:
            read = {
                "records": reader.audit.records,
                "left_out": sum(each.last - each.first + 1 for each in reader.left_out),
                "marks": [{"name": each.name, "at_ns": each.time_ns} for each in reader.opener.marks],
            }
            print_json({"event": "capsule", **about, **read, "problems": problems})
        else:
            print_text(f"{topic}: {reader.audit.records} records, signed by {about['signer']}")
            for line in [*(f"mark {each.name}" for each in reader.opener.marks), *problems]:
                print_text(f"  {line}")
    return is_whole


def _ask(session: Session, holder: NearestHolder, request: HolderRequest) -> HolderAnswer:
    """Return the answer of the nearest holder. Raises ``GdpError``: there is none."""
    driver = session.driver
    driver.run(lambda: holder.begin(request, driver.now_s()))
    driver.wait(lambda: holder.is_done, None)
    return driver.run(holder.poll_answer) or HolderAnswer()


def _write(output: Path, messages: Iterator[PastMessage]) -> int:
    """Write messages into a new recording; return how many."""
    if not output.suffix:
        return write_folder(output, ((each.stamp_ns, each.channel, each.raw) for each in messages))
    first = next(messages, None)
    with BagWriter(output, 2 if first is None else first.channel.ros) as writer:
        for message in chain(() if first is None else (first,), messages):
            origin = Origin(message.stamp_ns, message.sequence)
            writer.write(writer.add(message.channel), message.stamp_ns, message.raw, origin)
    return writer.written


def _name_of(topic: Topic, name: str) -> str:
    metadata = topic.delegation.metadata
    return name if metadata is None else str(metadata.get("name", name))


def _windows(name: str, marks: Sequence[NamedMark]) -> list[Mark]:
    """Return the windows of the marks whose first words these are. Raises ``LocalError``: there is none."""
    found = {each.time_ns: each.window for each in sorted(marks) if f"{each.name} ".startswith(f"{name} ")}
    if not found:
        raise LocalError(f"mark {name}: known marks: {', '.join(sorted({each.name for each in marks})) or 'none'}")
    return list(found.values())


def _ns(text: str | None, otherwise: int, marks: Sequence[NamedMark], *, is_end: bool = False) -> int:
    """Return a time in Unix nanoseconds; of a mark, where its window begins or ends. Raises ``LocalError``: none."""
    if text is None:
        return otherwise
    if text.startswith(_MARK):
        last = _windows(text.removeprefix(_MARK), marks)[-1]
        return last.to_ns if is_end else last.from_ns
    if _SECONDS.fullmatch(text):
        return int(float(text) * 1e9)
    try:
        moment = datetime.fromisoformat(text.replace("Z", "+00:00"))
    except ValueError as error:
        raise LocalError(f"{text}: expected a time such as 2026-11-30T12:00:00Z, or Unix seconds") from error
    return int((moment if moment.tzinfo else moment.replace(tzinfo=timezone.utc)).timestamp() * 1e9)
