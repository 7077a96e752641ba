"""``gdp store``: hold capsules of others, and look at those that are held here.

I/O. ``export`` and ``replay`` are commands of the package ``proxy``.
"""

from __future__ import annotations

import json as json_text
import logging
import time
from collections.abc import Mapping
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Annotated, ClassVar

import typer

from gdp.capsule.holder import HolderAnswer, HolderRequest
from gdp.capsule.record import Record, RecordType, split
from gdp.capsule.windows import Mark
from gdp.cli.extension import ANY_ARGUMENTS, ExtendedGroup, placeholder
from gdp.cli.local_nodes import Node as LocalNode
from gdp.cli.local_nodes import connect
from gdp.cli.node import AwaitIface, Check, Json, Logs, failing_clearly, report, running
from gdp.cli.program import ungrouped
from gdp.config.store_config import MIN, HolderConfig, StoreConfig
from gdp.crypto.certificates import Role
from gdp.errors import GdpError, LocalError
from gdp.intervals import ANSWER_S, DAY_S, UPKEEP_S
from gdp.links.uplink import wait_for_device
from gdp.names import ZERO, Name
from gdp.nodes.membership import load_member
from gdp.session.protocol.messages import Request
from gdp.session.session import Session, open_node
from gdp.session.settings import SessionConfig, settings_of
from gdp.stores.bucket import Bucket
from gdp.stores.bucket_folder import note_place, refuse_other_place, remove_with_bucket, stored_with_bucket
from gdp.stores.bucket_upkeep import BucketUpkeep
from gdp.stores.capsule_store import CapsuleStore, StoredCapsule, StoreLimits, marks_of
from gdp.stores.holder_exchange import run
from gdp.stores.holder_upkeep import HolderUpkeep
from gdp.terminal import echo

log = logging.getLogger(__name__)


class _Store(ExtendedGroup):
    extensions: ClassVar[Mapping[str, str]] = dict.fromkeys(("export", "replay"), "recording")


app = typer.Typer(cls=_Store, no_args_is_help=True, help="Hold capsules, the history of topics, and read them back.")

Folder = Annotated[Path, typer.Option("--store", metavar="FOLDER", help="Where the holder has its capsules.")]
Which = Annotated[str, typer.Argument(metavar="NAME", help="The capsule: its first hex digits suffice.")]
_DAMAGED = 1
_REPLY_BYTES = 1_024
_NAMES = ("topics", "writer")


@app.command(
    epilog="Examples: gdp store serve holder --store /var/lib/gdp/capsules; gdp store serve --config store.yaml"
)
@ungrouped
def serve(
    node: Annotated[
        Path | None, typer.Argument(help="The holder's node: its directory, or its configuration file.")
    ] = None,
    store: Annotated[
        Path | None, typer.Option("--store", metavar="FOLDER", help="Where the holder has its capsules.")
    ] = None,
    service: Annotated[
        str | None, typer.Option(help="Name of the service, as the owner delegated it. Default: store.")
    ] = None,
    quota: Annotated[
        float | None, typer.Option(min=MIN, metavar="GB", help="Of all topics of one owner. Default: 100.")
    ] = None,
    days: Annotated[float | None, typer.Option(min=MIN, help="Older segments go. Default: none.")] = None,
    most: Annotated[
        float | None, typer.Option(min=MIN, metavar="GB", help="Of one capsule, whose oldest segments go.")
    ] = None,
    peer: Annotated[
        list[str] | None, typer.Option(metavar="SERVICE", help="Another holder, to become equal with. Repeatable.")
    ] = None,
    bucket: Annotated[
        str | None, typer.Option(metavar="URL", help="Closed segments go to s3://NAME/PREFIX; the disk is a cache.")
    ] = None,
    cache: Annotated[
        float | None, typer.Option(min=MIN, metavar="GB", help="Of the disk, with a bucket. Default: 10.")
    ] = None,
    upload: Annotated[
        float | None, typer.Option(min=MIN, metavar="S", help="The bucket gets an open segment then. Default: 60.")
    ] = None,
    take_bucket: Annotated[
        bool, typer.Option("--take-bucket", help="Use the bucket although another holder did, which is gone.")
    ] = False,
    config: Annotated[
        Path | None, typer.Option("--config", metavar="FILE", help="A store.yaml, in place of NODE and these options.")
    ] = None,
    await_iface: AwaitIface = 0.0,
    check: Check = False,
    json: Json = False,
    *,
    logs: Logs,
) -> None:
    """Hold capsules until Ctrl-C. A full disk and a quota refuse.

    What is confirmed to a writer is on the disk; with a bucket, it is in the bucket. All is read again slowly; what is
    damaged is repaired from the bucket or another holder, and printed.
    """
    stated = {"folder": store, "service": service, "quota_gb": quota, "days": days, "most_gb": most, "peers": peer}
    stated |= {"bucket": bucket, "cache_gb": cache, "upload_s": upload}
    given = {key: value for key, value in stated.items() if value}
    with running(logs):
        member, holds = _settings(node, given, config)
        if holds.bucket is not None:
            Bucket(holds.bucket).close()
        if check:
            name = load_member(member.identity, member.domain, Role.PROXY)[0].name
            report("checked", f"configuration good: holder {name.short}", json=json, name=name.to_text())
            return
        wait_for_device(member.iface, await_iface)
        _hold(member, holds, takes=take_bucket, json=json)


def _settings(
    node: Path | None, given: Mapping[str, object], config: Path | None
) -> tuple[SessionConfig, HolderConfig]:
    """Return what a file states, or the command line. Raises ``LocalError``: neither or both do."""
    if config is not None:
        if node is not None or given:
            raise LocalError(f"{config} states all of the holder; leave out NODE and the options next to --config")
        settings = StoreConfig.load(config)
        return SessionConfig.model_construct(**dict(settings)), settings.holds
    if node is None or "folder" not in given:
        raise LocalError("a holder needs NODE and --store FOLDER, or --config FILE")
    return settings_of(node), HolderConfig.model_construct(None, **given)


def _hold(member: SessionConfig, holds: HolderConfig, *, takes: bool, json: bool) -> None:
    service, is_backed = holds.service, holds.bucket is not None
    refuse_other_place(holds.folder, holds.bucket)
    limits = StoreLimits(
        owner_bytes=int(holds.quota_gb * 1e9),
        capsule_bytes=None if holds.most_gb is None else int(holds.most_gb * 1e9),
        age_s=None if holds.days is None else holds.days * DAY_S,
        cache_bytes=int(holds.cache_gb * 1e9) if is_backed else None,
    )
    with ExitStack() as stack:
        capsules = stack.enter_context(CapsuleStore(holds.folder, limits))
        session = stack.enter_context(open_node(member))
        if holds.bucket is not None:
            bucket = stack.enter_context(Bucket(holds.bucket))
            backing = stack.enter_context(BucketUpkeep(capsules, bucket, holds.upload_s))
            backing.open(session.name, takes=takes)
            note_place(holds.folder, holds.bucket)
            backing.start()

        def answer(request: Request) -> bytes:
            return capsules.handle(request.payload, request.client)

        server = session.serve(service, answer, workers=4 if is_backed else 2, priority="background")
        text = f"holder {session.name.short} serves {service}; Ctrl-C ends it"
        report("ready", text, json=json, name=str(server.name))
        upkeep = HolderUpkeep(capsules, holds.peers, time.monotonic())
        while not server.is_closed_within(UPKEEP_S):
            for holder, steps in upkeep.handle_timer(time.monotonic()):
                try:
                    run(steps, partial(ask, session, holder))
                except GdpError as error:
                    log.warning("no exchange holder=%s reason=%s", holder, error)
                else:
                    upkeep.ended(holder, time.monotonic())
            for name, fault in capsules.poll_faults().items():
                text = fault if name == ZERO else f"capsule {name.short}: {fault}"
                report("fault", text, json=json, capsule=name.to_text(), detail=fault)


@app.command("ls", epilog="Example: gdp store ls --store /var/lib/gdp/capsules")
def list_capsules(store: Folder, json: Json = False) -> None:
    """List the capsules in a folder, with their topic, writer and bytes."""
    with failing_clearly():
        for capsule in stored_with_bucket(store):
            _print(_row(capsule), json=json)


@app.command(epilog="Example: gdp store show 75e1 --store /var/lib/gdp/capsules")
def show(name: Which, store: Folder, json: Json = False) -> None:
    """Show a capsule: who writes it, since when, each segment, and its marks, whose names are sealed."""
    with failing_clearly():
        capsule = _find(store, name)
        segments = [
            {"offset": offset, "bytes": capsule.segments.size_of(offset)} for offset in capsule.segments.offsets
        ]
        marks = [
            {"record": each.number, "at": _time(each.time_ns), "from": _time(mark.from_ns), "to": _time(mark.to_ns)}
            for each in marks_of(store, capsule.name)
            for mark in [Mark.from_record(each)]
        ]
        metadata = dict(capsule.descriptor.metadata)
        _print({**_row(capsule), "metadata": metadata, "segments": segments, "marks": marks}, json=json)


@app.command(epilog="Example: gdp store mark bumped")
def mark(
    name: Annotated[
        str, typer.Argument(metavar="NAME", help="What the event is called; readers of the topics see it.")
    ],
    node: LocalNode = None,
    json: Json = False,
) -> None:
    """Mark an event now, in every topic that a proxy of this machine keeps; windows open around it."""
    with failing_clearly(), connect(node) as connection:
        target = str(connection.status().get("name"))
        common = {"target": target, "timeout_s": ANSWER_S, "reply_bytes": _REPLY_BYTES}
        reply = connection.ask("mark", **common, body={"mark": name})
        result = reply.get("result")
        if not isinstance(result, Mapping) or not result.get("topics"):
            why = result.get("error") if isinstance(result, Mapping) else None
            raise LocalError(f"{name} is not marked: {why or 'this node keeps no topic; add keep to a rule'}")
        report("marked", f"{name} is marked in {result['topics']} topics", json=json, topics=result["topics"])


@app.command(epilog="Example: gdp store verify 75e1 --store /var/lib/gdp/capsules --known last.checkpoint")
def verify(
    name: Which,
    store: Folder,
    known: Annotated[
        Path | None, typer.Option(metavar="FILE", help="A checkpoint from elsewhere, as --checkpoint wrote it.")
    ] = None,
    checkpoint: Annotated[Path | None, typer.Option(metavar="FILE", help="Write the last checkpoint here.")] = None,
    json: Json = False,
) -> None:
    """Verify a capsule: chain, checkpoints and the writer's signature of each message. No secret is needed.

    Exit 1: something is damaged; each damage is named by the numbers of its records.
    """
    with failing_clearly():
        capsule = _find(store, name)
        audit = capsule.audit(known=None if known is None else known.read_bytes(), is_deep=True)
        signer = capsule.descriptor.writer.name.to_text()
        about = {"capsule": capsule.name.to_text(), "signer": signer, "records": audit.records, "begin": audit.begin}
        found = [each._asdict() | {"damage": each.damage.value} for each in audit.findings]
        if json:
            _print({**about, "proven": audit.proven, "findings": found}, json=True)
        else:
            echo(f"{audit.records} records from {audit.begin} on, signed by {signer}")
            for finding in audit.findings:
                echo(finding.words())
        if checkpoint is not None:
            checkpoint.write_bytes(_last_checkpoint(capsule))
    raise typer.Exit(_DAMAGED if found else 0)


@app.command(epilog="Example: gdp store rm 75e1 --store /var/lib/gdp/capsules")
def rm(name: Which, store: Folder, json: Json = False) -> None:
    """Remove a capsule from a folder whose holder does not run."""
    with failing_clearly():
        found = _find(store, name).name
        remove_with_bucket(store, found)
        report("removed", f"capsule {found.short} is removed", json=json, capsule=found.to_text())


for _name in _Store.extensions:
    app.command(_name, context_settings=ANY_ARGUMENTS)(placeholder)


def ask(session: Session, holder: str, request: HolderRequest) -> HolderAnswer:
    """Return a holder's answer. Raises ``GdpError``: there is none."""
    return HolderAnswer.from_cbor(session.call(holder, request.to_cbor(), replication=1).payload)


def _find(store: Path, digits: str) -> StoredCapsule:
    found = [each for each in stored_with_bucket(store) if each.name.to_text().startswith(digits.lower())]
    if len(found) != 1:
        raise LocalError(f"{store}: {len(found)} capsules begin with {digits!r}; gdp store ls lists them")
    return found[0]


def _row(capsule: StoredCapsule) -> dict[str, object]:
    segments, descriptor = capsule.segments, capsule.descriptor
    return {
        "capsule": capsule.name.to_text(),
        "topics": [each.to_text() for each in descriptor.topics],
        "writer": descriptor.writer.name.to_text(),
        "begun": _time(descriptor.begun_ms * 1_000_000),
        "bytes": segments.held_bytes,
        "begin": segments.begin,
        "head": segments.end,
    }


def _time(time_ns: int) -> str:
    return time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime(time_ns / 1e9))


def _last_checkpoint(capsule: StoredCapsule) -> bytes:
    last = capsule.segments.last
    wires = split(capsule.segments.read(last, capsule.segments.size_of(last))[1])
    found = [wire for wire in wires if Record.from_wire(wire).type is RecordType.CHECKPOINT]
    return found[-1]


def _print(row: Mapping[str, object], *, json: bool) -> None:
    if json:
        echo(json_text.dumps(row))
        return
    echo("  ".join(f"{key} {','.join(_short(value)) if key in _NAMES else value}" for key, value in row.items()))


def _short(names: object) -> list[str]:
    return [Name.from_text(str(each)).short for each in (names if isinstance(names, list) else [names])]
