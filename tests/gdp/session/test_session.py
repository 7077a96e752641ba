"""Session API over the simulated network: publish, subscribe and close."""

from __future__ import annotations

import pytest

import gdp
from gdp.client.send_options import SendOptions
from gdp.errors import DropReason, LocalError
from gdp.message.loss import LossReason
from gdp.metadata import Metadata
from gdp.names import Name
from gdp.session.protocol.core import QUEUE_MAX_BYTES
from gdp.trust.right import Right
from tests.gdp.session.simulated import Simulated, world_of

PUBLISH, READ = [Right.PUBLISH], [Right.READ]


@pytest.fixture
def pair() -> Simulated:
    return world_of({"robot": {"/camera": PUBLISH}, "server": {"/camera": READ}})


def crossing(pair: Simulated, **options: object) -> tuple[gdp.Publisher, gdp.Subscription]:
    """Return both ends of a topic, joined."""
    publisher = pair.sessions["robot"].publisher("camera", reliable=True)
    subscription = pair.sessions["server"].subscribe("camera", **options)  # type: ignore[arg-type]
    publisher.wait_for_readers(timeout_s=5)
    return publisher, subscription


def test_a_message_arrives_with_its_publisher_number_hops_and_stamp(pair: Simulated) -> None:
    publisher, subscription = crossing(pair)
    publisher.put(b"one")
    publisher.put(b"two")
    first, second = subscription.receive(5), subscription.receive(5)
    assert (first.payload, second.payload) == (b"one", b"two")
    assert first.publisher == pair.sessions["robot"].name
    assert (first.number, second.number) == (1, 2)
    assert first.hops == 1
    assert 0 < first.stamp <= second.stamp


def test_messages_are_iterated_until_the_subscription_is_closed(pair: Simulated) -> None:
    publisher, subscription = crossing(pair)
    for payload in (b"a", b"b"):
        publisher.put(payload)
    pair.run(1.0)
    subscription.close()
    assert [message.payload for message in subscription] == [b"a", b"b"]


def test_a_receive_that_times_out_says_how_many_publishers_are_there(pair: Simulated) -> None:
    _, subscription = crossing(pair)
    with pytest.raises(gdp.SessionTimeoutError, match=r"/camera: no message within 0.5 s; 1 publisher\(s\)"):
        subscription.receive(0.5)


def test_what_no_session_sent_is_counted_and_said(pair: Simulated) -> None:
    publisher, subscription = crossing(pair)
    for message in (b"short", b"\x07" + bytes(20)):
        publisher._publisher.publish(message)
    with pytest.raises(gdp.SessionTimeoutError, match=r"1 publisher\(s\) are there, and 2 messages that no session"):
        subscription.receive(0.5)
    drops = pair.sessions["server"].core.member.drops()
    assert (drops[DropReason.MALFORMED], drops[DropReason.BAD_VERSION]) == (1, 1)
    publisher.put(b"good")
    assert subscription.receive(5).payload == b"good"


def test_a_publisher_without_readers_says_what_to_do(pair: Simulated) -> None:
    publisher = pair.sessions["robot"].publisher("camera")
    with pytest.raises(gdp.SessionTimeoutError, match="start a program that subscribes"):
        publisher.wait_for_readers(timeout_s=0.5)


def test_one_thread_receives_from_several_subscriptions() -> None:
    both = world_of({"robot": {"a": PUBLISH, "b": PUBLISH}, "server": {"a": READ, "b": READ}})
    subscriptions = [both.sessions["server"].subscribe(name) for name in "ab"]
    publisher = both.sessions["robot"].publisher("b")
    publisher.wait_for_readers(timeout_s=5)
    publisher.put(b"x")
    source, message = both.sessions["server"].receive_any(subscriptions, 5)
    assert (source, message.payload) == (subscriptions[1], b"x")


def test_a_full_queue_drops_the_oldest_and_counts_it(pair: Simulated) -> None:
    publisher, subscription = crossing(pair, queue=2)
    for payload in (b"a", b"b", b"c"):
        publisher.put(payload)
    pair.run(1.0)
    assert subscription.dropped == 1
    assert [subscription.receive(0).payload for _ in range(2)] == [b"b", b"c"]


def test_a_queue_holds_a_bounded_number_of_bytes(pair: Simulated, monkeypatch: pytest.MonkeyPatch) -> None:
    assert QUEUE_MAX_BYTES == 64 << 20
    monkeypatch.setattr("gdp.session.protocol.core.QUEUE_MAX_BYTES", 2_500)
    publisher, subscription = crossing(pair)
    for payload in (b"a" * 1_000, b"b" * 1_000, b"c" * 1_000):
        publisher.put(payload)
    pair.run(1.0)
    assert subscription.dropped == 1
    assert subscription.receive(0).payload[:1] == b"b"


def test_a_flushed_message_is_confirmed(pair: Simulated) -> None:
    publisher, _ = crossing(pair)
    publisher.put(b"x")
    publisher.flush(timeout_s=5)
    assert publisher.confirmed == 1


def test_a_best_effort_message_is_sent_and_never_confirmed(pair: Simulated) -> None:
    publisher = pair.sessions["robot"].publisher("camera", reliable=False)
    pair.sessions["server"].subscribe("camera")
    publisher.wait_for_readers(timeout_s=5)
    publisher.put(b"x")
    publisher.flush(timeout_s=5)
    assert (publisher.sent, publisher.confirmed, publisher.expired, publisher.reader_lost) == (1, 0, 0, 0)


def test_a_message_that_cannot_leave_in_time_is_counted_and_its_reader_reports_it(pair: Simulated) -> None:
    publisher = pair.sessions["robot"].publisher("camera", reliable=False, deadline_s=0.1, max_bits_s=8_000)
    subscription = pair.sessions["server"].subscribe("camera")
    publisher.wait_for_readers(timeout_s=5)
    publisher.put(bytes(5_000))
    pair.run(3.0)
    assert (publisher.sent, publisher.expired, publisher.reader_lost, subscription.lost) == (0, 1, 1, 1)


def test_the_options_of_a_publisher_reach_its_topic(pair: Simulated) -> None:
    options = SendOptions(deadline_s=0.2, weight=3, max_bits_s=1e6, repairs=False)
    publisher = pair.sessions["robot"].publisher(
        "camera", reliable=False, deadline_s=0.2, weight=3, max_bits_s=1e6, repairs=False
    )
    assert publisher._publisher.options == options


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        ({"deadline_s": 0.0}, "deadline_s is above 0 and at most 3600 s, not 0.0"),
        ({"deadline_s": float("nan")}, "deadline_s is above 0"),
        ({"deadline_s": 3_601.0}, "deadline_s is above 0"),
        ({"weight": 0}, "weight is a whole number from 1 to 100, not 0"),
        ({"weight": 101}, "weight is a whole number"),
        ({"max_bits_s": 999.0}, "max_bits_s is at least 1000"),
        ({"max_bits_s": float("inf")}, "max_bits_s is at least 1000 and at most 1e\\+12"),
    ],
)
def test_an_option_out_of_bounds_is_refused(pair: Simulated, options: dict[str, float], complaint: str) -> None:
    with pytest.raises(LocalError, match=complaint):
        pair.sessions["robot"].publisher("camera", **options)  # type: ignore[arg-type]
    pair.sessions["robot"].publisher("camera").close()  # the name is still free


def test_a_message_without_a_reader_is_counted_as_lost(pair: Simulated) -> None:
    publisher = pair.sessions["robot"].publisher("camera")
    publisher.put(b"x")
    assert publisher.lost == 1
    assert pair.cores["robot"].member.publications.unconfirmed()[LossReason.NO_READER] == 1


def test_a_late_reader_gets_the_last_message_of_a_latched_publisher(pair: Simulated) -> None:
    publisher = pair.sessions["robot"].publisher("camera", latched=1)
    publisher.put(b"old")
    publisher.put(b"new")
    assert pair.sessions["server"].subscribe("camera").receive(5).payload == b"new"


def test_a_message_above_the_limit_is_refused(pair: Simulated) -> None:
    publisher = pair.sessions["robot"].publisher("camera")
    with pytest.raises(LocalError, match="at most"):
        publisher.put(bytes(25 << 20))


@pytest.mark.parametrize("form", ["camera", "/camera", "hex", "name", "metadata"])
def test_a_name_is_found_by_each_of_its_forms(pair: Simulated, form: str) -> None:
    session = pair.sessions["robot"]
    (known,) = session.delegations
    forms: dict[str, str | Name | Metadata] = {
        "hex": known.name.to_text(),
        "name": known.name,
        "metadata": Metadata({"kind": "topic", "name": "/camera"}),
    }
    assert session.publisher(forms.get(form, form)).name == known.name


def test_a_name_without_a_delegation_is_refused_with_what_to_do(pair: Simulated) -> None:
    with pytest.raises(
        gdp.DelegationError, match=r"lidar: no delegation to read it .* /camera \(read\).*'gdp delegate name"
    ):
        pair.sessions["server"].subscribe("lidar")


def test_a_right_that_was_not_given_is_refused(pair: Simulated) -> None:
    with pytest.raises(gdp.DelegationError, match="no delegation to publish"):
        pair.sessions["server"].publisher("camera")


def test_a_name_that_several_delegations_have_is_refused_with_both_names(pair: Simulated) -> None:
    core = pair.cores["robot"]
    other = pair.world.topic("/camera", core.member, PUBLISH, type="other")
    core.renew([core.resolve("camera", Right.PUBLISH), other])
    with pytest.raises(gdp.DelegationError, match=f"2 delegations fit.*{other.name.to_text()}"):
        pair.sessions["robot"].publisher("camera")


def test_a_closed_publisher_refuses_messages(pair: Simulated) -> None:
    publisher = pair.sessions["robot"].publisher("camera")
    publisher.close()
    with pytest.raises(gdp.ClosedError, match="open a new one"):
        publisher.put(b"x")


def test_an_unknown_priority_is_refused(pair: Simulated) -> None:
    with pytest.raises(LocalError, match="priority is one of urgent, interactive"):
        pair.sessions["robot"].publisher("camera", priority="higher")  # type: ignore[arg-type]


def test_an_impossible_number_of_paths_is_refused(pair: Simulated) -> None:
    with pytest.raises(LocalError, match="1, 2 or 'spread'"):
        pair.sessions["robot"].publisher("camera", paths=3)  # type: ignore[arg-type]


def test_the_paths_of_a_name_are_advertised(pair: Simulated) -> None:
    pair.sessions["robot"].publisher("camera", paths=2)
    pair.sessions["server"].subscribe("camera", paths=2)
    for label in ("robot", "server"):
        advertised = pair.sessions[label].core.member.attachment.advertisements
        assert [each.paths for each in advertised] == [1, 2]


def test_a_session_that_closes_confirms_first_and_says_goodbye(pair: Simulated) -> None:
    publisher, subscription = crossing(pair)
    publisher.put(b"last")
    pair.sessions["robot"].close()
    assert subscription.receive(0).payload == b"last"
    assert pair.world.network.run(2.0, lambda: subscription.publishers == 0)
