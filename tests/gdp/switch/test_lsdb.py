"""Link-state database: the newest counts, unrenewed ones expire, a domain's inside stays inside."""

from __future__ import annotations

import pytest

from gdp.control.link_state import Scope
from gdp.errors import DropReason, StatementError
from gdp.intervals import LINK_STATE
from gdp.switch import lsdb
from gdp.switch.lsdb import LinkStateDatabase
from tests.gdp.switch.net import AWAY, HOME, known, link, name, state


def test_the_newest_wins_in_whatever_order_they_come() -> None:
    for sequences in ((1, 2), (2, 1)):
        states = known(*(state("a", link("b", sequence), sequence=sequence) for sequence in sequences))
        assert [each.sequence for each in states.states(Scope.DOMAIN)] == [2]


def test_the_same_again_is_no_news() -> None:
    states = known(state("a"))
    assert states.put(state("a"), b"", 0.0) is False


def test_a_change_of_links_is_a_new_version_and_a_renewal_is_not() -> None:
    states = known(state("a", link("b")))
    before = states.version
    states.put(state("a", link("b"), sequence=2), b"", 0.0)
    assert states.version == before
    states.put(state("a", link("b", 99), sequence=3), b"", 0.0)
    assert states.version > before


def test_a_link_or_a_state_that_goes_is_a_loss_and_another_cost_or_a_new_link_is_none() -> None:
    states = known(state("a", link("b")))
    states.put(state("a", link("b", 99), sequence=2), b"", 0.0)
    states.put(state("a", link("b"), link("c"), sequence=3), b"", 0.0)
    assert states.losses == 0
    states.put(state("a", link("c"), sequence=4), b"", 0.0)
    assert states.losses == 1
    states.expire(LINK_STATE.lease_s)
    assert states.losses == 2


def test_what_is_not_renewed_is_forgotten() -> None:
    states = known(state("a"))
    assert states.next_expiry() == LINK_STATE.lease_s
    before = states.version
    states.expire(LINK_STATE.lease_s)
    assert (len(states), states.next_expiry()) == (0, None)
    assert states.version > before


def test_another_domain_gets_border_states_only() -> None:
    states = known(state("a"), state("b", scope=Scope.BORDER))
    assert states.shared_with(AWAY) == [b"wire of " + name("b")]
    assert len(states.shared_with(HOME)) == 2


def test_digests_are_equal_when_and_only_when_both_have_the_same() -> None:
    one, two = known(state("a"), state("b")), known(state("b"), state("a"))
    assert one.digest(HOME) == two.digest(HOME)
    two.put(state("b", sequence=2), b"", 0.0)
    assert one.digest(HOME) != two.digest(HOME)


def test_the_digest_for_another_domain_leaves_our_inside_out() -> None:
    one = known(state("a"), state("b", scope=Scope.BORDER))
    assert one.digest(AWAY) == known(state("b", scope=Scope.BORDER)).digest(AWAY)


def test_a_full_database_refuses_whom_it_does_not_know(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lsdb, "LINK_STATES_MAX", 1)
    states: LinkStateDatabase = known(state("a"))
    with pytest.raises(StatementError) as caught:
        states.put(state("b"), b"", 0.0)
    assert caught.value.reason is DropReason.QUOTA
    assert states.put(state("a", sequence=2), b"", 0.0) is True
