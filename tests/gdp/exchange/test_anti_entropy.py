"""Anti-entropy, once for all protocols that use it: partitions, newcomers, liars, losses and large sets."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from hashlib import sha256
from itertools import count
from random import Random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gdp.crypto.cbor import decode, encode
from gdp.exchange import anti_entropy
from gdp.exchange.anti_entropy import AntiEntropy, SyncPace
from gdp.exchange.sync_message import SyncMessage
from gdp.exchange.sync_set import SyncSet
from tests.draws import IS_LONG

PACE = SyncPace(total_s=10.0, soon_s=0.2, fetch_s=1.0, reply_s=0.03, reply_bytes=40_000, draws=2)
DELAY_S = 0.01
SETS = (b"one", b"two")
ITEM_BYTES = 200
MANY = 100_000 if IS_LONG else 30_000


def key_of(number: int) -> bytes:
    return sha256(number.to_bytes(8, "big")).digest()


def item(key: bytes, rank: int) -> bytes:
    """Return an item that proves itself: a hash stands for a signature."""
    body = key + rank.to_bytes(8, "big") + bytes(ITEM_BYTES - 72)
    return body + sha256(body).digest()


class Node:
    """A node that keeps two sets, and takes what proves itself and is newer."""

    def __init__(self, pace: SyncPace = PACE) -> None:
        self.sets: dict[bytes, SyncSet[int]] = {of: SyncSet(lambda rank: rank) for of in SETS}
        self.engine: AntiEntropy[str] = AntiEntropy(self.sets, self._item_of, pace)
        self.refused = 0

    def _item_of(self, of: bytes, key: bytes, now_s: float) -> bytes | None:
        rank = self.sets[of].get(key)
        return None if rank is None else item(key, rank)

    def take(self, peer: str, message: SyncMessage, now_s: float) -> None:
        for each in self.engine.receive_message(peer, message, now_s):
            key, rank = each[:32], int.from_bytes(each[32:40], "big")
            known = self.sets[message.of].get(key)
            if each != item(key, rank):
                self.refused += 1
            elif known is None or known < rank:
                self.sets[message.of].put(key, rank)
                self.engine.took(peer, now_s)

    def fill(self, numbers: Iterable[int], rank: int = 1, of: bytes = SETS[0]) -> None:
        for number in numbers:
            self.sets[of].put(key_of(number), rank)

    def ranks(self) -> dict[bytes, dict[bytes, int | None]]:
        return {of: {key: each.get(key) for key in each} for of, each in self.sets.items()}


class Network:
    """Nodes on virtual time; every message takes ``DELAY_S``.

    Attributes:
        sent: bytes by sender and receiver.
        loses: returns whether a message is lost.
    """

    def __init__(self, **nodes: Node) -> None:
        self.now_s = 0.0
        self.nodes = nodes
        self.parted: set[frozenset[str]] = set()
        self.sent: dict[tuple[str, str], int] = {}
        self.loses: Callable[[], bool] = lambda: False
        self._under_way: list[tuple[float, str, str, SyncMessage]] = []
        for name in nodes:
            self.join(name)

    def join(self, name: str, node: Node | None = None) -> None:
        if node is not None:
            self.nodes[name] = node
        for other in self.nodes:
            if other != name:
                self.nodes[name].engine.add_peer(other, other.encode(), self.now_s)
                self.nodes[other].engine.add_peer(name, name.encode(), self.now_s)

    def send(self, sender: str, receiver: str, message: SyncMessage) -> None:
        """Send a message as it travels; it must read back as it was."""
        wire = encode(message.to_fields())
        read = SyncMessage.from_fields(decode(wire))  # type: ignore[arg-type]
        assert read == message
        self.sent[sender, receiver] = self.sent.get((sender, receiver), 0) + len(wire)
        if frozenset((sender, receiver)) not in self.parted and not self.loses():
            self._under_way.append((self.now_s + DELAY_S, sender, receiver, read))

    def run(self, seconds: float, until: Callable[[], bool] = lambda: False) -> bool:
        """Run until a condition holds; return whether it does."""
        end_s = self.now_s + seconds
        while True:
            for name, node in self.nodes.items():
                node.engine.handle_timer(self.now_s)
                for receiver, message in node.engine.poll_messages(self.now_s):
                    self.send(name, receiver, message)
            if until():
                return True
            timers = [timer for node in self.nodes.values() if (timer := node.engine.get_timer()) is not None]
            next_s = min(timers + [each[0] for each in self._under_way])
            if next_s > end_s:
                self.now_s = end_s
                return False
            self.now_s = max(self.now_s, next_s)
            arrived = [each for each in self._under_way if each[0] <= self.now_s]
            self._under_way = [each for each in self._under_way if each[0] > self.now_s]
            for _, sender, receiver, message in arrived:
                if receiver in self.nodes:
                    self.nodes[receiver].take(sender, message, self.now_s)

    def agree(self) -> bool:
        """Return whether all nodes have the same items; hashes alone would be what is tested."""
        ranks = [node.ranks() for node in self.nodes.values()]
        return all(each == ranks[0] for each in ranks)

    def bytes_between(self, a: str, b: str) -> int:
        return self.sent.get((a, b), 0) + self.sent.get((b, a), 0)


def test_a_partition_heals_and_the_newer_of_two_items_wins() -> None:
    network = Network(a=Node(), b=Node(), c=Node())
    for node in network.nodes.values():
        node.fill(range(500))
    network.parted = {frozenset("ac"), frozenset("bc")}
    network.nodes["a"].fill(range(0, 50), rank=3)
    network.nodes["a"].fill(range(500, 600))
    network.nodes["c"].fill(range(25, 75), rank=2)
    network.nodes["c"].fill(range(600, 650))
    network.run(30)
    assert not network.agree()
    network.parted = set()
    assert network.run(30, network.agree)
    ranks = network.nodes["b"].ranks()[SETS[0]]
    assert len(ranks) == 650
    assert [ranks[key_of(number)] for number in (10, 30, 60, 100)] == [3, 3, 2, 1]


def test_a_newcomer_gets_everything_from_one_peer_at_the_pace() -> None:
    network = Network(a=Node(), b=Node())
    for node in network.nodes.values():
        node.fill(range(3_000))
    network.run(1)
    network.sent.clear()
    begun_s = network.now_s
    network.join("new", Node())
    assert network.run(5, network.agree)
    most_bytes = PACE.reply_bytes + 120 * ITEM_BYTES  # the last prefix of a reply is whole
    assert network.now_s - begun_s > 3_000 * ITEM_BYTES / most_bytes * PACE.reply_s
    brought = sorted(network.sent.get((peer, "new"), 0) for peer in "ab")
    assert brought[0] < 1_000  # totals only
    assert brought[1] < 3_000 * ITEM_BYTES * 1.1


def test_bytes_are_proportional_to_the_difference_of_two_large_sets() -> None:
    network = Network(a=Node(), b=Node())
    one, two = (node.sets[SETS[0]] for node in network.nodes.values())
    for node in network.nodes.values():
        node.fill(range(MANY))
    for differing in (1, 20, 400):
        network.run(PACE.total_s)
        network.sent.clear()
        network.nodes["a"].fill(range(MANY, MANY + differing), rank=differing)
        network.nodes["b"].fill(range(differing), rank=differing + 1)
        assert network.run(2 * PACE.total_s, lambda: one.total == two.total)
        of_hashes = 2 * 2_100 * (1 + min(2 * differing, 256))  # both ways: the root, and buckets that differ
        assert network.bytes_between("a", "b") < of_hashes + 2 * differing * (ITEM_BYTES + 150) + 3_000
    assert network.agree()


def test_a_newcomer_gets_many_items() -> None:
    network = Network(a=Node(), new=Node())
    network.nodes["a"].fill(range(MANY))
    assert network.run(60, lambda: len(network.nodes["new"].sets[SETS[0]]) == MANY)
    assert network.bytes_between("a", "new") < MANY * (ITEM_BYTES + 30)


def test_a_node_that_has_all_and_one_that_has_few_cost_what_the_few_lack() -> None:
    network = Network(a=Node(), b=Node())
    network.nodes["a"].fill(range(20_000))
    network.nodes["b"].fill(range(20_000, 20_010))
    assert network.run(30, lambda: len(network.nodes["b"].sets[SETS[0]]) == 20_010)
    assert network.bytes_between("a", "b") < 20_010 * (ITEM_BYTES + 30) + 10_000


def test_keys_that_were_made_to_lie_together_are_sent_in_bounded_replies() -> None:
    network = Network(a=Node(), b=Node())
    keys = [bytes(2) + key_of(number)[2:] for number in range(2_000)]
    for number, key in enumerate(keys):
        network.nodes["a"].sets[SETS[0]].put(key, 1)
        if number % 100 == 0:
            network.nodes["b"].sets[SETS[0]].put(key, 1)
    largest = 0
    while not network.agree():
        network.sent.clear()
        network.run(PACE.reply_s)
        assert network.now_s < 5
        largest = max(largest, network.sent.get(("a", "b"), 0))
    assert largest < 2 * (PACE.reply_bytes + 5_000)


class Liar(Node):
    """A node that claims another total each time, and has no items for it."""

    def __init__(self) -> None:
        super().__init__()
        self.numbers = count(1)
        self.asked = 0
        self.answer: Callable[[SyncMessage], None] = lambda message: None

    def totals(self) -> SyncMessage:
        return SyncMessage(totals=tuple((of, next(self.numbers).to_bytes(8, "big")) for of in SETS))

    def take(self, peer: str, message: SyncMessage, now_s: float) -> None:
        if message.asked or message.lacking:
            self.asked += 1
            self.answer(message)


@pytest.mark.parametrize("answers", [False, True])
def test_claims_without_items_cost_few_requests_and_hold_up_no_other_peer(answers: bool) -> None:
    network = Network(a=Node(), liar=Liar())
    liar = network.nodes["liar"]
    assert isinstance(liar, Liar)
    if answers:
        liar.answer = lambda message: network.send("liar", "a", SyncMessage(of=message.of, is_last=True))
    network.nodes["a"].fill(range(100))
    for _ in range(200):
        network.send("liar", "a", liar.totals())
        network.run(0.05)
    assert 1 <= liar.asked <= 2 * 10 / PACE.fetch_s + 2
    honest = Node()
    honest.fill(range(100, 200))
    network.join("honest", honest)
    for _ in range(200):
        network.send("liar", "a", liar.totals())
        network.run(0.05)
    assert len(network.nodes["a"].sets[SETS[0]]) == 200


def test_hashes_that_were_not_asked_for_and_replies_without_end_draw_a_bounded_fetch() -> None:
    network = Network(a=Node(), liar=Liar())
    liar = network.nodes["liar"]
    assert isinstance(liar, Liar)
    network.nodes["a"].fill(range(5_000))
    network.send("liar", "a", SyncMessage(of=SETS[0], hashes=((b"\x07", Random(1).randbytes(2_048)),)))
    network.run(1)
    assert liar.asked == 0
    asked: list[SyncMessage] = []

    def answer(message: SyncMessage) -> None:
        asked.append(message)
        for prefix in (*message.asked, b"\xff"):
            for _ in range(2):
                network.send("liar", "a", SyncMessage(of=message.of, hashes=((prefix, Random(2).randbytes(2_048)),)))
        network.send("liar", "a", SyncMessage(of=message.of, is_last=True))

    liar.answer = answer
    network.send("liar", "a", liar.totals())
    network.run(60)
    prefixes = [prefix for each in asked for prefix in each.asked] + [
        prefix for each in asked for prefix, _ in each.lacking
    ]
    assert len(prefixes) > 256
    assert max(Counter(prefixes).values()) <= prefixes.count(b"")  # in each fetch once


def test_items_that_prove_nothing_are_refused_and_the_rest_is_fetched() -> None:
    network = Network(a=Node(), forger=Node())
    network.nodes["forger"].fill(range(100))
    forger = network.nodes["forger"]
    true_item = forger._item_of
    forger.engine._item_of = lambda of, key, now_s: bytes(ITEM_BYTES) if key[0] % 2 else true_item(of, key, now_s)
    network.run(60)
    taken = set(network.nodes["a"].sets[SETS[0]])
    assert taken == {key_of(number) for number in range(100) if key_of(number)[0] % 2 == 0}
    assert 1 <= network.nodes["a"].refused <= 100 * (60 / PACE.total_s + 2) * 2


def test_requests_without_end_draw_a_bounded_number_of_items(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(anti_entropy, "_SPARE", 100)
    network = Network(a=Node(), greedy=Liar())
    network.nodes["a"].fill(range(1_000))
    network.run(1)
    buckets = tuple((bytes([at]), b"") for at in range(256))
    for _ in range(500):
        network.send("greedy", "a", SyncMessage(of=SETS[0], lacking=buckets))
        network.run(0.1)
        network.send("greedy", "a", SyncMessage(of=SETS[0], asked=(b"",) * 16))
        network.run(0.1)
    assert network.sent["a", "greedy"] < (2 * 1_000 + 100) * 530
    honest = Node()
    network.join("honest", honest)
    assert network.run(5, lambda: len(honest.sets[SETS[0]]) == 1_000)


def test_a_reply_is_paced_whatever_is_asked_meanwhile() -> None:
    network = Network(a=Node(), greedy=Liar())
    network.nodes["a"].fill(range(5_000))
    network.run(1)
    network.sent.clear()
    buckets = tuple((bytes([at]), b"") for at in range(256))
    for _ in range(50):
        network.send("greedy", "a", SyncMessage(of=SETS[0], lacking=buckets))
        network.run(0.01)
    assert network.sent["a", "greedy"] < (0.5 / PACE.reply_s + 2) * (PACE.reply_bytes + 120 * ITEM_BYTES)


def test_a_peer_that_is_gone_gets_nothing_more() -> None:
    network = Network(a=Node(), b=Node())
    network.nodes["b"].fill(range(10))
    network.run(DELAY_S)
    network.nodes["a"].engine.remove_peer("b")
    assert network.nodes["a"].engine.poll_messages(network.now_s) == []


def test_an_item_that_is_pushed_arrives_at_once() -> None:
    network = Network(a=Node(), b=Node(), c=Node())
    network.run(1)
    network.nodes["a"].fill([7], of=SETS[1])
    network.nodes["a"].engine.push(SETS[1], key_of(7))
    assert network.run(2 * DELAY_S, network.agree)


def test_a_node_knows_when_a_peer_has_nothing_more_for_it() -> None:
    network = Network(a=Node(), b=Node())
    network.nodes["b"].fill(range(300))
    engine = network.nodes["a"].engine
    network.run(DELAY_S)
    assert engine.compared == {SETS[1]}
    assert network.run(5, lambda: SETS[0] in engine.compared)
    assert len(network.nodes["a"].sets[SETS[0]]) == 300


def drops(seed: int, share: float) -> Iterator[bool]:
    random = Random(seed)
    while True:
        yield random.random() < share


@given(
    drawn=st.lists(
        st.tuples(st.integers(0, 2), st.integers(0, 400), st.integers(1, 3), st.sampled_from(SETS)), max_size=60
    ),
    common=st.integers(0, 400),
    seed=st.integers(0, 1_000),
    share=st.sampled_from([0.0, 0.1, 0.4]),
)
def test_drawn_sets_become_equal_whatever_is_lost(
    drawn: list[tuple[int, int, int, bytes]], common: int, seed: int, share: float
) -> None:
    network = Network(a=Node(), b=Node(), c=Node())
    nodes = list(network.nodes.values())
    for node in nodes:
        node.fill(range(common))
    newest = {of: dict.fromkeys(map(key_of, range(common)), 1) if of == SETS[0] else {} for of in SETS}
    for at, number, rank, of in drawn:
        key = key_of(number)
        nodes[at].sets[of].put(key, max(rank, nodes[at].sets[of].get(key) or 0))
        newest[of][key] = max(rank, newest[of].get(key, 0))
    lost = drops(seed, share)
    network.loses = lambda: next(lost)
    assert network.run(600, network.agree)
    assert nodes[0].ranks() == newest
