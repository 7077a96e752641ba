"""Memberships, endpoint records and delegations of running machines live through many lifetimes by themselves."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import pytest

from gdp.cli.gdp import main
from gdp.control.endpoints import EndpointRecord
from gdp.enrolment.agent import Agent
from gdp.enrolment.channel import connect
from gdp.enrolment.member_files import MemberFiles
from gdp.nodes.membership import load_policy
from gdp.sharing.member_exchange import MemberExchange
from gdp.sharing.upkeep import ShareUpkeep
from gdp.stores.files import read_public
from gdp.stores.keyring import load_delegations, load_identity
from gdp.trust.adcert import AdCertCache, Chain
from lab.process import until
from tests.gdp.enrolment.lab import Lab, running_lab
from tests.gdp.enrolment.test_members import _state, running
from tests.gdp.sharing.machines import STRING

DAY_S = 86_400.0
LIFE_S = 4 * DAY_S
STEP_S = 0.15 * LIFE_S
WHOLE_S = 6 * LIFE_S  # the border's first memberships have 30 days, and are renewed after 20
LEFT_S = 0.3 * LIFE_S  # it is renewed before less than a third is left
MACHINES = ("lab", "robot", "server")
PATIENCE_S = 60.0


@dataclass
class Clock:
    """The wall clock of all machines; only the test moves it."""

    unix_s: float

    def __call__(self) -> float:
        return self.unix_s


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    made = Clock(time.time())
    monkeypatch.setattr(time, "time", made)
    monkeypatch.setitem(cast("dict[str, object]", connect.__kwdefaults__), "clock", made)
    return made


@pytest.fixture
def lab(tmp_path: Path, clock: Clock) -> Iterator[Lab]:
    """A domain whose first memberships end soon; a robot shares a topic with a server; agents and upkeep run."""
    with ExitStack() as stack:
        made = stack.enter_context(running_lab(tmp_path, member_days=LIFE_S / DAY_S))
        for label in ("robot", "server"):
            made.join(label)
        words = (
            "--type",
            STRING,
            "--days",
            str(LIFE_S / DAY_S),
            "--to",
            "server",
            "--directory",
            str(tmp_path / "robot"),
        )
        run("expose", "/chatter", *words)
        run("import", "/chatter", "--from", "robot", "--directory", str(tmp_path / "server"))
        for label in MACHINES:
            stack.enter_context(running(Agent(tmp_path / label, poll_s=0.1, clock=clock)))
        until(lambda: all(_state(tmp_path / label) == "connected" for label in MACHINES))
        for label in ("robot", "server"):
            exchange = MemberExchange(tmp_path / label, fetches=False, clock=clock)
            stack.callback(exchange.close)
            upkeep = ShareUpkeep(tmp_path / label, exchange, each_s=0.1)
            upkeep.start()
            stack.callback(upkeep.stop)
        yield made


def run(*words: str) -> None:
    """Run a command of a machine."""
    with pytest.raises(SystemExit) as leaving:
        main(words)
    assert not leaving.value.code


def ends(folder: Path, unix_s: float) -> dict[str, float]:
    """Return when each credential of the domain ends; one that is not valid now is an error."""
    found = dict[str, float]()
    for label in MACHINES:
        files = MemberFiles.load(folder / label)
        policy, proxy = load_policy(files.domain), load_identity(folder / label / "proxy", unix_s)
        for node in files.nodes:
            found[f"{label}: {node.name}"] = load_identity(node, unix_s).member.not_after_unix_s
        for path in files.config.peers.glob("*.endpoints"):
            record, member = EndpointRecord.verified(read_public(path), policy, unix_s)
            found[f"{label}: record of {member.label}"] = min(record.until_unix_s, member.not_after_unix_s)
        for delegation in load_delegations(folder / label / "proxy" / "delegations"):
            delegation.verify(proxy, unix_s)
            link = Chain.traverse(delegation.chain, delegation.subject, proxy.subject, AdCertCache(1)).links[0]
            found[f"{label}: delegation"] = link.validity.not_after_unix_s
    return found


def test_everything_is_renewed_before_it_ends_through_many_lifetimes(lab: Lab, clock: Clock) -> None:
    begun_s, seen = clock.unix_s, set[tuple[str, float]]()
    while clock.unix_s < begun_s + WHOLE_S:
        clock.unix_s += STEP_S
        end_s = time.monotonic() + PATIENCE_S
        while min((found := ends(lab.folder, clock.unix_s)).values()) < clock.unix_s + LEFT_S:
            late = {what for what, until in found.items() if until < clock.unix_s + LEFT_S}
            assert time.monotonic() < end_s, late
            time.sleep(0.02)
            clock.unix_s += 1.0
        seen |= set(found.items())
    lives = Counter(what for what, _ in seen)
    assert lives.keys() >= {"robot: switch", "robot: record of border", "lab: record of robot", "server: delegation"}
    assert min(lives.values()) >= 2, lives
    assert sum(lives.values()) > 5 * len(lives), lives
