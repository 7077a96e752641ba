"""Session of one rosbridge client: JSON messages of the rosbridge v2 protocol.

Sans-I/O. Types may be written as in ROS 1 (``std_msgs/String``) or ROS 2 (``std_msgs/msg/String``). Of rosapi it
answers what lists names and types.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from itertools import count
from typing import Final

import orjson

from gdp.due_queue import earliest
from gdp.errors import GdpError, LocalError
from gdp.ros_names import resolved
from gdp_extensions.doors.core.client_fields import Fields, identifier, ros2_type, text_of, whole_number, word, wrong
from gdp_extensions.doors.core.client_queue import ClientQueue, Pending
from gdp_extensions.doors.core.hub import REASON_MAX, Hub, Publication, TopicType
from gdp_extensions.doors.core.rosbridge_goals import SENDS, GoalStep, RosbridgeGoals
from gdp_extensions.doors.core.throttle import Throttle
from proxy.serial.channel import Channel, Service
from proxy.serial.rosbridge_json import RosbridgeCodec, both_spellings, cbor_raw, codec_of, png_text

IDS_MAX: Final = 4_096  # of all subscriptions and advertised topics
CALLS_MAX: Final = 1_024
_QUEUE_MAX: Final = 1_024
_PERIOD_MAX_MS: Final = 3_600_000
_LEVELS: Final = ("none", "error", "warning", "info")
_COMPRESSIONS: Final = ("none", "png", "cbor", "cbor-raw")
_ROSAPI: Final = "/rosapi/"


@dataclass(slots=True)
class _Subscription:
    """What a client wants of one topic as it writes its name, by one or several ``subscribe`` with different ids."""

    key: int
    topic: str  # its full name
    type_name: str  # empty: whatever is offered
    wishes: dict[str, tuple[float, int, str]] = field(default_factory=dict)  # by id: period, queue length, compression
    throttle: Throttle = field(default_factory=lambda: Throttle(0.0, 0))

    def merge(self) -> None:
        """Follow the least restrictive period and, as rosbridge does, the shortest queue."""
        self.throttle = Throttle(self.period_s, self.queue_length)

    @property
    def period_s(self) -> float:
        return min(each[0] for each in self.wishes.values())

    @property
    def queue_length(self) -> int:
        return min(each[1] for each in self.wishes.values())

    @property
    def compression(self) -> str:
        """Return that of all ids; of different ones: none."""
        wanted = {each[2] for each in self.wishes.values()}
        return wanted.pop() if len(wanted) == 1 else "none"


@dataclass(frozen=True, slots=True)
class _Call:
    service: Service
    name: str  # as the client writes it
    number: object  # the client's id: a text or a number


class RosbridgeSession:
    """State of one connection; ``goal_id``: returns 16 random bytes."""

    def __init__(
        self, hub: Hub, number: int, queue: ClientQueue, now_s: Callable[[], float], goal_id: Callable[[], bytes]
    ) -> None:
        self._hub = hub
        self.number = number
        self.queue = queue
        self._now_s = now_s
        self._level = _LEVELS.index("error")
        self._offered: dict[str, Publication] = {}  # by topic
        self._subscriptions: dict[str, _Subscription] = {}  # by the name that the client writes
        self._names: dict[int, str] = {}  # that, of keys
        self._readers: defaultdict[str, list[_Subscription]] = defaultdict(list)  # by topic
        self._published: dict[str, tuple[str, set[str]]] = {}  # topic to type and ids
        self._keys = count(1)
        self._ids = 0  # of subscriptions and advertised topics
        self._calls = 0
        self._goals = RosbridgeGoals(hub, self, queue, self._keys.__next__, goal_id)
        self._operations: Mapping[str, Callable[[Fields], None]] = {
            "subscribe": self._subscribe,
            "unsubscribe": self._unsubscribe,
            "advertise": self._advertise,
            "unadvertise": self._unadvertise,
            "publish": self._publish,
            "call_service": self._call,
            "send_action_goal": lambda fields: self._goals.call(fields, self._received_ns),
            "cancel_action_goal": self._goals.cancel,
            "set_level": self._set_level,
            "status": self._set_level,
        }

    def handle_message(self, data: str | bytes, now_ns: int) -> None:
        """Process a message of the client. Raises ``GdpError``: it is wrong, and was ignored."""
        self._received_ns = now_ns
        try:
            fields = orjson.loads(data)
        except orjson.JSONDecodeError as error:
            raise wrong("a message that is not JSON") from error
        if not isinstance(fields, dict):
            raise wrong("a message is a JSON object")
        name, number = word(fields, "op"), identifier(fields, None)
        operation = self._operations.get(name)
        if operation is None:
            known = ", ".join(self._operations)
            raise wrong(f"operation {name!r} is not supported; supported are {known}"[:300])
        try:
            operation(fields)
        except GdpError as error:
            self._tell("error", str(error), number)

    def tell_wrong(self, reason: str) -> None:
        """Report an error."""
        self._tell("error", reason, None)

    def tell_dropped(self, total: int) -> None:
        """Report dropped messages as a warning."""
        text = f"this client reads too slowly: {total} messages were dropped for it; other clients lose nothing"
        self._tell("warning", text, None)

    def encode(self, pending: Pending) -> str | bytes:
        """Return ``publish`` with a message of a subscription; clients share the JSON of the latest message."""
        if (feedback := self._goals.encode(pending)) is not None:
            return feedback
        topic = self._names.get(pending.key, "")
        subscription = self._subscriptions.get(topic)
        compression = "none" if subscription is None else subscription.compression
        if compression == "cbor-raw":
            return cbor_raw(topic, pending.stamp_ns, pending.raw)
        publication = None if subscription is None else self._offered.get(subscription.topic)
        if publication is None:
            return text_of(op="status", level="warning", msg=f"{topic}: withdrawn; a message was left out")
        try:
            if compression == "cbor":
                return codec_of(publication.channel).to_cbor(topic, pending.raw)
            body = publication.encoded(pending.raw, lambda raw: codec_of(publication.channel).to_json(raw))
        except GdpError as error:
            return text_of(op="status", level="error", msg=f"{topic}: {error}")
        wire = b'{"op":"publish","topic":%b,"msg":%b}' % (orjson.dumps(topic), body)
        return text_of(op="png", data=png_text(wire)) if compression == "png" else wire.decode()

    def get_timer(self) -> float | None:
        """Return when a throttled message is due."""
        return earliest(*(each.throttle.get_timer() for each in self._subscriptions.values()))

    def handle_timer(self, now_s: float) -> None:
        """Queue the throttled messages whose turn has come."""
        for each in self._subscriptions.values():
            if (message := each.throttle.poll(now_s)) is not None:
                self.queue.put(each.key, *message, depth=each.queue_length)

    def reads(self) -> Iterable[TopicType]:
        """Return the topics of the subscriptions whose type is known."""
        for each in self._subscriptions.values():
            offered = self._offered.get(each.topic)
            type_name = each.type_name or (offered.channel.type_name if offered is not None else "")
            if type_name:
                yield each.topic, type_name

    def publishes(self) -> Iterable[TopicType]:
        """Return the topics that the client advertised."""
        return [(topic, type_name) for topic, (type_name, _) in self._published.items()]

    def schema_of(self, topic: str, type_name: str) -> Channel | None:
        """Return None: clients of rosbridge describe no types. What the door reads itself is a description, too."""
        offered = self._offered.get(topic)
        return offered.channel if offered is not None and offered.channel.type_name == type_name else None

    def add_publication(self, publication: Publication) -> None:
        """Note a topic; a subscription to it begins now."""
        topic = publication.channel.topic
        self._offered[topic] = publication
        if topic in self._readers:
            self._hub.update_graph()

    def remove_publication(self, publication: Publication) -> None:
        """Forget a topic; subscriptions to it wait for its return."""
        if self._offered.get(publication.channel.topic) is publication:
            del self._offered[publication.channel.topic]

    def queue_message(self, publication: Publication, stamp_ns: int, raw: bytes) -> None:
        """Queue a message for the client's subscription."""
        self._goals.queue_feedback(publication, stamp_ns, raw)
        for each in self._readers.get(publication.channel.topic, ()):
            if each.throttle.offer(stamp_ns, raw, self._now_s()):
                self.queue.put(each.key, stamp_ns, raw, depth=each.queue_length)

    def add_service(self, handle: int, service: Service) -> None:
        """Do nothing: clients name services when they call them."""

    def remove_service(self, handle: int, service: Service) -> None:
        """Do nothing: see ``add_service``."""

    def pass_answer(self, context: object, raw: bytes) -> None:
        """Send a response."""
        if isinstance(context, GoalStep):
            self._goals.pass_answer(context, raw)
        elif isinstance(context, _Call):
            self._calls -= 1
            try:
                body = codec_of(context.service.response).to_json(raw)
            except GdpError as error:
                self._respond(context.name, context.number, str(error), result=False)
                return
            self._respond(context.name, context.number, orjson.Fragment(body), result=True)

    def pass_refusal(self, context: object, reason: str) -> None:
        """Send the reason of a failed call."""
        if isinstance(context, GoalStep):
            self._goals.pass_refusal(context, reason)
        elif isinstance(context, _Call):
            self._calls -= 1
            self._respond(context.name, context.number, reason, result=False)

    def _subscribe(self, fields: Fields) -> None:
        name, number = word(fields, "topic"), str(identifier(fields))
        topic = resolved(name)
        type_name = ros2_type(word(fields, "type", is_optional=True), "msg")
        period_s = whole_number(fields, "throttle_rate", _PERIOD_MAX_MS) / 1e3
        queue_length = whole_number(fields, "queue_length", _QUEUE_MAX)
        compression = word(fields, "compression", is_optional=True) or "none"
        if compression not in _COMPRESSIONS:
            raise LocalError(f"subscribe {topic}: compression {compression} is not one of {', '.join(_COMPRESSIONS)}")
        if reason := self._hub.rights().may_read(topic, type_name):
            raise LocalError(f"subscribe {topic}: {reason}")
        each = self._subscriptions.get(name)
        if each is None or number not in each.wishes:
            self._take_id(f"subscribe {topic}")
        if each is None:
            each = self._subscriptions[name] = _Subscription(next(self._keys), topic, type_name)
            self._names[each.key] = name
            self._readers[topic].append(each)
        is_new = not each.wishes
        each.wishes[number] = (period_s, queue_length, compression)
        each.merge()
        if is_new and (offered := self._offered.get(topic)) is not None:
            for stamp_ns, raw in offered.kept:
                self.queue.put(each.key, stamp_ns, raw)
        self._hub.update_graph()

    def _unsubscribe(self, fields: Fields) -> None:
        name = word(fields, "topic")
        each = self._subscriptions.get(name)
        if each is None:
            raise LocalError(f"unsubscribe {name}: it is not subscribed")
        before = len(each.wishes)
        if "id" in fields:
            each.wishes.pop(str(identifier(fields)), None)
        else:
            each.wishes.clear()
        self._ids -= before - len(each.wishes)
        if each.wishes:
            each.merge()
            return
        del self._subscriptions[name], self._names[each.key]
        self._readers[each.topic].remove(each)
        if not self._readers[each.topic]:
            del self._readers[each.topic]
        self.queue.forget(each.key)
        self._hub.update_graph()

    def _advertise(self, fields: Fields) -> None:
        topic, type_name = resolved(word(fields, "topic")), ros2_type(word(fields, "type"), "msg")
        if reason := self._hub.rights().may_publish(topic, type_name):
            raise LocalError(f"advertise {topic}: {reason}")
        number = str(identifier(fields))
        if topic not in self._published or number not in self._published[topic][1]:
            self._take_id(f"advertise {topic}")
        _, numbers = self._published.setdefault(topic, (type_name, set()))
        numbers.add(number)
        self._hub.update_graph()

    def _unadvertise(self, fields: Fields) -> None:
        topic = resolved(word(fields, "topic"))
        if topic not in self._published:
            raise LocalError(f"unadvertise {topic}: it is not advertised")
        numbers = self._published[topic][1]
        gone = {str(identifier(fields))} & numbers if "id" in fields else set(numbers)
        numbers -= gone
        self._ids -= len(gone)
        if not numbers:
            del self._published[topic]
            self._hub.update_graph()

    def _take_id(self, what: str) -> None:
        """Count one more id. Raises ``LocalError``: the client has too many."""
        if self._ids >= IDS_MAX:
            raise LocalError(f"{what}: more than {IDS_MAX} ids")
        self._ids += 1

    def _publish(self, fields: Fields) -> None:
        topic = resolved(word(fields, "topic"))
        if topic not in self._published:
            type_name = ros2_type(word(fields, "type", is_optional=True), "msg") or self._hub.rights().type_of(topic)
            self._advertise({"topic": topic, "type": type_name or "unknown"})
        type_name = self._published[topic][0]
        channel = self._hub.channel_of(topic, type_name)
        if channel is None:
            raise LocalError(f"publish {topic}: the definition of {type_name} is not known here")
        raw = codec_of(channel).to_raw(fields.get("msg", {}), self._received_ns)
        self._hub.input(topic, type_name, self._received_ns, raw)

    def _call(self, fields: Fields) -> None:
        name, number = word(fields, "service"), identifier(fields, None)
        full, args = resolved(name), fields.get("args", {})
        if full.startswith(_ROSAPI):
            self._rosapi(name, full.removeprefix(_ROSAPI), number, args if isinstance(args, dict) else {})
            return
        handle = self._hub.server_of(full)
        if handle is None or self._calls >= CALLS_MAX:
            reason = self._hub.rights().may_call(full) or f"{name}: no server is reachable"
            reason = reason if handle is None else f"{name}: more than {CALLS_MAX} calls are under way"
            self._respond(name, number, reason, result=False)
            return
        service = self._hub.services[handle]
        try:
            raw = codec_of(service.request).to_raw(_named_arguments(service.request, args), self._received_ns)
        except GdpError as error:
            self._respond(name, number, str(error), result=False)
            return
        self._calls += 1
        self._hub.request(self, handle, _Call(service, name, number), raw)

    def _rosapi(self, name: str, query: str, number: object, args: dict[str, object]) -> None:
        """Answer what lists names and types."""
        topics = {topic: each.channel.type_name for topic, each in self._offered.items()}
        services = {each.name: each.type_name for each in self._hub.services.values()}
        wanted = str(args.get("type", ""))
        answers: Mapping[str, Mapping[str, object]] = {
            "get_time": {"time": both_spellings(self._received_ns)},
            "topics": {"topics": [*topics], "types": [*topics.values()]},
            "topics_and_raw_types": {
                "topics": [*topics],
                "types": [*topics.values()],
                "typedefs_full_text": [each.channel.definition for each in self._offered.values()],
            },
            "action_servers": {"action_servers": [each[: -len(SENDS)] for each in services if each.endswith(SENDS)]},
            "topic_type": {"type": topics.get(resolved(str(args.get("topic"))), "")},
            "topics_for_type": {
                "topics": [topic for topic, each in topics.items() if each == ros2_type(wanted, "msg")]
            },
            "services": {"services": [*services]},
            "service_type": {"type": services.get(resolved(str(args.get("service"))), "")},
            "services_for_type": {
                "services": [each for each, kind in services.items() if kind == ros2_type(wanted, "srv")]
            },
        }
        values = answers.get(query)
        if values is None:
            self._respond(name, number, f"{name} is not offered by this door", result=False)
        else:
            self._respond(name, number, values, result=True)

    def _set_level(self, fields: Fields) -> None:
        level = word(fields, "level")
        if level not in _LEVELS:
            raise LocalError(f"set_level: the level is one of {', '.join(_LEVELS)}")
        self._level = _LEVELS.index(level)

    def _tell(self, level: str, text: str, number: object) -> None:
        if _LEVELS.index(level) <= self._level:
            self.queue.put_control(text_of(number, op="status", level=level, msg=text[:REASON_MAX]))

    def _respond(self, service: str, number: object, values: object, *, result: bool) -> None:
        values = values[:REASON_MAX] if isinstance(values, str) else values
        self.queue.put_control(text_of(number, op="service_response", service=service, values=values, result=result))


def _named_arguments(request: Channel, args: object) -> object:
    """Return arguments by name; rosbridge allows a list in the order of the fields."""
    if not isinstance(args, list):
        return {} if args is None else args
    names = RosbridgeCodec(request).field_names
    if len(args) > len(names):
        raise wrong(f"{len(args)} arguments; {request.type_name} has {len(names)}")
    return dict(zip(names, args, strict=False))
