"""Command ``gdp decrypt-pcap``: the messages of a capture, for who holds the keys of their names."""

from __future__ import annotations

import os
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer

from gdp.cli import options
from gdp.cli.output import show
from gdp.cli.program import Program
from gdp.errors import GdpError, LocalError
from gdp.extras import require_extra
from gdp.frame.codec import ETHER_BYTES, ETHERTYPE
from gdp.metadata import Metadata
from gdp.names import Name
from gdp.stores.keyring import DELEGATIONS, load_delegations, load_identity, load_owner
from gdp.terminal import echo
from gdp_extensions.dissector.capture_opener import CaptureKeys, CaptureOpener, OpenedMessage, Outcome

if TYPE_CHECKING:
    from gdp_extensions.dissector.pcap_files import CapturedFrame

app = Program("gdp decrypt-pcap")

_OPENED_PROTOCOL: Final = "gdp_opened"  # as the dissector registers it
_ETHERTYPE: Final = ETHERTYPE.to_bytes(2, "big")
_VLANS: Final = frozenset({b"\x81\x00", b"\x88\xa8"})
_NS: Final = 1_000_000_000

Capture = Annotated[Path, typer.Argument(metavar="CAPTURE", help="a pcap or pcapng file")]
Output = Annotated[Path, typer.Option("--out", "-o", metavar="FILE", help="the pcapng file to write")]
Nodes = Annotated[list[Path], typer.Option("--node", metavar="DIR", help="a node whose delegations give the keys")]
Owners = Annotated[list[Path], typer.Option("--owner", metavar="DIR", help="an owner of names")]


@app.command(no_args_is_help=True)
def decrypt_pcap(
    capture: Capture,
    out: Output,
    node: Nodes = [],  # noqa: B006 (the library copies it)
    owner: Owners = [],  # noqa: B006
    force: options.Force = False,
    as_json: options.Json = False,
) -> None:
    """Write a capture with the messages that the given keys open, for Wireshark with the dissector of gdp wireshark.

    The file has every captured frame as it was, and each opened message after the frame that completed it. No key is
    written. For each name the command says how many frames were opened, and why others were not. Signatures are not
    verified.

    \b
    Examples:
      gdp decrypt-pcap seen.pcap --node server/proxy -o plain.pcapng
      gdp decrypt-pcap seen.pcap --owner keys/lab -o plain.pcapng --json
    """
    require_extra("scapy", ("scapy",), "gdp decrypt-pcap")
    if not node and not owner:
        raise LocalError("no keys: give --node DIR for a node with delegations, or --owner DIR, or several of them")
    if out.exists() and not force:
        raise LocalError(f"{out} exists already (use --force to overwrite)")
    if out.exists() and out.samefile(capture):
        raise LocalError(f"{out} is the capture itself")
    keys, labels = _keys(node, owner)
    opener = CaptureOpener(keys)
    for _, frame in _frames(capture):
        if frame is not None:
            opener.observe(frame)
    for captured, frame in _frames(capture):  # a Heartbeat that describes messages may come after them
        if frame is not None:
            opener.handle(frame, captured.stamp_ns / _NS)
    opener.forget_frames()
    written, cut = _write(capture, out, opener)
    opener.count_unfinished()
    rows = [_row(name, labels.get(name), counts) for name, counts in sorted(opener.outcomes.items())]
    if as_json:
        show({"file": str(out), "messages": written, "cut": cut, "names": rows}, as_json=True)
        return
    for row in rows:
        if row["frames"] != row["not_sealed"]:
            echo(_line(row))
    echo(f"{sum(counts[Outcome.NOT_SEALED] for counts in opener.outcomes.values())} frames are not sealed")
    more = f", of which {cut} are cut to what Wireshark reads" if cut else ""
    echo(f"{written} opened messages in {out}{more}")


def _keys(nodes: Sequence[Path], owners: Sequence[Path]) -> tuple[CaptureKeys, dict[Name, Metadata]]:
    """Return the secrets of nodes and owners, and what names mean as far as delegations say it."""
    secrets: dict[Name, dict[int, bytes]] = {}
    labels: dict[Name, Metadata] = {}
    for directory in nodes:
        identity = load_identity(directory, time.time())
        for delegation in load_delegations(directory / DELEGATIONS):
            try:
                grants = delegation.open(identity)
            except GdpError as error:
                echo(f"left out: the delegation of {delegation.name.to_text()}: {error}", err=True)
                continue
            secrets.setdefault(delegation.name, {}).update({epoch: each.secret for epoch, each in grants.items()})
            if delegation.metadata is not None:
                labels[delegation.name] = delegation.metadata
    masters = tuple(load_owner(directory).master for directory in owners)
    if not secrets and not masters:
        raise LocalError(f"no delegation that opens is in {', '.join(str(each / DELEGATIONS) for each in nodes)}")
    return CaptureKeys(secrets, masters), labels


def _frames(path: Path) -> Iterator[tuple[CapturedFrame, bytes | None]]:
    """Yield each captured frame, and from its header on where it is one of ours."""
    from gdp_extensions.dissector.pcap_files import ETHERNET, read_capture

    for captured in read_capture(path):
        at = ETHER_BYTES - 2
        while captured.data[at : at + 2] in _VLANS:
            at += 4
        is_ours = captured.linktype == ETHERNET and captured.data[at : at + 2] == _ETHERTYPE
        yield captured, captured.data[at + 2 :] if is_ours else None


def _write(capture: Path, out: Path, opener: CaptureOpener) -> tuple[int, int]:
    """Write the file, whole or not at all; return how many messages it has, and how many of them are cut."""
    from gdp_extensions.dissector.pcap_files import PcapngWriter

    written = cut = 0
    try:
        handle, temporary = tempfile.mkstemp(dir=out.parent, prefix=f".{out.name}.")  # private: it holds plaintext
    except OSError as error:
        raise LocalError(f"{out}: {error.strerror}") from error
    try:
        with os.fdopen(handle, "wb") as file:
            writer = PcapngWriter(file)
            for captured, frame in _frames(capture):
                writer.write(captured)
                opened = [] if frame is None else opener.handle(frame, captured.stamp_ns / _NS)
                for each in opened:
                    cut += writer.write_opened(_OPENED_PROTOCOL, captured.stamp_ns, _to_wire(each))
                    written += 1
        Path(temporary).replace(out)
    except OSError as error:
        raise LocalError(f"{out}: {error.strerror}") from error
    finally:
        Path(temporary).unlink(missing_ok=True)
    return written, cut


def _to_wire(opened: OpenedMessage) -> bytes:
    from gdp_extensions.dissector.opened import ENCODINGS, OpenedFrame

    header, numbers = opened.header, {text: number for number, text in ENCODINGS.items()}
    head = OpenedFrame(
        kind=header.kind,
        flags=header.flags,
        epoch=header.epoch,
        parts=header.parts,
        number=header.number,
        incarnation=header.incarnation,
        destination=header.destination,
        source=header.source,
        topic=bytes(opened.topic),
        sequence=opened.sequence,
        restored=opened.restored,
        encoding=numbers.get(opened.encoding, 0),
    )
    return bytes(head) + opened.body


def _row(name: Name, metadata: Metadata | None, counts: Counter[Outcome]) -> dict[str, object]:
    failed = {each.value: count for each, count in counts.items() if count and each.is_failure}
    return {
        "name": name.to_text(),
        "meaning": None if metadata is None else metadata.get("name"),
        "frames": counts.total(),
        "opened": counts[Outcome.OPENED],
        "repeated": counts[Outcome.REPEATED],
        "not_sealed": counts[Outcome.NOT_SEALED],
        "not_opened": failed,
    }


def _line(row: dict[str, object]) -> str:
    failed = row["not_opened"]
    reasons = "".join(f"; {count} not: {text}" for text, count in failed.items()) if isinstance(failed, dict) else ""
    more = "".join(f", {row[key]} {key.replace('_', ' ')}" for key in ("repeated", "not_sealed") if row[key])
    label = f" ({row['meaning']})" if row["meaning"] else ""
    return f"{row['name']}{label}: {row['frames']} frames, {row['opened']} opened{more}{reasons}"
