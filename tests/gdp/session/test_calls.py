"""Calls of the session API: servers, replicas and refusals."""

from __future__ import annotations

from collections import Counter

import pytest

import gdp
from gdp.errors import LocalError
from gdp.frame.codec import ETHER_BYTES, Kind, decode
from gdp.names import Name
from gdp.service.replication import ALL, Mode
from gdp.session.protocol.client_core import Call
from gdp.session.protocol.core import replication_of
from gdp.session.protocol.server_core import ServerCore
from gdp.trust.right import Right
from tests.gdp.session.simulated import Simulated, world_of


@pytest.fixture
def replicas() -> Simulated:
    rights = {"edge": {"plan": [Right.SERVE]}, "cloud": {"plan": [Right.SERVE]}, "robot": {"plan": [Right.CALL]}}
    return world_of(rights)


def serve(net: Simulated, label: str, at_once: int | None = None) -> ServerCore:
    core = net.cores[label]
    return core.serve(core.resolve("plan", Right.SERVE), at_once=at_once, is_global=True, urgent=False)


def begin(net: Simulated, timeout_s: float | None = 5.0, replication: str | int = "all", payload: bytes = b"x") -> Call:
    core = net.cores["robot"]
    call = Call(payload=payload, timeout_s=timeout_s, replication=replication_of(replication))
    core.call(core.resolve("plan", Right.CALL), call, net.now_s)
    net.send("robot")
    return call


def respond(net: Simulated, server: ServerCore, label: str, outcome: bytes | str) -> None:
    """Let the server finish its present request."""
    assert net.run(5.0, lambda: bool(server.turns)), "no request came"
    server.finish(server.turns.popleft().number, outcome, net.now_s)
    net.send(label)


def test_a_call_that_begins_before_its_server_is_there_waits_for_it(replicas: Simulated) -> None:
    call = begin(replicas)
    replicas.run(1.0)
    server = serve(replicas, "edge")
    respond(replicas, server, "edge", b"y")
    assert replicas.run(2.0, lambda: call.is_done)
    assert call.response == gdp.Response(b"y", replicas.sessions["edge"].name)


@pytest.mark.parametrize("outage_s", [1.0, 10.0])
def test_a_running_call_outlives_a_silence_of_its_only_server(replicas: Simulated, outage_s: float) -> None:
    server = serve(replicas, "edge")
    warm = begin(replicas)
    respond(replicas, server, "edge", b"warm")
    assert replicas.run(2.0, lambda: warm.is_done)
    call = begin(replicas, timeout_s=60.0)
    assert replicas.run(5.0, lambda: bool(server.turns))
    lead = replicas.world.leads["s/edge"]
    lead.loss = 1.0
    kinds = Counter[int]()
    replicas.world.network.taps.append(lambda _, __, ___, frame: kinds.update((decode(frame[ETHER_BYTES:]).kind,)))
    replicas.run(outage_s)
    assert not call.is_done
    assert kinds[Kind.RIB_REQUEST] <= 20 * outage_s
    lead.loss = 0.0
    respond(replicas, server, "edge", b"y")
    assert replicas.run(10.0, lambda: call.is_done)
    assert call.response == gdp.Response(b"y", replicas.sessions["edge"].name)


def test_a_call_goes_to_a_server_that_returns_in_the_moment_in_which_the_last_one_goes(
    replicas: Simulated, monkeypatch: pytest.MonkeyPatch
) -> None:
    edge, cloud = serve(replicas, "edge"), serve(replicas, "cloud")
    replicas.run(3.0)
    call = begin(replicas, timeout_s=60.0)
    assert replicas.run(5.0, lambda: bool(edge.turns) and bool(cloud.turns))
    connected = list[Name]()
    monkeypatch.setattr(replicas.cores["robot"].member.services, "peers", lambda _: connected)
    for label in ("edge", "cloud"):
        connected[:] = [replicas.sessions[label].name]
        replicas.run(2.0)
    assert not call.is_done
    respond(replicas, cloud, "cloud", b"y")
    assert replicas.run(2.0, lambda: call.response == gdp.Response(b"y", replicas.sessions["cloud"].name))


def test_the_first_response_of_two_replicas_counts(replicas: Simulated) -> None:
    edge, cloud = serve(replicas, "edge"), serve(replicas, "cloud")
    warm = begin(replicas)
    respond(replicas, edge, "edge", b"warm")
    replicas.run(2.0, lambda: warm.is_done)
    respond(replicas, cloud, "cloud", b"warm")
    call = begin(replicas)
    respond(replicas, cloud, "cloud", b"from cloud")
    replicas.run(2.0, lambda: call.is_done)
    assert call.response == gdp.Response(b"from cloud", replicas.sessions["cloud"].name)


def test_a_replica_that_refuses_leaves_the_call_to_the_other(replicas: Simulated) -> None:
    edge, cloud = serve(replicas, "edge"), serve(replicas, "cloud")
    replicas.run(2.0)
    call = begin(replicas)
    respond(replicas, edge, "edge", "no map")
    respond(replicas, cloud, "cloud", b"route")
    replicas.run(2.0, lambda: call.is_done)
    assert call.response is not None
    assert call.response.payload == b"route"


def test_a_call_that_every_server_refuses_fails_with_the_reason(replicas: Simulated) -> None:
    call = begin(replicas)
    respond(replicas, serve(replicas, "edge"), "edge", "ValueError: no map")
    replicas.run(2.0, lambda: call.is_done)
    with pytest.raises(gdp.CallError, match="every server refused: ValueError: no map"):
        raise call.error or AssertionError


def test_a_call_without_a_server_fails_and_says_what_to_start(replicas: Simulated) -> None:
    call = begin(replicas, timeout_s=0.5)
    assert replicas.run(2.0, lambda: call.is_done)
    with pytest.raises(gdp.NoServerError, match=r"no server within 0.5 s; start one"):
        raise call.error or AssertionError


def test_a_call_without_a_response_times_out(replicas: Simulated) -> None:
    server = serve(replicas, "edge")
    call = begin(replicas, timeout_s=1.0)
    assert replicas.run(5.0, lambda: bool(server.turns))
    assert replicas.run(3.0, lambda: call.is_done)
    with pytest.raises(gdp.CallTimeoutError, match=r"no response within 1 s from 1 server"):
        raise call.error or AssertionError


def test_a_call_to_one_server_goes_to_the_next_when_that_one_is_closed(replicas: Simulated) -> None:
    servers = {label: serve(replicas, label) for label in ("edge", "cloud")}
    replicas.run(2.0)
    warm = begin(replicas, replication="all")
    for label, server in servers.items():
        respond(replicas, server, label, b"warm")
    replicas.run(2.0, lambda: warm.is_done)
    call = begin(replicas, replication=1)
    assert replicas.run(2.0, lambda: any(server.turns for server in servers.values()))
    asked = next(label for label, server in servers.items() if server.turns)
    other = next(label for label in servers if label != asked)
    replicas.cores[asked].close_server(servers[asked], replicas.now_s)
    replicas.send(asked)
    respond(replicas, servers[other], other, b"from the other")
    replicas.run(2.0, lambda: call.is_done)
    assert call.response is not None
    assert call.response.payload == b"from the other"


def test_a_server_that_leaves_refuses_new_requests(replicas: Simulated) -> None:
    server = serve(replicas, "edge")
    replicas.run(1.0)
    server.leave()
    replicas.send("edge")
    call = begin(replicas)
    assert replicas.run(3.0, lambda: call.is_done)
    assert "the server is leaving" in str(call.error)


def test_a_server_closes_when_its_client_has_confirmed_the_response(replicas: Simulated) -> None:
    server = serve(replicas, "edge")
    replicas.run(1.0)
    call = begin(replicas)
    assert replicas.run(2.0, lambda: bool(server.turns))
    lead = replicas.world.leads["s/edge"]
    lead.loss = 1.0  # the response and its repetitions
    respond(replicas, server, "edge", b"done")
    assert not replicas.run(0.4, lambda: server.is_idle)
    lead.loss = 0.0
    assert replicas.run(2.0, lambda: server.is_idle)
    replicas.cores["edge"].close_server(server, replicas.now_s)
    replicas.send("edge")
    assert replicas.run(1.0, lambda: call.is_done)
    assert call.response is not None
    assert call.response.payload == b"done"


def test_at_most_as_many_requests_as_there_are_workers_are_given_out(replicas: Simulated) -> None:
    server = serve(replicas, "edge", at_once=1)
    calls = [begin(replicas, payload=payload) for payload in (b"a", b"b")]
    assert replicas.run(5.0, lambda: bool(server.turns))
    replicas.run(1.0)
    assert len(server.turns) == 1
    respond(replicas, server, "edge", b"1")
    respond(replicas, server, "edge", b"2")
    assert replicas.run(2.0, lambda: all(call.is_done for call in calls))


def test_closing_the_session_ends_calls_under_way(replicas: Simulated) -> None:
    call = begin(replicas)
    replicas.cores["robot"].close(replicas.now_s)
    assert isinstance(call.error, gdp.CallError)


def test_replication_is_given_as_a_word_or_a_number() -> None:
    assert replication_of("all") == ALL
    assert replication_of("hedged").mode is Mode.HEDGED
    assert replication_of("nearest").mode is Mode.NEAREST
    assert (replication_of(2).mode, replication_of(2).copies) == (Mode.SOME, 2)


@pytest.mark.parametrize("wrong", ["some", 0, True, ""])
def test_an_unknown_replication_is_refused(wrong: object) -> None:
    with pytest.raises(LocalError, match="'all', 'hedged', 'nearest' or a number"):
        replication_of(wrong)  # type: ignore[arg-type]


def test_a_call_to_the_only_server_has_no_signature_where_both_ends_say_session(replicas: Simulated) -> None:
    edge, robot = replicas.cores["edge"], replicas.cores["robot"]
    topic = edge.resolve("plan", Right.SERVE)
    server = edge.serve(topic, at_once=1, is_global=True, urgent=False, is_session=True)
    calls = [Call(payload=b"x", timeout_s=5.0, replication=ALL) for _ in range(2)]
    for call in calls:
        robot.call(robot.resolve("plan", Right.CALL), call, replicas.now_s, is_session=True)
        replicas.send("robot")
        respond(replicas, server, "edge", b"y")
    assert replicas.run(2.0, lambda: all(each.is_done for each in calls))
    requests = [each for each in edge.member.subscriptions.writer_proxies() if each.topic != topic.name]
    assert [each.delivery.delivered for each in requests] == [2]


def test_an_impossible_kind_of_signature_is_refused(replicas: Simulated) -> None:
    with pytest.raises(LocalError, match="'never'"):
        replicas.sessions["edge"].serve("plan", lambda request: request.payload, sign="never")  # type: ignore[arg-type]
