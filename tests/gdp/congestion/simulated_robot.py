"""A robot's traffic on a thin link in virtual time: real publishers, scheduler and readers.

The link is the channel of the uplink bench. Both programs are single threads: sealing or opening a frame takes
``frame_s``. Now and then a program, or the switch next to it, is not scheduled for a while (``stall_s``).
"""

from __future__ import annotations

import heapq
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from itertools import count
from random import Random

from thin_link.channel import Channel, Loss, Rate

from gdp.client.identities import PublisherIdentity, WriterIdentity
from gdp.client.publisher import Publisher
from gdp.client.reader_path import ReaderPath, ReaderPaths
from gdp.client.send_options import Priority, PublisherSettings, SendOptions
from gdp.client.send_scheduler import SendScheduler
from gdp.client.timer_queue import TimerQueue
from gdp.client.writer_proxy import WriterProxy, WriterProxyState
from gdp.congestion.delivery_rate import Flight
from gdp.congestion.scavenger import ScavengingController
from gdp.crypto.keys import SigningKey
from gdp.frame.codec import Header, Kind, decode
from gdp.intervals import NEVER_S
from gdp.names import Name
from gdp.sansio import ReceivedFrame
from tests.gdp.client.incarnation_ids import reader_of, source_of
from tests.gdp.congestion.simulated_path import MTU, Flow

_SECRETS = {1: b"1" * 32}
_BATCH = 64  # frames that a reader takes at once
_READY_S = 1.0


@dataclass(frozen=True, slots=True)
class Stream:
    """A topic of the robot, as in the uplink bench.

    ``waiting``: so many messages always wait; 0: one is published each period. ``on_s``, ``off_s``: seconds for which
    there are any, and none, in turn, from ``begin_s`` on.
    """

    name: str
    size: int
    period_s: float
    is_reliable: bool = False
    is_urgent: bool = False
    priority: Priority = "normal"
    reader: bytes = b"cloud"
    waiting: int = 0
    on_s: float = float("inf")
    off_s: float = 0.0
    begin_s: float = 0.0


TF = Stream("tf", 500, 0.01, is_reliable=True, is_urgent=True)
REQUESTS = Stream("service request", 100, 0.2, is_reliable=True, is_urgent=True)
MAP = Stream("map", 50_000, 2.0, is_reliable=True)
LIDAR = Stream("lidar", 100_000, 0.1)
JPEG = Stream("camera", 40_000, 1 / 30)
RAW = Stream("camera", 921_600, 1 / 30)


def mix(camera: Stream) -> tuple[Stream, ...]:
    """Return all streams of the bench."""
    return TF, REQUESTS, MAP, LIDAR, camera


@dataclass
class Topic:
    """One stream: its publisher, its reader, when messages were due, and the ages of those that arrived."""

    stream: Stream
    publisher: Publisher
    proxy: WriterProxy
    loss: Loss
    due: int = 0
    arrived: list[tuple[float, float]] = field(default_factory=list)  # second of arrival, age
    sent_bytes: list[tuple[float, int]] = field(default_factory=list)


class SimulatedRobot:
    """Robot, link and cloud."""

    def __init__(
        self,
        streams: tuple[Stream, ...],
        *,
        rate: Rate,
        bits_s: float,
        rtt_s: float,
        fifo_bytes: int,
        frame_s: float = 0.0,
        stall_s: float = 0.0,
        stall_every_s: float = 0.1,
        seed: int = 1,
        loss: float = 0.0,
    ) -> None:
        self.now_s = 0.0
        self.rtt_s, self.bits_s = rtt_s, bits_s
        self.channel = Channel(rate, delay_ns=round(rtt_s / 2 * 1e9), fifo_bytes=fifo_bytes, loss=Loss(0.0, 1.0, seed))
        self._random, self._order = Random(seed), count()
        self._stall_s, self._stall_every_s, self._frame_s = stall_s, stall_every_s, frame_s
        self._stalled_until_s = {"robot": 0.0, "cloud": 0.0, "near switch": 0.0, "far switch": 0.0}
        self._events: list[tuple[float, int, Callable[[], None]]] = []
        self._loss, self._seed = loss, seed
        self._paths, self.background_paths = ReaderPaths(), ReaderPaths(ScavengingController)
        self._turns = SendScheduler(TimerQueue(), self.background_paths)
        self._notes = deque[tuple[float, Topic, bytes]]()
        self._arrivals = deque[tuple[float, Topic, bytes]]()
        self._robot_free_s = self._cloud_free_s = 0.0
        self._wakes_s = float("inf")
        self._cloud_wakes_s = float("inf")
        self.queue_s: list[tuple[float, float]] = []
        self.sent_bytes: list[tuple[float, int]] = []
        self._queued = deque[tuple[int, int]]()  # when each background frame has left the link, and its bytes
        self.ahead_s: list[tuple[float, float]] = []  # of each other frame: what background frames before it take
        self.readers = {label: reader_of(label) for label in {b"cloud", *(each.reader for each in streams)}}
        self.reader = self.readers[b"cloud"]
        self.topics = [self._topic(each) for each in streams]
        if stall_s:
            for program in self._stalled_until_s:
                self._stall(program)
        self._settle()

    @property
    def path(self) -> ReaderPath:
        """Return the robot's path to the cloud."""
        path = self._paths.get(self.reader.name)
        assert path is not None
        return path

    def run(self, until_s: float) -> None:
        """Publish and let time pass."""
        for topic in self.topics:
            if not topic.due and topic.stream.begin_s <= self.now_s:
                self._publish(topic, self.now_s)
            elif not topic.due:
                topic.due = 1
                self.at(topic.stream.begin_s, partial(self._publish, topic, topic.stream.begin_s))
        self._advance(until_s)

    def ages(self, name: str, begin_s: float) -> list[float]:
        """Return the sorted ages of what arrived of a stream from a moment on."""
        (topic,) = (each for each in self.topics if each.stream.name == name)
        return sorted(age_s for at_s, age_s in topic.arrived if at_s >= begin_s)

    def age_quantile(self, name: str, begin_s: float, share: float) -> float:
        """Return a quantile of the ages."""
        ages = self.ages(name, begin_s)
        return ages[min(int(share * len(ages)), len(ages) - 1)] if ages else float("inf")

    def utilisation(self, begin_s: float) -> float:
        """Return the delivered bytes since a moment, of those that the link could carry."""
        size = sum(size for at_s, size in self.sent_bytes if begin_s <= at_s < self.now_s)
        return size * 8 / self.bits_s / (self.now_s - begin_s)

    def queue_quantile(self, begin_s: float, share: float) -> float:
        """Return a quantile of the queueing delay that frames met."""
        ordered = sorted(queue for at, queue in self.queue_s if at >= begin_s)
        return ordered[int(share * (len(ordered) - 1))]

    def compete(self, flow: Flow) -> Flow:
        """Add a flow of another sender."""
        self.at(flow.start_s, lambda: self._flow_sends(flow))
        return flow

    def at(self, moment_s: float, work: Callable[[], None]) -> None:
        """Call at a moment."""
        heapq.heappush(self._events, (moment_s, next(self._order), work))

    def _topic(self, stream: Stream) -> Topic:
        name, key = Name(stream.name.encode().ljust(32, b".")), SigningKey.generate()
        source: WriterIdentity = source_of(Name(b"robot".ljust(32, b".")), 1, key)
        publisher = Publisher(
            topic=name, source=source, secrets=_SECRETS, description=b"",
            reader_paths=self.background_paths if stream.priority == "background" else self._paths,
            settings=PublisherSettings(
                reliable=stream.is_reliable, urgent=stream.is_urgent, options=SendOptions(priority=stream.priority)
            ),
        )  # fmt: skip
        publisher.tree_stands(MTU)
        publisher.published = self._turns.add
        proxy = WriterProxy(
            topic=name, reader=self.readers[stream.reader], secrets=_SECRETS, now_s=0.0,
            publisher=PublisherIdentity(source.name, 1, key.public, source.control_keys.public),
        )  # fmt: skip
        return Topic(stream, publisher, proxy, Loss(self._loss, 1.0, self._seed))

    def _settle(self) -> None:
        """Introduce the reader to all publishers, before anything is measured."""
        self._wake_cloud(0.0)
        self._advance(_READY_S)
        assert all(each.proxy.state is WriterProxyState.LIVE for each in self.topics)

    def _advance(self, until_s: float) -> None:
        while self._events and self._events[0][0] <= until_s:
            self.now_s, _, work = heapq.heappop(self._events)
            work()
        self.now_s = until_s

    def _stall(self, program: str) -> None:
        self._stalled_until_s[program] = self.now_s + self._random.uniform(0, 2 * self._stall_s)
        again_s = self._stalled_until_s[program] + self._random.expovariate(1 / self._stall_every_s)
        self.at(again_s, lambda: self._stall(program))

    def _publish(self, topic: Topic, due_s: float) -> None:
        stream, publisher = topic.stream, topic.publisher
        into_s = (due_s - max(stream.begin_s, _READY_S)) % (stream.on_s + stream.off_s)
        rest_s = stream.period_s if into_s < stream.on_s else stream.on_s + stream.off_s - into_s
        next_s = due_s + max(rest_s, 1e-3)
        topic.due += 1
        while into_s < stream.on_s:
            publisher.publish(round(due_s * 1e9).to_bytes(8, "big") + bytes(stream.size - 8), self.now_s)
            if publisher.messages - publisher.acknowledgements.acknowledged >= stream.waiting:
                break
        self.at(next_s, lambda: self._publish(topic, next_s))
        self._wake_robot(self.now_s)

    def _wake_robot(self, moment_s: float) -> None:
        moment_s = max(moment_s, self._robot_free_s, self._stalled_until_s["robot"])
        if self._wakes_s <= self.now_s or moment_s < self._wakes_s:
            self._wakes_s = moment_s
            self.at(moment_s, lambda: self._robot(moment_s))

    def _robot(self, moment_s: float) -> None:
        """Run one step of the robot's program, as the runtime does."""
        if moment_s != self._wakes_s:
            return
        if self.now_s < self._stalled_until_s["robot"]:
            self._wakes_s = float("inf")
            self._wake_robot(self._stalled_until_s["robot"])
            return
        now_s, turns = self.now_s, self._turns
        while self._notes:
            came_s, topic, note = self._notes.popleft()
            self._hear(topic, decode(note), note, now_s - came_s)
        for topic in self.topics:
            if topic.publisher.get_timer() <= now_s:
                topic.publisher.handle_timer(now_s)
                turns.add(topic.publisher)
        if self._paths.handle_timer(now_s) | self.background_paths.handle_timer(now_s):
            turns.resume()
        is_waiting = turns.is_ready or turns.due_s < NEVER_S
        frames = [frame for part in turns.poll_turn(now_s) for frame in part] if is_waiting else []
        self._wakes_s = float("inf")
        self._robot_free_s = now_s + len(frames) * self._frame_s
        if frames:
            self.at(self._robot_free_s, lambda: self._transmit(frames))
            self._wake_robot(self._robot_free_s)
            return
        paths_s = min(self._paths.due_s, self.background_paths.due_s)
        next_s = min([turns.due_s, paths_s, *(each.publisher.get_timer() for each in self.topics)])
        if next_s < NEVER_S:
            self._wake_robot(max(next_s, now_s + 1e-5))

    def _hear(self, topic: Topic, header: Header, note: bytes, waited_s: float) -> None:
        if header.kind == Kind.INTRODUCTION:
            topic.publisher.receive_introduction(header, note)
        else:
            topic.publisher.receive_acknack(header, note, self.now_s, waited_s)
        self._turns.add(topic.publisher)
        self._turns.resume()

    def _transmit(self, frames: list[bytes]) -> None:
        self._turns.count_sent()
        self._paths.frames_sent(self.now_s)
        self.background_paths.frames_sent(self.now_s)
        self.at(self._switched_s("near switch"), lambda: self._forward(frames))

    def _forward(self, frames: list[bytes]) -> None:
        for frame in frames:
            topic, due_ns = self._topic_of(frame), self._offer(len(frame))
            self._note_ahead(topic, len(frame), due_ns)
            if due_ns is not None and not topic.loss.is_lost():
                self.at(due_ns / 1e9, lambda frame=frame: self._come(frame))  # type: ignore[misc]

    def _note_ahead(self, topic: Topic, size: int, due_ns: int | None) -> None:
        """Note how much of the queue that a frame finds is background's."""
        leaves_ns = round((self.now_s + self.rtt_s / 2) * 1e9)
        while self._queued and self._queued[0][0] <= leaves_ns:
            self._queued.popleft()
        if topic.stream.priority != "background":
            self.ahead_s.append((self.now_s, sum(size for _, size in self._queued) * 8 / self.bits_s))
        elif due_ns is not None:
            self._queued.append((due_ns, size))

    def _come(self, frame: bytes) -> None:
        topic = self._topic_of(frame)
        self.sent_bytes.append((self.now_s, len(frame)))
        topic.sent_bytes.append((self.now_s, len(frame)))
        self.at(self._switched_s("far switch"), lambda: self._arrive(topic, frame))

    def _switched_s(self, switch: str) -> float:
        """Return when a switch forwards what it received now."""
        return max(self.now_s, self._stalled_until_s[switch])

    def _topic_of(self, frame: bytes) -> Topic:
        destination = decode(frame).destination
        return next(each for each in self.topics if each.publisher.topic == destination)

    def _offer(self, size: int) -> int | None:
        self.queue_s.append((self.now_s, self.channel.backlog_bytes(round(self.now_s * 1e9)) * 8 / self.bits_s))
        return self.channel.offer(round(self.now_s * 1e9), size)

    def _arrive(self, topic: Topic, frame: bytes) -> None:
        self._arrivals.append((self.now_s, topic, frame))
        self._wake_cloud(self.now_s)

    def _wake_cloud(self, moment_s: float) -> None:
        moment_s = max(moment_s, self._cloud_free_s, self._stalled_until_s["cloud"])
        if self._cloud_wakes_s <= self.now_s or moment_s < self._cloud_wakes_s:
            self._cloud_wakes_s = moment_s
            self.at(moment_s, lambda: self._cloud(moment_s))

    def _cloud(self, moment_s: float) -> None:
        """Run one step of the cloud's program: a batch of frames, then reports."""
        if moment_s != self._cloud_wakes_s:
            return
        self._cloud_wakes_s = float("inf")
        now_s = self.now_s
        if now_s < self._stalled_until_s["cloud"]:
            self._wake_cloud(self._stalled_until_s["cloud"])
            return
        taken = min(len(self._arrivals), _BATCH)
        for _ in range(taken):
            came_s, topic, frame = self._arrivals.popleft()
            arrival = ReceivedFrame(0, b"robot.", frame, now_s - came_s)
            if not topic.proxy.receive_run([arrival], 0, now_s):
                topic.proxy.receive(decode(frame), frame, now_s, now_s - came_s)
        self._cloud_free_s = now_s + taken * self._frame_s
        done_s = self._cloud_free_s
        for topic in self.topics:
            proxy = topic.proxy
            proxy.handle_timer(now_s)
            for each in proxy.delivery.poll():
                topic.arrived.append((done_s, done_s - int.from_bytes(each.message[:8], "big") / 1e9))
            for note in proxy.control_to_send(done_s):
                self.at(done_s, lambda topic=topic, note=note: self._report(topic, note))  # type: ignore[misc]
        next_s = done_s if self._arrivals else min(each.proxy.get_timer() for each in self.topics)
        self._wake_cloud(max(next_s, now_s + 1e-5))

    def _report(self, topic: Topic, note: bytes) -> None:
        """Send a report back through both switches."""
        leaves_s = self._switched_s("far switch") + self.rtt_s / 2
        self.at(leaves_s, lambda: self.at(self._switched_s("near switch"), lambda: self._note(topic, note)))

    def _note(self, topic: Topic, note: bytes) -> None:
        self._notes.append((self.now_s, topic, note))
        self._wake_robot(self.now_s)

    def _flow_sends(self, flow: Flow) -> None:
        while self.now_s < flow.end_s and (next_s := flow.sender.next_send_s(MTU)) is not None:
            if next_s > self.now_s:
                self.at(next_s, lambda: self._flow_sends(flow))
                return
            flight = flow.sender.sent(MTU, self.now_s)
            flow.outstanding.append(flight)
            due_ns = self._offer(MTU)
            if due_ns is not None:
                self.at(due_ns / 1e9, lambda flight=flight: self._flow_arrives(flow, flight))  # type: ignore[misc]

    def _flow_arrives(self, flow: Flow, flight: Flight) -> None:
        flow.delivered.append(self.now_s)
        self.at(self.now_s + self.rtt_s / 2, lambda: self._flow_hears(flow, flight))

    def _flow_hears(self, flow: Flow, flight: Flight) -> None:
        lost = flow.overtaken_by([flight])
        flow.sender.acknowledged([flight], self.now_s)
        if lost:
            flow.sender.lost(lost, self.now_s)
        self._flow_sends(flow)
