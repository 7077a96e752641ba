"""``gdp expose``, ``gdp import`` and ``gdp share``: names that the nodes of a domain share, on live proxies.

I/O. Exit codes: 0 done, 1 some of it is not in force, 2 wrong input; then nothing has changed.
"""

from __future__ import annotations

import contextlib
import shutil
import time
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Final

import typer

from gdp.cli import options
from gdp.cli.machine import directory_of
from gdp.cli.output import moment, show, table
from gdp.client.send_options import RATE_MAX_BITS_S, RATE_MIN_BITS_S, WEIGHT_MAX
from gdp.enrolment.member_files import MEMBER_FILE
from gdp.errors import GdpError, LocalError
from gdp.intervals import HOUR_S, LOOK_S
from gdp.sharing.exchange import FolderExchange
from gdp.sharing.grants import ShareReport
from gdp.sharing.issued import IssuedDelegation, IssuedStore
from gdp.sharing.member_exchange import MemberExchange
from gdp.sharing.proxy_files import ProxyFiles, fits
from gdp.sharing.revocations import publish_revocations
from gdp.sharing.rules import kind_from_text
from gdp.sharing.sharing import NOT_USED, WITHDRAWN, Sharing
from gdp.sharing.state import AcceptedName, ExposedName, Offer, ShareState
from gdp.stores.issue import make_owner
from gdp.stores.keyring import CARD, OWNER_KEY, load_card, load_owner
from gdp.terminal import echo

SHARE_DAYS: Final = 30.0
_PROXY_FILE: Final = "proxy.yaml"
_SWITCH_FILE: Final = "switch.yaml"
_OWNER: Final = "owner"
_PARTLY: Final = 1
_WAITS: Final = "waits for delivery"
_NOT_IN_FORCE: Final = (NOT_USED, WITHDRAWN, _WAITS)  # states begin so
_ISSUED_COLUMNS: Final = ("name", "type", "node", "rights", "until", "state")
_OFFER_COLUMNS: Final = ("name", "type", "from", "rights", "until", "state")

AnyName = Annotated[str, typer.Argument(metavar="NAME", help="A ROS name, or a pattern: /camera/* or /camera/**.")]
OptionalName = Annotated[
    str | None, typer.Argument(metavar="NAME", help="A ROS name, or a pattern: /camera/* or /camera/**.")
]
Nodes = Annotated[list[str], typer.Option("--to", metavar="NODE", help="A node or a group; may be repeated.")]
With = Annotated[list[str], typer.Option("--with", metavar="NODE", help="A node or a group; may be repeated.")]
Source = Annotated[str | None, typer.Option("--from", metavar="NODE", help="Only what this node offers.")]
Kind = Annotated[str, typer.Option("--kind", help="topic, service or action")]
Type = Annotated[str, typer.Option("--type", help="Its type, such as sensor_msgs/msg/Image; else as it is found.")]
OwnerDir = Annotated[
    Path | None,
    typer.Option("--owner", metavar="DIR", help="The owner's directory. Default: owner, in the machine's directory."),
]
MachineDir = Annotated[
    Path | None,
    typer.Option("--directory", metavar="DIR", help="The machine's files. Default: this folder, or where it joined."),
]
ExchangeDir = Annotated[
    Path | None,
    typer.Option(
        "--exchange", metavar="DIR", help="A folder that the machines share, in place of the domain's server."
    ),
]
Encoding = Annotated[str | None, typer.Option("--encoding", help="json, cbor or cdr: how messages travel.")]
DeadlineMs = Annotated[
    float | None,
    typer.Option(
        "--deadline-ms",
        min=0.001,
        max=1_000 * HOUR_S,
        help="Best effort: a message that cannot leave within this time is dropped.",
    ),
]
NoRepair = Annotated[bool, typer.Option("--no-repair", help="Best effort: lost parts are not sent again.")]
Weight = Annotated[
    int | None, typer.Option("--weight", min=1, max=WEIGHT_MAX, help="Share of a full path, next to others.")
]
MaxBits = Annotated[
    float | None,
    typer.Option("--max-bits-s", min=RATE_MIN_BITS_S, max=RATE_MAX_BITS_S, help="Most bits of frames a second."),
]
Wait = Annotated[
    float, typer.Option("--wait", min=0.0, metavar="SECONDS", help="How long to wait for a name without a type.")
]
PlainName = Annotated[
    bool, typer.Option("--plain-name", help="A 256-bit name without a salt: who has the owner's key can guess it.")
]
Remove = Annotated[bool, typer.Option("--remove", help="Remove the rule.")]
List = Annotated[bool, typer.Option("--list", help="Show what there is, and change nothing.")]


def expose(
    name: AnyName,
    to: Nodes = [],  # noqa: B006 (the library copies it)
    source: Source = None,
    kind: Kind = "topic",
    type_: Type = "",
    owner: OwnerDir = None,
    days: options.Days = SHARE_DAYS,
    encoding: Encoding = None,
    deadline_ms: DeadlineMs = None,
    no_repair: NoRepair = False,
    weight: Weight = None,
    max_bits_s: MaxBits = None,
    plain_name: PlainName = False,
    remove: Remove = False,
    wait: Wait = 3.0,
    directory: MachineDir = None,
    exchange: ExchangeDir = None,
    as_json: options.Json = False,
) -> None:
    """Let nodes read a topic, or call a service, of this machine; the running proxy carries it at once.

    A name without --type, and a pattern, take what local nodes publish or serve, now and later. With --from the name
    is one that NODE lets this machine publish or serve.

    \b
    Examples:
      gdp expose '/camera/**' --to server
      gdp expose /camera/image --to server --deadline-ms 200 --max-bits-s 4e6
      gdp expose /plan --kind service --type nav_msgs/srv/GetPlan --to robot
      gdp expose /goal --from server
      gdp expose '/camera/**' --remove
    """
    directory = _machine_directory(directory)
    if source is None:
        name = ProxyFiles.read(directory / _PROXY_FILE).shared_name(name)
    with _sharing(directory, exchange, owner) as sharing:
        if remove:
            _show_change(name, sharing.stop_exposing(kind, name, time.time()), as_json=as_json)
            return
        if (source is None) == (not to):
            raise LocalError("expose: state --to NODE, or --from NODE for a name that NODE lets this machine publish")
        if source is not None:
            accepted = AcceptedName(side="expose", name=name, source=source)
            _show_change(name, sharing.accept(accepted, time.time()), as_json=as_json)
            return
        with _owner_of(directory, owner) as folder:
            wanted = ExposedName(
                kind=kind_from_text(kind, type_),
                name=name,
                type_name=type_,
                to=tuple(dict.fromkeys(to)),
                owner=folder,
                owner_key=load_owner(folder).public.compressed.hex(),
                days=days,
                encoding=encoding,
                deadline_ms=deadline_ms,
                repair="never" if no_repair else None,
                weight=weight,
                max_bits_s=max_bits_s,
            )
            report = sharing.expose(wanted, time.time(), is_plain=plain_name)
        until_s = time.monotonic() + wait
        while not (given := _given(folder, kind, name)) and report.is_running and time.monotonic() < until_s:
            time.sleep(LOOK_S)  # the graph of the proxy has no event for this process
            report.problems = sharing.work(time.time()).problems
        report.granted = given
        _show_change(name, report, as_json=as_json, awaited="as soon as a local node shows it")


def import_names(
    name: OptionalName = None,
    source: Source = None,
    show_list: List = False,
    remove: Remove = False,
    directory: MachineDir = None,
    exchange: ExchangeDir = None,
    as_json: options.Json = False,
) -> None:
    """Take what other nodes offer to this machine, now and later; the running proxy carries it at once.

    \b
    Examples:
      gdp import --list
      gdp import /camera/image --from robot
      gdp import '/camera/**' --remove
    """
    directory = _machine_directory(directory)
    with _sharing(directory, exchange, None) as sharing:
        if show_list:
            report = sharing.work(time.time())
            accepted = sharing.state().accepted
            offers = [_offer_fields(*each, accepted) for each in sharing.offers()]
            listed = [each.model_dump() for each in accepted]
            fields = {"offers": offers, "accepted": listed, "problems": report.problems}
            show(fields, as_json=as_json, plain=table(offers, _OFFER_COLUMNS))
        elif name is None:
            raise LocalError("import: state a NAME, or --list")
        elif remove:
            _show_change(name, sharing.stop_accepting("import", name, time.time()), as_json=as_json)
        else:
            report = sharing.accept(AcceptedName(side="import", name=name, source=source), time.time())
            accepted = sharing.state().accepted
            offers = [_offer_fields(*each, accepted) for each in sharing.offers()]
            found = [each for each in offers if each["accepted"] and fits(name, str(each["name"]))]
            _show_change(name, report, as_json=as_json, offers=found, awaited="as soon as a node offers it")


def share(
    name: OptionalName = None,
    nodes: With = [],  # noqa: B006 (the library copies it)
    publish: Annotated[bool, typer.Option("--publish", help="The right to publish a topic, in place of read.")] = False,
    serve: Annotated[bool, typer.Option("--serve", help="The right to serve, in place of call.")] = False,
    kind: Kind = "topic",
    type_: Type = "",
    owner: OwnerDir = None,
    days: options.Days = SHARE_DAYS,
    plain_name: PlainName = False,
    revoke: Annotated[str | None, typer.Option("--revoke", metavar="NODE", help="Take back what NODE got.")] = None,
    renew: Annotated[
        bool, typer.Option("--renew", help="Renew what is due and take mail, once, where no agent does it.")
    ] = False,
    show_list: List = False,
    directory: MachineDir = None,
    exchange: ExchangeDir = None,
    as_json: options.Json = False,
) -> None:
    """Let nodes act on names of this owner, or take the right back; delegations renew before they expire.

    \b
    Examples:
      gdp share /camera/image --with laptop
      gdp share /goal --type geometry_msgs/msg/PoseStamped --with robot --publish
      gdp share /camera/image --revoke laptop
      gdp share --list
    """
    directory = _machine_directory(directory)
    folder = owner or directory / _OWNER
    with _sharing(directory, exchange, owner) as sharing:
        if show_list:
            state = sharing.state()
            issued = [_issued_fields(each) for each in IssuedStore(folder) if not each.is_own]
            fields = {"exposed": _exposed_fields(state), "shared": issued}
            show(fields, as_json=as_json, plain=table(issued, _ISSUED_COLUMNS))
            return
        if renew:
            _show_change("all", sharing.work(time.time()), as_json=as_json)
            return
        if name is None or (revoke is None) == (not nodes):
            raise LocalError("share: state a NAME and --with NODE or --revoke NODE; or --list")
        if revoke is not None:
            spread = partial(publish_revocations, directory / _SWITCH_FILE)
            _show_change(name, sharing.revoke(folder, name, revoke, spread, time.time()), as_json=as_json)
            return
        known = kind_from_text(kind, type_)
        if (publish and known != "topic") or (serve and known == "topic"):
            raise LocalError("share: --publish is for a topic, --serve for --kind service or action")
        report = sharing.share(
            folder,
            name,
            nodes,
            time.time(),
            kind=known,
            type_name=type_,
            is_giving=publish or serve,
            is_plain=plain_name,
            days=days,
        )
        _show_change(name, report, as_json=as_json)


def _given(owner: Path, kind: str, name: str) -> list[IssuedDelegation]:
    """Return what was delegated of a name or a pattern, by this command or by the agent."""
    found = [
        each
        for each in IssuedStore(owner)
        if not each.is_revoked and each.metadata["kind"] == kind and fits(name, str(each.metadata["name"]))
    ]
    return sorted(found, key=lambda each: (str(each.metadata["name"]), not each.is_own, each.label))


@contextlib.contextmanager
def _owner_of(directory: Path, owner: Path | None) -> Iterator[Path]:
    """Yield an owner's directory; the machine's own owner is made if it is missing, unless the change fails."""
    folder = owner or directory / _OWNER
    if owner is not None or (folder / OWNER_KEY).exists():
        yield folder
        return
    make_owner(folder, is_salted=True)
    try:
        yield folder
    except GdpError:
        shutil.rmtree(folder)
        raise


def _machine_directory(stated: Path | None) -> Path:
    """Return the directory of this machine's files: the stated one, this folder, or the only domain that it joined."""
    if stated is None and not Path(_PROXY_FILE).exists():
        domains = directory_of("any", None).parent
        joined = sorted(each.parent for each in domains.glob(f"*/{MEMBER_FILE}"))
        if len(joined) != 1:
            what = f"several domains are in {domains}" if joined else f"no {_PROXY_FILE} is here, nor in {domains}"
            raise LocalError(f"{what}; name the machine's files with --directory")
        return joined[0]
    directory = stated or Path()
    if not (directory / _PROXY_FILE).exists():
        raise LocalError(f"{directory}: no {_PROXY_FILE} is here; name the machine's files with --directory")
    return directory


@contextlib.contextmanager
def _sharing(directory: Path, folder: Path | None, owner: Path | None) -> Iterator[Sharing]:
    """Yield the sharing of the machine in ``directory``, through a folder or the domain's server."""
    path = directory / _PROXY_FILE
    owners = [each for each in (owner or directory / _OWNER,) if (each / OWNER_KEY).exists()]
    if folder is not None:
        yield Sharing(path, FolderExchange(folder, load_card(ProxyFiles.read(path).identity / CARD)), owners)
    elif (directory / MEMBER_FILE).exists():
        with contextlib.closing(MemberExchange(directory, fetches=True)) as exchange:
            yield Sharing(path, exchange, owners)
    else:
        raise LocalError(f"{directory}: this machine has not joined a domain; state --exchange DIR, a shared folder")


def _show_change(
    name: str,
    report: ShareReport,
    *,
    as_json: bool,
    offers: Sequence[Mapping[str, object]] | None = None,
    awaited: str = "",
) -> None:
    """Print what a change did; problems go to stderr."""
    delegated = [_issued_fields(each) for each in report.granted]
    taken = offers or ()
    given = {} if offers is None else {"offers": taken}
    is_awaited = not delegated and all(str(each["state"]).startswith(WITHDRAWN) for each in taken)
    applied = {True: "now", False: "at the next start of the proxy", None: "nothing to apply"}[report.is_running]
    if awaited and is_awaited and report.is_running is not False:
        applied = awaited
    fields = {
        "name": name,
        "applied": applied,
        "is_running": report.is_running,
        **given,
        "delegated": delegated,
        "problems": report.problems,
    }
    tables = [table(delegated, _ISSUED_COLUMNS)] if delegated else []
    tables += [table(taken, _OFFER_COLUMNS)] if taken else []
    show(fields, as_json=as_json, plain="\n".join([f"{name}: {applied}", *tables]))
    lacking = [str(each["state"]) for each in (*delegated, *taken) if str(each["state"]).startswith(_NOT_IN_FORCE)]
    for text in report.problems:
        if not any(text.endswith(state.removeprefix(f"{NOT_USED}: ")) for state in lacking):
            echo(f"gdp: {text}", err=True)
    if lacking:
        echo(f"error: {name}: {len(lacking)} of the names above are not in force", err=True)
        raise typer.Exit(_PARTLY)


def _issued_fields(issued: IssuedDelegation) -> dict[str, object]:
    meaning = issued.metadata
    state = "revoked" if issued.is_revoked else "delivered" if issued.is_delivered else _WAITS
    return {
        "kind": meaning["kind"],
        "name": meaning["name"],
        "type": meaning["type"],
        "node": issued.label,
        "rights": sorted(right.value for right in issued.delegation.rights),
        "until": moment(issued.until_unix_s),
        "state": state,
    }


def _offer_fields(offer: Offer, state: str, accepted: Sequence[AcceptedName]) -> dict[str, object]:
    return {
        "kind": offer.kind,
        "name": offer.ros_name,
        "type": offer.type_name,
        "from": offer.sender,
        "rights": sorted(right.value for right in offer.delegation.rights),
        "until": moment(offer.until_unix_s),
        "owner": offer.owner.compressed.hex(),
        "accepted": any(offer.fits(each) for each in accepted),
        "state": state,
    }


def _exposed_fields(state: ShareState) -> list[dict[str, object]]:
    return [{"kind": each.kind, "name": each.name, "to": each.to, "days": each.days} for each in state.exposed]
