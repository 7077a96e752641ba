"""Keepalive sessions that a data plane runs: when it may, and what its node still notices in time.

The data plane is a model in Python; ``tests/gdp/ports/kernel`` holds the kernel's programs to the same format.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import pytest

from gdp.control.keepalive import keepalive_header, open_keepalive, seal_keepalive
from gdp.control.link_quality import LinkReport
from gdp.crypto.statements import parse
from gdp.errors import DropReason, FrameError
from gdp.frame.codec import HEADER_BYTES, KeepaliveFlag, Kind, decode
from gdp.sansio import KeepaliveOffer, KeepaliveRun
from gdp.trust.domain import Policy
from gdp.trust.revocation import Revocation
from gdp.trust.revocations import OPERATOR
from tests.gdp.control.members import SCHOOL, UNIX_S, YEAR, at
from tests.gdp.control.test_keepalive import DETECT_S, FAST, STEP_S, A, Pair, up


@dataclass
class Session:
    """Session that the model runs."""

    offer: KeepaliveOffer
    received: int
    heard_s: float
    send_at_s: float
    sequence: int
    sent: int
    report: tuple[int, ...] = (0, 0, 0, 0)
    taken: int = 0
    replays: int = 0
    multiplier: int = 0
    sent_s: list[float] = field(default_factory=list)


class OffloadingPair(Pair):
    """Pair whose first end has a data plane that runs its session."""

    session: Session | None = None
    handed_back = 0

    def run(self, duration_s: float) -> None:
        """Let the data plane do its part in each step."""
        end_s = self.now_s + duration_s
        while self.now_s < end_s:
            super().run(STEP_S)
            if "a" not in self.frozen:
                self._tick()

    def hear(self, name: str, frame: bytes) -> None:
        """Take the keepalives that the session of the first end expects."""
        if name == "a" and decode(frame).kind == Kind.KEEPALIVE and self._takes(frame):
            return
        super().hear(name, frame)

    def _tick(self) -> None:
        session = self.session
        if session is not None and self.now_s >= session.send_at_s:
            frame = self._frame(session)
            self.frames.append(("a", frame))
            if self.passes("a", frame) and "b" not in self.frozen:
                self.hear("b", frame)
        if session is not None and self.now_s >= session.heard_s + session.offer.suspect_s:
            self._report(is_over=True)
        offers = self.ends["a"].offload.offers(self.now_s)
        if self.session is not None and (not offers or offers[0].in_key != self.session.offer.in_key):
            self._report(is_over=True)
        elif self.session is not None:
            self.session.offer = offers[0]
        elif offers:
            offer = offers[0]
            self.session = Session(
                offer, offer.received, offer.heard_s, offer.send_at_s, offer.sequence, offer.sent,
                (offer.echo, 0, 0, 0),
            )  # fmt: skip
            self._report(is_over=False)

    def _frame(self, session: Session) -> bytes:
        offer, session.sequence, session.sent = session.offer, session.sequence + 1, session.sent + 1
        session.send_at_s = self.now_s + offer.out_interval_s
        session.sent_s.append(self.now_s)
        held_us = int(1e6 * (self.now_s - session.heard_s))
        report = LinkReport(session.sent, session.report[0], held_us, offer.loss)
        header = keepalive_header(A.name, 1, session.sequence)
        return seal_keepalive(offer.out_key, header, offer.head[0], offer.head[1], offer.head[2:], report)

    def _takes(self, frame: bytes) -> bool:
        """Return whether the data plane takes a frame; news hand the session back first."""
        session = self.session
        if session is None:
            return False
        number = decode(frame).number
        if number <= session.received:
            session.replays += 1
            return True
        try:
            flags, multiplier, digest, report = open_keepalive(session.offer.in_key, frame)
        except FrameError:
            return False
        if bytes((flags, 0)) + digest != session.offer.expected:
            self._report(is_over=True)
            return False
        session.received, session.heard_s, session.multiplier = number, self.now_s, multiplier
        session.report, session.taken = report, session.taken + 1
        return True

    def _report(self, *, is_over: bool) -> None:
        session = self.session
        assert session is not None
        run = KeepaliveRun(
            0, session.offer.name, session.offer.nonce, tuple(session.sent_s), session.sequence, session.taken,
            session.received, session.heard_s, session.report, session.multiplier, session.replays, session.send_at_s,
            is_over,
        )  # fmt: skip
        session.sent_s, session.taken, session.replays = [], 0, 0
        if is_over:
            self.session, self.handed_back = None, self.handed_back + 1
        self.ends["a"].offload.take_runs([run], 0.0, at(self.now_s, UNIX_S + self.now_s))


def running() -> OffloadingPair:
    pair = OffloadingPair()
    up(pair)
    pair.refused.clear()
    assert pair.session is not None
    return pair


def test_a_session_without_news_is_left_to_the_data_plane() -> None:
    pair = running()
    pair.handed_back = 0
    pair.run(20.0)
    assert (pair.gone_s, pair.handed_back, pair.refused) == ({}, 0, [])
    assert pair.ends["b"].neighbours.loss_between(0, A.name) == 0.0


def test_a_silent_neighbour_of_the_data_plane_is_polled_and_noticed_within_the_detection_time() -> None:
    pair = running()
    cut_s = pair.now_s
    pair.passes = lambda _sender, _frame: False
    pair.run(0.3)
    assert all(gone_s - cut_s <= DETECT_S + 2 * STEP_S for gone_s in pair.gone_s.values())
    assert len(pair.gone_s) == 2
    polls = [frame for sender, frame in pair.frames if sender == "a" and decode(frame).kind == Kind.KEEPALIVE]
    assert any(frame[HEADER_BYTES] & KeepaliveFlag.POLL for frame in polls)


def test_a_frozen_node_is_noticed_although_a_data_plane_runs_its_session() -> None:
    pair = running()
    pair.frozen.add("a")
    cut_s = pair.now_s
    pair.run(0.3)
    assert pair.gone_s["b"] - cut_s <= DETECT_S + 2 * STEP_S


def test_a_poll_is_answered_and_the_session_goes_on() -> None:
    pair = running()
    lost = iter([True, True])
    pair.passes = lambda sender, _frame: sender == "b" or not next(lost, False)
    pair.run(1.0)
    assert pair.gone_s == {}
    finals = [frame for sender, frame in pair.frames if sender == "a" and decode(frame).kind == Kind.KEEPALIVE]
    assert any(frame[HEADER_BYTES] & KeepaliveFlag.FINAL for frame in finals)
    assert pair.session is not None


def test_keepalives_that_the_data_plane_missed_count_as_lost() -> None:
    pair = running()
    count = iter(range(10_000))
    pair.passes = lambda sender, _frame: sender == "a" or next(count) % 10 != 0
    pair.run(10.0)
    pair.passes = lambda _sender, _frame: True
    pair.run(0.2)
    if pair.session is not None:
        pair._report(is_over=True)
    session = pair.ends["a"].neighbours.all_up()[0].keepalives
    assert session is not None
    assert 0.02 < session.quality.loss_in < 0.2


def test_what_the_data_plane_refused_is_counted() -> None:
    pair = running()
    pair.run(0.5)
    recorded = next(frame for sender, frame in pair.frames if sender == "b" and decode(frame).kind == Kind.KEEPALIVE)
    pair.hear("a", recorded)
    assert pair.session is not None
    pair._report(is_over=False)
    assert pair.ends["a"].drops[DropReason.REPLAYED] == 1


@pytest.mark.parametrize("is_revoked", [True, False])
@pytest.mark.parametrize("is_offloaded", [True, False])
def test_what_a_neighbour_that_is_to_be_removed_has_just_sent_does_not_keep_it(
    monkeypatch: pytest.MonkeyPatch, *, is_offloaded: bool, is_revoked: bool
) -> None:
    policy = Policy(SCHOOL.root)
    monkeypatch.setattr("tests.gdp.control.test_keepalive.POLICY", policy)
    pair = running()
    end, session = pair.ends["a"], pair.session
    assert session is not None
    (neighbour,) = end.neighbours.all_up()
    assert neighbour.member is not None
    issuer, fingerprint = SCHOOL.root.subject, neighbour.member.fingerprint
    if not is_offloaded:
        pair._report(is_over=True)
    now = at(pair.now_s, UNIX_S + pair.now_s)
    neighbour.checked_s = pair.now_s
    if is_revoked:
        wire = Revocation.make(SCHOOL.key, issuer, fingerprint, YEAR.not_after_unix_s)
        policy.revoked.receive_revocation(parse(wire), OPERATOR, now, lambda _: True)
        end.recheck(fingerprint, now)
    else:  # an older node has its identity
        end.schedule_removal(neighbour, pair.now_s)
    if is_offloaded:
        session.taken, session.heard_s = session.taken + 1, pair.now_s
        pair._report(is_over=False)
    else:
        pair.now_s += FAST.transmit_ms / 1e3
        frames = [frame for out in pair.ends["b"].hellos_to_send(pair.now_s) for frame in out.frames]
        (keepalive,) = [frame for frame in frames if decode(frame).kind == Kind.KEEPALIVE]
        pair.hear("a", keepalive)
        assert pair.refused == []
    assert [change[0].name for change in end.drop_silent(pair.now_s)] == [neighbour.name]


def test_a_recording_of_a_session_that_ended_while_a_data_plane_ran_it_brings_no_life() -> None:
    pair = running()
    pair.run(0.3)
    recorded = [frame for sender, frame in pair.frames if sender == "b" and decode(frame).kind == Kind.KEEPALIVE][-1]
    end = pair.ends["a"]
    neighbour = end.neighbours.all_up()[0]
    end.schedule_removal(neighbour, pair.now_s)
    end.drop_silent(pair.now_s)
    pair._tick()  # the session ends with its neighbour
    assert end.ports[0].ended[neighbour.name, neighbour.nonce][1] == decode(recorded).number
