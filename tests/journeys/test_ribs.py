"""Several RIBs of a domain: any of them may die, and no live name is lost."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

from gdp.control.rib_statements import Query
from gdp.intervals import ADVERTISEMENT
from lab.simulation import Simulation
from lab.topology import Attachment, ring5
from tests.journeys.flows import ROBOT, SERVER, advertise, flowing, ring

LEASES_S = 3 * ADVERTISEMENT.lease_s
RIBS = ["school", "school#2", "backbone", "backbone#2", "cloud", "cloud#2"]


def doubled() -> Simulation:
    """Return the ring with two RIBs in each domain."""
    plan = ring5()
    second = (Attachment("nuc1", "rib", "rib2"), Attachment("nuc3", "rib", "rib2"), Attachment("nuc5", "rib", "rib2"))
    world = Simulation(topology=replace(plan, attachments=plan.attachments + second))
    assert world.run_until_attached()
    return world


def agree(world: Simulation, domain: str) -> bool:
    one, two = (world.ribs[label].rib for label in (domain, f"{domain}#2"))
    hashes = {digests.total for rib in (one, two) if (digests := rib.state.store.digests) is not None}
    return len(hashes) == 1 and one.names > 0


def test_what_one_rib_took_all_of_its_domain_hold() -> None:
    world = flowing(doubled()).world
    for domain in ("school", "backbone", "cloud"):
        assert world.network.run(5, partial(agree, world, domain))
    world.network.run(LEASES_S)
    for domain in ("school", "backbone", "cloud"):
        assert world.network.run(5, partial(agree, world, domain))


def test_each_rib_dies_and_returns_in_turn_and_no_name_is_lost_or_unfindable() -> None:
    flow = flowing(doubled())
    world, network = flow.world, flow.world.network
    number = int(LEASES_S)
    flow.stream(number, 1.0, size=100)
    for dead in RIBS:
        world.kill_rib(dead)
        network.run(0.1)  # before any node can have noticed
        late = advertise(world, f"/late/{dead}")
        late.read_by(SERVER)
        assert network.run(3, partial(late.is_read_by, 1))
        network.run(LEASES_S / len(RIBS))
        world.restart_rib(dead)
        domain = dead.split("#")[0]
        assert network.run(5, partial(agree, world, domain))
        assert late.publisher.readers == 1
    assert network.run(10, lambda: flow.has(SERVER, number))
    assert flow.numbers(SERVER) == list(range(number))


def test_two_ribs_that_were_parted_agree_again() -> None:
    flow = flowing(doubled())
    world, network = flow.world, flow.world.network
    lead = world.leads[world.rib_node("school#2")]
    network.set_link(lead, up=False)
    gone = advertise(world, "/gone")
    kept = advertise(world, "/kept")
    network.run(LEASES_S)
    gone.member.withdraw(gone.topic.name)
    network.send_pending(ROBOT)
    network.run(1)
    assert not agree(world, "school")
    network.set_link(lead, up=True)
    assert network.run(5, partial(agree, world, "school"))
    routes = world.ribs["school#2"].rib.state.store.routes
    assert (len(routes(kept.topic.name)), len(routes(gone.topic.name))) == (1, 0)


def test_a_watch_at_one_rib_hears_what_another_took() -> None:
    world = doubled()
    asked = world.ribs["school#2"].rib
    watcher = next(iter(world.switches.values()))
    flow = advertise(world, "/watched")
    query = Query(flow.topic.name, 20.0)
    identity = world.identities["nuc1"]
    asked.receive(query.to_wire(identity.name, identity.key, identity.membership), watcher.name, world.network.now)
    asked.statements_to_send()
    answers = asked.state.outbox.answers
    assert world.network.run(1, lambda: asked.state.outbox.answers > answers)
    world.network.run(LEASES_S)
    assert asked.state.store.routes(flow.topic.name)


def test_a_rib_that_restarts_again_and_again_lets_no_lease_end() -> None:
    lease_s, every_s = 6.0, 0.25
    world = ring(lease_s=lease_s, keepalive_ms=1_500)
    flow = flowing(world)
    count = round(3.25 * lease_s / every_s)
    flow.stream(count, every_s, size=100)
    for at in range(1, 12):  # it acknowledges again what its switch still has
        world.network.call(0.28 * at * lease_s, lambda: (world.restart_rib("school"), None)[1])
    attached, robot = world.switches["nuc1"].attached, world.identities[ROBOT].name
    assert not world.network.run(3.25 * lease_s, lambda: not attached.of(robot))
    assert flow.numbers(SERVER) == list(range(count))
