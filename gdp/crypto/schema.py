"""Schema of statement bodies: each field is declared once, with its key, its form and its bounds.

Sans-I/O. A body is a dataclass; the annotation of each field that travels has its key::

    @dataclass(frozen=True, slots=True)
    class Query(Body):
        TYPE = StatementType.QUERY
        name: Annotated[Name, Keyed("n", NAME)]
        watch_s: Annotated[float, Keyed("w", number(0, LEASE_MAX_S))]

Unknown keys are no error: a later version may have more. The reference (``docs/reference/statements.md``) and the
fuzzers' seeds come from the same declarations.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from enum import Enum
from typing import Any, ClassVar, Final, Generic, TypeAlias, TypeVar, cast, get_type_hints

from gdp.crypto.cbor import Value, decode, encode
from gdp.crypto.keys import SigningKey
from gdp.crypto.statements import Statement, StatementType, sign
from gdp.errors import DropReason, StatementError
from gdp.limits import CONTROL_MAX_BYTES
from gdp.names import NAME_BYTES, ZERO, Name

_B = TypeVar("_B", bound="FieldSet")
_E = TypeVar("_E", bound=Enum)
_L = TypeVar("_L", str, bytes)
_N = TypeVar("_N")
_S = TypeVar("_S", bound="Body")
_T = TypeVar("_T")
_V = TypeVar("_V")
_Marks: TypeAlias = (
    "tuple[tuple[str, Keyed[Any] | Spread[Any], Any, Callable[[Any], Any], Callable[[Any], object] | None], ...]"
)
_U64_MAX: Final = (1 << 64) - 1
_REQUIRED: Final = object()
_NO_REASON: Final = 255
_KNOWN: Final[dict[type[FieldSet], _Marks]] = {}


def _as_is(value: object) -> object:
    return value


@dataclass(frozen=True, slots=True)
class Form(Generic[_T]):
    """What a value may be, and how it travels.

    Args:
        words: for errors and the reference.
        read: returns the value of what was received; raises ``ValueError`` where that is something else.
        write: returns what is sent.
        edges: received values that it reads: the smallest and the largest, of a list no item and one.
    """

    words: str
    read: Callable[[Value], _T]
    write: Callable[[_T], object] = _as_is
    edges: tuple[Value, ...] = ()


@dataclass(frozen=True, slots=True)
class Keyed(Generic[_T]):
    """Key of a field, and its form.

    Args:
        absent: value of a field whose key is missing; without it the key is required.
        is_omitted: a field with that value is not sent.
    """

    key: str
    form: Form[_T]
    absent: object = _REQUIRED
    is_omitted: bool = False

    @property
    def keys(self) -> tuple[Keyed[Any], ...]:
        """Return the keys that the field takes."""
        return (self,)

    @property
    def is_required(self) -> bool:
        """Return whether a map without the key is malformed."""
        return self.absent is _REQUIRED

    def read(self, received: Mapping[str, Value]) -> _T:
        """Return the field of a received map. Raises ``StatementError``: MALFORMED."""
        if self.absent is not _REQUIRED and self.key not in received:
            return cast("_T", self.absent)
        value = received.get(self.key)
        try:
            return self.form.read(value)
        except ValueError as error:
            raise StatementError(DropReason.MALFORMED, f"{self.key!r} is not {self.form.words}") from error

    def write(self, value: _T, sent: dict[str, object]) -> None:
        """Add the field to a map that is sent."""
        if not (self.is_omitted and value == self.absent):
            sent[self.key] = self.form.write(value)


@dataclass(frozen=True, slots=True)
class Spread(Generic[_T]):
    """Keys of a field that takes several.

    Args:
        make: returns the field of their values, in order; may raise ``StatementError``.
        split: returns their values.
    """

    keys: tuple[Keyed[Any], ...]
    make: Callable[..., _T]
    split: Callable[[_T], tuple[object, ...]]

    def read(self, received: Mapping[str, Value]) -> _T:
        """Return the field of a received map. Raises ``StatementError``: MALFORMED, or as ``make``."""
        try:  # as ``Keyed.read``, without its cost
            values = [key.form.read(received[key.key]) for key in self.keys]
        except (KeyError, ValueError):
            values = [key.read(received) for key in self.keys]
        return self.make(*values)

    def write(self, value: _T, sent: dict[str, object]) -> None:
        """Add the field to a map that is sent."""
        for key, each in zip(self.keys, self.split(value), strict=True):
            key.write(each, sent)

    def to_fields(self, value: _T) -> dict[str, object]:
        """Return the field as a map."""
        sent: dict[str, object] = {}
        self.write(value, sent)
        return sent


class FieldSet:
    """Fields of a map: a body in a body, a message or a file.

    Attributes:
        MAX_BYTES: of the encoded map, or of the whole statement.
    """

    __slots__ = ()
    MAX_BYTES: ClassVar[int] = CONTROL_MAX_BYTES

    @classmethod
    def declared(cls) -> tuple[Keyed[Any], ...]:
        """Return the keys of the fields, in order."""
        return tuple(key for _, mark, *_ in _marks(cls) for key in mark.keys)

    def check(self) -> None:
        """Return if the fields fit together. Raises ``StatementError``."""

    def to_fields(self) -> dict[str, object]:
        """Return the fields as a map."""
        sent: dict[str, object] = {}
        for attribute, mark, key, _, write in _KNOWN.get(type(self)) or _marks(type(self)):
            if write is not None:  # as ``Keyed.write``, without its cost
                sent[key] = write(getattr(self, attribute))
            else:
                mark.write(getattr(self, attribute), sent)
        return sent

    @classmethod
    def from_fields(cls: type[_B], received: Mapping[str, Value], **given: object) -> _B:
        """Read a map; fields that do not travel are ``given``.

        Raises:
            StatementError: MALFORMED, or as ``check``.
        """
        return cls._made(received, given)

    @classmethod
    def _made(cls: type[_B], received: Mapping[str, Value], given: dict[str, object]) -> _B:
        for attribute, mark, key, read, _ in _KNOWN.get(cls) or _marks(cls):
            if key in received:  # as ``Keyed.read``, without its cost
                try:
                    given[attribute] = read(received[key])
                except ValueError:
                    mark.read(received)  # which raises
            else:
                given[attribute] = mark.read(received)
        found = cls(**given)
        found.check()
        return found

    def to_cbor(self) -> bytes:
        """Return the encoded map. Raises ``LocalError``: a value that CBOR cannot carry."""
        return encode(self.to_fields())

    @classmethod
    def from_cbor(cls: type[_B], wire: bytes) -> _B:
        """Read an encoded map as ``from_fields``."""
        received = decode(wire, cls.MAX_BYTES)
        if not isinstance(received, dict):
            raise StatementError(DropReason.MALFORMED, "a map is expected")
        return cls.from_fields(received)


class Body(FieldSet):
    """Body of a statement; ``TYPE``: of its statement."""

    __slots__ = ()
    TYPE: ClassVar[StatementType]

    @classmethod
    def given_by(cls, _statement: Statement) -> dict[str, object]:
        """Return the fields that do not travel, as the statement gives them."""
        return {}

    @classmethod
    def from_statement(cls: type[_S], statement: Statement) -> _S:
        """Read a parsed statement as ``from_fields``; no signature is checked.

        Raises:
            StatementError: MALFORMED, also another type, TOO_BIG, or as ``check``.
        """
        received = statement.expect(cls.TYPE)
        if len(statement.wire) > cls.MAX_BYTES:
            raise StatementError(DropReason.TOO_BIG, f"{cls.TYPE.value} of {len(statement.wire)} bytes")
        return cls._made(received, cls.given_by(statement))

    def to_wire(self, signer: Name, key: SigningKey, membership: bytes | None = None) -> bytes:
        """Return the signed statement, with the signer's certificate if given. Raises ``LocalError``: too long."""
        certificate = {} if membership is None else {CERTIFICATE.key: membership}
        return sign(self.TYPE, self.to_fields() | certificate, signer, key)


def _marks(kind: type[FieldSet]) -> _Marks:
    """Return the fields that travel, each with its mark, key and reader; resolved once, when all modules are there."""
    known = _KNOWN.get(kind)
    if known is None:
        hints = get_type_hints(kind, include_extras=True)
        names = [each.name for each in fields(cast("Any", kind)) if hasattr(hints[each.name], "__metadata__")]
        marks = [(name, mark) for name in names for mark in hints[name].__metadata__]
        known = _KNOWN[kind] = tuple(
            (name, mark, mark.key, mark.form.read, None if mark.is_omitted else mark.form.write)
            if isinstance(mark, Keyed)
            else (name, mark, None, mark.read, None)
            for name, mark in marks
        )
    return known


def uint(maximum: int = _U64_MAX, minimum: int = 0) -> Form[int]:
    """Return the form of a whole number within the bounds."""
    words = "uint" if maximum == _U64_MAX else f"uint {minimum}–{maximum:,}" if minimum else f"uint ≤{maximum:,}"

    def read(value: Value) -> int:
        if type(value) is not int or not minimum <= value <= maximum:
            raise ValueError(words)
        return value

    return Form(words, read, edges=(minimum, maximum))


def number(minimum: float, maximum: float) -> Form[float]:
    """Return the form of a finite number within the bounds; it is sent as a floating one."""
    words = f"number {minimum:g}–{maximum:,g}"

    def read(value: Value) -> float:
        if isinstance(value, bool) or not isinstance(value, int | float) or not minimum <= value <= maximum:
            raise ValueError(words)
        return float(value)

    return Form(words, read, float, edges=(minimum, maximum))


def _sized(kind: type[_L], words: str, least: int, most: int) -> Form[_L]:
    """Return the form of text or bytes of a length within the bounds."""

    def read(value: Value) -> _L:
        if type(value) is not kind or not least <= len(value) <= most:
            raise ValueError(words)
        return value

    one = cast("Any", "x" if kind is str else b"x")
    return Form(words, read, edges=(one * least, one * min(most, CONTROL_MAX_BYTES)))


def text(maximum: int) -> Form[str]:
    """Return the form of text of at most ``maximum`` characters."""
    return _sized(str, f"text ≤{maximum:,}", 0, maximum)


def octets(size: int = 0, *, most: int = 0) -> Form[bytes]:
    """Return the form of exactly ``size`` bytes, or of up to ``most``."""
    return _sized(bytes, f"bytes ≤{most:,}" if most else f"bytes, {size:,}", 0 if most else size, most or size)


def mapped(form: Form[_V], read: Callable[[_V], _T], write: Callable[[_T], object], words: str = "") -> Form[_T]:
    """Return the form of what travels in another form; ``read`` may raise ``ValueError``."""
    return Form(
        words or form.words,
        lambda value: read(form.read(value)),
        lambda value: form.write(cast("_V", write(value))),
        form.edges,
    )


def packed(size: int, unpack: Callable[[bytes], _T], pack: Callable[[_T], bytes]) -> Form[_T]:
    """Return the form of what travels as ``size`` bytes; ``unpack`` may raise ``ValueError``."""
    return mapped(octets(size), unpack, pack)


def one_of(kind: type[_E]) -> Form[_E]:
    """Return the form of a member of an enumeration, which travels as its value."""
    words = "/".join(str(each.value) for each in kind)
    return Form(words, kind, lambda value: value.value, tuple(each.value for each in kind))


def literal(*values: _T) -> Form[_T]:
    """Return the form of one of a few texts or numbers."""
    words = "/".join(str(each) for each in values)

    def read(value: Value) -> _T:
        for each in values:
            if type(value) is type(each) and value == each:
                return each
        raise ValueError(words)

    return Form(words, read, edges=cast("tuple[Value, ...]", values))


def or_empty(form: Form[_T], none: _N) -> Form[_T | _N]:
    """Return the form in which empty bytes stand for one value."""
    return Form(
        f"{form.words} or empty",
        lambda value: none if value == b"" else form.read(value),
        lambda value: b"" if value == none else form.write(cast("_T", value)),
        (b"", *form.edges),
    )


def many(form: Form[_T], maximum: int, *, is_cut: bool = True) -> Form[tuple[_T, ...]]:
    """Return the form of a list; what is more than ``maximum`` is not sent, or, if it is not cut, refused there."""
    words = f"array ≤{maximum:,} of {form.words}"
    sent = maximum if is_cut else None

    def read(value: Value) -> tuple[_T, ...]:
        if not isinstance(value, list) or len(value) > maximum:
            raise ValueError(words)
        return tuple([form.read(each) for each in value])

    return Form(words, read, lambda values: [form.write(each) for each in values[:sent]], ([], [*form.edges[-1:]]))


def row(make: Callable[..., _T], *forms: Form[Any]) -> Form[_T]:
    """Return the form of a tuple that travels as a list with one value for each of its fields."""
    words = f"[{'; '.join(each.words for each in forms)}]"

    def read(value: Value) -> _T:
        if not isinstance(value, list) or len(value) != len(forms):
            raise ValueError(words)
        return make(*[form.read(each) for form, each in zip(forms, value, strict=True)])

    return Form(
        words,
        read,
        lambda values: [form.write(each) for form, each in zip(forms, cast("Any", values), strict=True)],
        tuple([each.edges[at] for each in forms if each.edges] for at in (0, -1)),
    )


def joined(size: int, unpack: Callable[[bytes], _T], pack: Callable[[_T], bytes], most: int) -> Form[tuple[_T, ...]]:
    """Return the form of items of one size that travel one after the other in one byte string, at most ``most``."""
    words = f"bytes, {size} each, ≤{most:,}"

    def read(value: Value) -> tuple[_T, ...]:
        if not isinstance(value, bytes) or len(value) % size or len(value) > most * size:
            raise ValueError(words)
        return tuple([unpack(value[at : at + size]) for at in range(0, len(value), size)])

    return Form(words, read, lambda values: b"".join([pack(each) for each in values]), (b"", bytes(size)))


def inner(kind: type[_B]) -> Form[_B]:
    """Return the form of a body in a body."""

    def read(value: Value) -> _B:
        if not isinstance(value, dict):
            raise ValueError("map")
        return kind.from_fields(value)

    return Form("map", read, lambda body: body.to_fields(), ({},))


def _name(value: Value) -> Name:
    if not isinstance(value, bytes) or len(value) != NAME_BYTES or value == ZERO:
        raise ValueError("name")
    return Name(value)


def _reason(code: int) -> DropReason | None:
    """Return a reason; one of a later version is MALFORMED, since a refusal is a refusal all the same."""
    if code == _NO_REASON:
        return None
    return DropReason(code) if code in DropReason.__members__.values() else DropReason.MALFORMED


def _exactly(kind: type[_T], words: str, *edges: Value) -> Form[_T]:
    def read(value: Value) -> _T:
        if type(value) is not kind:
            raise ValueError(words)
        return value

    return Form(words, read, edges=edges)


FLAG: Final = _exactly(bool, "bool", False, True)
OCTETS: Final = _exactly(bytes, "bytes", b"", bytes(NAME_BYTES))
CERT: Final = replace(OCTETS, words="cert")  # of a membership, DER
STATEMENT: Final = replace(OCTETS, words="statement")
CERTIFICATE: Final = Keyed("c", CERT)  # of the signer, which many statements have in addition to their body
NAME: Final = Form("name", _name, edges=(b"\1" * NAME_BYTES,))
NAME_OR_ZERO: Final = mapped(octets(NAME_BYTES), Name, _as_is, "name or zeros")
REASON: Final[Form[DropReason | None]] = mapped(
    uint(_NO_REASON), _reason, lambda reason: _NO_REASON if reason is None else int(reason)
)
MAP: Final[Form[Any]] = mapped(_exactly(dict, "map", {}), _as_is, dict)
