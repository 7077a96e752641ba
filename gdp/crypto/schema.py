"""Schema of statement bodies: each field is declared once, with its key, its form and its bounds.

Sans-I/O. A body is a dataclass; the annotation of each field that travels has its key::

    @dataclass(frozen=True, slots=True)
    class Query(Body):
        TYPE = StatementType.QUERY
        name: Annotated[Name, Keyed("n", NAME)]
        watch_s: Annotated[float, Keyed("w", number(0, LEASE_MAX_S))]

Unknown keys are no error: a later version may have more.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any, ClassVar, Final, Generic, TypeVar, cast, get_type_hints

from gdp.crypto.cbor import Value
from gdp.crypto.fields import Fields
from gdp.crypto.keys import SigningKey
from gdp.crypto.statements import StatementType, sign
from gdp.errors import DropReason, StatementError
from gdp.names import NAME_BYTES, ZERO, Name

__all__ = [
    "FLAG",
    "MAP",
    "NAME",
    "NAME_OR_ZERO",
    "OCTETS",
    "REASON",
    "Body",
    "Form",
    "Keyed",
    "inner",
    "joined",
    "many",
    "number",
    "octets",
    "or_empty",
    "packed",
    "row",
    "text",
    "uint",
]

_B = TypeVar("_B", bound="Body")
_N = TypeVar("_N")
_T = TypeVar("_T")
_U64_MAX: Final = (1 << 64) - 1
_REQUIRED: Final = object()
_NO_REASON: Final = 255
_KNOWN: Final[dict[type[Body], tuple[tuple[str, Keyed[Any], Form[Any]], ...]]] = {}


def _as_is(value: object) -> object:
    return value


@dataclass(frozen=True, slots=True)
class Form(Generic[_T]):
    """What a value may be, and how it travels.

    Args:
        words: for errors and the reference.
        read: returns the value of what was received; raises ``ValueError`` where that is something else.
        write: returns what is sent.
    """

    words: str
    read: Callable[[Value], _T]
    write: Callable[[_T], object] = _as_is


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


class Body:
    """Body of a statement, or a map in one."""

    __slots__ = ()
    TYPE: ClassVar[StatementType]

    @property
    def statement_type(self) -> StatementType:
        """Return the type of its statement."""
        return self.TYPE

    def check(self) -> None:
        """Return if the fields fit together. Raises ``StatementError``."""

    def to_fields(self) -> dict[str, object]:
        """Return the fields as a map."""
        found: dict[str, object] = {}
        for attribute, key, form in _keys(type(self)):
            value = getattr(self, attribute)
            if not (key.is_omitted and value == key.absent):
                found[key.key] = value if form.write is _as_is else form.write(value)
        return found

    @classmethod
    def from_fields(cls: type[_B], fields: Fields) -> _B:
        """Read a map. Raises ``StatementError``: MALFORMED, or as ``check``."""
        return cls.read(fields)

    @classmethod
    def read(cls: type[_B], fields: Fields, **given: object) -> _B:
        """Read a map as ``from_fields``; fields that do not travel are ``given``."""
        for attribute, key, form in _keys(cls):
            if key.absent is not _REQUIRED and key.key not in fields:
                given[attribute] = key.absent
                continue
            try:
                given[attribute] = form.read(fields.get(key.key))
            except ValueError as error:
                raise StatementError(DropReason.MALFORMED, f"{key.key!r} is not {form.words}") from error
        body = cls(**given)
        body.check()
        return body

    def to_wire(self, signer: Name, key: SigningKey, membership: bytes | None = None) -> bytes:
        """Return the signed statement, with the signer's certificate if given. Raises ``LocalError``: too long."""
        certificate = {} if membership is None else {"c": membership}
        return sign(self.statement_type, self.to_fields() | certificate, signer, key)


def _keys(kind: type[Body]) -> tuple[tuple[str, Keyed[Any], Form[Any]], ...]:
    """Return the fields of a body that travel; resolved once, when all modules are there."""
    known = _KNOWN.get(kind)
    if known is None:
        hints = get_type_hints(kind, include_extras=True)
        names = [each.name for each in fields(cast("Any", kind)) if hasattr(hints[each.name], "__metadata__")]
        known = _KNOWN[kind] = tuple((name, mark, mark.form) for name in names for mark in hints[name].__metadata__)
    return known


def _typed(words: str, kind: type[_T], fits: Callable[[_T], bool] = lambda _: True) -> Form[_T]:
    """Return the form of values of exactly one type that fit."""

    def read(value: Value) -> _T:
        if type(value) is not kind or not fits(value):
            raise ValueError(words)
        return value

    return Form(words, read)


def uint(maximum: int = _U64_MAX, minimum: int = 0) -> Form[int]:
    """Return the form of a whole number within the bounds."""
    return _typed(f"a whole number from {minimum} to {maximum}", int, lambda value: minimum <= value <= maximum)


def number(minimum: float, maximum: float) -> Form[float]:
    """Return the form of a finite number within the bounds; it is sent as a floating one."""
    words = f"a number from {minimum} to {maximum}"

    def read(value: Value) -> float:
        if isinstance(value, bool) or not isinstance(value, int | float) or not minimum <= value <= maximum:
            raise ValueError(words)
        return float(value)

    return Form(words, read, float)


def text(maximum: int) -> Form[str]:
    """Return the form of text of at most ``maximum`` characters."""
    return _typed(f"text of at most {maximum} characters", str, lambda value: len(value) <= maximum)


def octets(size: int = 0, *, most: int = 0) -> Form[bytes]:
    """Return the form of exactly ``size`` bytes, or of up to ``most``."""
    if most:
        return _typed(f"at most {most} bytes", bytes, lambda value: len(value) <= most)
    return _typed(f"{size} bytes", bytes, lambda value: len(value) == size)


def or_empty(form: Form[_T], none: _N) -> Form[_T | _N]:
    """Return the form in which empty bytes stand for one value."""
    return Form(
        f"{form.words}, or empty",
        lambda value: none if value == b"" else form.read(value),
        lambda value: b"" if value == none else form.write(cast("_T", value)),
    )


def many(form: Form[_T], maximum: int) -> Form[tuple[_T, ...]]:
    """Return the form of a list; what is more than ``maximum`` is not sent."""
    words = f"a list of at most {maximum}, each {form.words}"

    def read(value: Value) -> tuple[_T, ...]:
        if not isinstance(value, list) or len(value) > maximum:
            raise ValueError(words)
        return tuple([form.read(each) for each in value])

    return Form(words, read, lambda values: [form.write(each) for each in values[:maximum]])


def row(make: Callable[..., _T], *forms: Form[Any]) -> Form[_T]:
    """Return the form of a tuple that travels as a list with one value for each of its fields."""
    words = f"[{', '.join(each.words for each in forms)}]"

    def read(value: Value) -> _T:
        if not isinstance(value, list) or len(value) != len(forms):
            raise ValueError(words)
        return make(*[form.read(each) for form, each in zip(forms, value, strict=True)])

    return Form(
        words, read, lambda values: [form.write(each) for form, each in zip(forms, cast("Any", values), strict=True)]
    )


def joined(size: int, unpack: Callable[[bytes], _T], pack: Callable[[_T], bytes], most: int) -> Form[tuple[_T, ...]]:
    """Return the form of items of one size that travel one after the other in one byte string, at most ``most``."""
    words = f"up to {most} times {size} bytes"

    def read(value: Value) -> tuple[_T, ...]:
        if not isinstance(value, bytes) or len(value) % size or len(value) > most * size:
            raise ValueError(words)
        return tuple([unpack(value[at : at + size]) for at in range(0, len(value), size)])

    return Form(words, read, lambda values: b"".join([pack(each) for each in values]))


def packed(size: int, unpack: Callable[[bytes], _T], pack: Callable[[_T], bytes]) -> Form[_T]:
    """Return the form of what travels as ``size`` bytes; ``unpack`` may raise ``ValueError``."""
    form = octets(size)
    return Form(form.words, lambda value: unpack(form.read(value)), pack)


def inner(kind: type[_B]) -> Form[_B]:
    """Return the form of a body in a body."""

    def read(value: Value) -> _B:
        if not isinstance(value, dict):
            raise ValueError("a map")
        return kind.from_fields(Fields(value))

    return Form("a map", read, lambda body: body.to_fields())


def _name(value: Value) -> Name:
    if not isinstance(value, bytes) or len(value) != NAME_BYTES or value == ZERO:
        raise ValueError("a name")
    return Name(value)


def _reason(value: Value) -> DropReason | None:
    """Return a reason; one of a later version is MALFORMED, since a refusal is a refusal all the same."""
    code = uint(_NO_REASON).read(value)
    if code == _NO_REASON:
        return None
    return DropReason(code) if code in DropReason.__members__.values() else DropReason.MALFORMED


def _map(value: Value) -> Fields:
    if not isinstance(value, dict):
        raise ValueError("a map")
    return Fields(value)


FLAG: Final = _typed("true or false", bool)
OCTETS: Final = _typed("bytes", bytes)
NAME: Final = Form("a name", _name)
NAME_OR_ZERO: Final = Form("a name, or zeros", lambda value: Name(octets(NAME_BYTES).read(value)))
REASON: Final[Form[DropReason | None]] = Form(
    "a reason, or 255", _reason, lambda reason: _NO_REASON if reason is None else int(reason)
)
MAP: Final[Form[Any]] = Form("a map", _map, dict)
