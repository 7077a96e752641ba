"""Common schema of configuration files: strict fields, paths relative to the file, errors with their position in it.

I/O; loading reads files and changes nothing. ``gdp/config/config.py`` and ``proxy/config/config.py`` state the keys.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, ClassVar, Final, TypeVar, get_args

import orjson
from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, ValidationError, ValidationInfo
from pydantic.config import JsonDict
from pydantic_core import ErrorDetails

from gdp.config.machine_file import section_source
from gdp.config.yaml_source import ConfigFileError, KeyPath, YamlSource, read_yaml
from gdp.errors import ConfigError, LocalError
from gdp.names import Name

# The search for plugins of pydantic reads the metadata of each installed package, and we use none.
os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "__all__")

_VALUE_ERROR: Final = "Value error, "  # prefix of pydantic for what our validators say
_SHOULD_BE: Final = "Input should be "  # prefix of pydantic for a value of the wrong kind or out of bounds
_PATH_SHOWN: Final = 200  # characters
_IFNAME_MAX: Final = 15  # IFNAMSIZ - 1; Linux, include/uapi/linux/if.h
_WORDS: Final = {
    "an object": "a mapping of keys to values",
    "array": "a list",
    "boolean": "true or false",
    "integer": "a whole number",
    "number": "a number",
    "string": "a text",
}

M = TypeVar("M", bound="Section")
T = TypeVar("T")


class Section(BaseModel):
    """One mapping of a configuration file: immutable, and without undeclared keys.

    Attributes:
        renamed: old keys of this mapping with their new names; an old key is an error that names the new one. A new
            name may be a path such as ``limits.frames``.
    """

    renamed: ClassVar[Mapping[str, str]] = {}

    model_config = ConfigDict(extra="forbid", frozen=True, arbitrary_types_allowed=True, defer_build=True)


def or_short(*short: JsonDict) -> Any:
    """Return the field of a section that is also stated in short forms, of these schemas; a validator reads them."""

    def add(schema: JsonDict) -> None:
        forms = schema.get("anyOf")
        if isinstance(forms, list):
            schema["anyOf"] = [*short, *forms]

    return Field(json_schema_extra=add)


def relative(path: Path, info: ValidationInfo) -> Path:
    """Return ``path`` relative to the file that names it; ``load`` puts that folder into the context."""
    base = info.context["base"] if isinstance(info.context, dict) else Path()
    try:
        return Path(base) / path.expanduser()
    except RuntimeError as error:
        raise ValueError(f"no such home directory: {str(path)[:_PATH_SHOWN]}") from error


def _is_there(exists: Callable[[], bool]) -> bool:
    """Return the result of a check on a path; a path that the system refuses, such as a too long one, is missing."""
    try:
        return exists()
    except OSError:
        return False


def _file(path: Path) -> Path:
    if not _is_there(path.is_file):
        raise ValueError(f"no such file: {path}")
    return path


def _directory(path: Path) -> Path:
    if not _is_there(path.is_dir):
        raise ValueError(f"no such directory: {path}")
    return path


def _writable_place(path: Path) -> Path:
    if not _is_there(path.parent.is_dir):
        raise ValueError(f"no such directory: {path.parent}")
    return path


def _unique(items: tuple[T, ...]) -> tuple[T, ...]:
    for index, item in enumerate(items):
        if item in items[:index]:
            raise ValueError(f"{item} stands twice")
    return items


def read_name(value: object) -> Name | None:
    """Read 64 hex digits, or ``null`` for no name."""
    if value is None or isinstance(value, Name):
        return value
    try:
        return Name.from_text(value if isinstance(value, str) else "")
    except LocalError as error:
        raise ValueError(str(error)) from error


def _ifname(text: str) -> str:
    if not text or len(text) > _IFNAME_MAX or text in (".", "..") or set(text) & set("/: \t\n") or not text.isascii():
        raise ValueError(f"a device's name has 1 to {_IFNAME_MAX} characters without '/', ':' or blanks")
    return text


Relative = Annotated[Path, AfterValidator(relative)]
ExistingFile = Annotated[Relative, AfterValidator(_file)]
Directory = Annotated[Relative, AfterValidator(_directory)]
NewFile = Annotated[Relative, AfterValidator(_writable_place)]
Unique = AfterValidator(_unique)
Ifname = Annotated[str, AfterValidator(_ifname)]
RequiredName = Annotated[Name, BeforeValidator(read_name)]

# Keys that several files have
Identity = Annotated[Directory, Field(description="Keys and membership; its role is the file's.")]
StateFolder = Annotated[
    Directory | None,
    Field(description="Private directory that keeps revocations across restarts."),
]
AuditFolder = Annotated[
    NewFile | None, Field(description="Folder of the audit log. `null`: below `$STATE_DIRECTORY`, if set.")
]
TokenFolders = Annotated[
    tuple[Directory, ...], Unique, Field(description="Folders that the library of a token goes on to use.")
]
ControlSocket = Annotated[
    NewFile | None,
    Field(description="Control socket. `null`: next to the locks of nodes."),
]
JournalMib = Annotated[
    int | None,
    Field(ge=1, le=1_024, description="MiB of memory for a journal, which `gdp incident` saves. `null`: none."),
]
Sandbox = Annotated[bool, Field(description="Drop rights that are not needed once the node is up.")]


class Domain(Section):
    """The trust domain of a node, and the others whose members it believes."""

    root: ExistingFile = Field(description="Root certificate of the node's own trust domain.")
    trusts: Annotated[tuple[ExistingFile, ...], Unique] = Field(
        default=(), description="Roots of other domains whose members are believed; not inherited."
    )
    transit: tuple[str, ...] | None = Field(
        default=None, description="Labels of further domains that may carry its traffic. `null`: all trusted."
    )
    diagnostics: tuple[str, ...] = Field(
        default=(), description="Labels of domains whose members get whole diagnostic replies."
    )


class Metrics(Section):
    """Prometheus text on a loopback port."""

    port: int = Field(ge=1, le=65_535, description="Port on 127.0.0.1.")


def load(
    model: type[M],
    path: Path,
    *,
    section: str = "",
    more: Mapping[str, object] | None = None,
    locate: Callable[[YamlSource, KeyPath], tuple[YamlSource, KeyPath]] | None = None,
) -> M:
    """Read a YAML file as this model.

    Args:
        section: the model's section if the file is a ``machine.yaml``.
        more: further context of the model's validators.
        locate: the file, and its key, that a key of the model comes from; None: the same key of this file.

    Raises:
        ConfigError: the file cannot be read, or holds anything outside the model; then the error lists every finding.
    """
    source = section_source(read_yaml(path), section)
    context = {"base": path.parent, **(more or {})}
    try:
        return model.model_validate_json(orjson.dumps(source.data), strict=True, context=context)
    except ValidationError as invalid:
        found: dict[Path, tuple[YamlSource, list[ErrorDetails]]] = {}
        for detail in invalid.errors(include_url=False):
            key = tuple(detail["loc"])
            at, key = (source, key) if locate is None else locate(source, key)
            found.setdefault(at.path, (at, []))[1].append({**detail, "loc": key})
        errors = [error for at, details in found.values() for error in _translated(model, at, details)]
        raise ConfigFileError(sorted(errors, key=lambda error: _line_and_column(error.where))) from invalid
    except TypeError as error:  # a number beyond 64 bits
        raise ConfigError(str(path), "", str(error)) from error


def first_fault(invalid: ValidationError) -> str:
    """Return the first finding of pydantic about data that have no lines: the key, and what is wrong."""
    first = invalid.errors(include_url=False)[0]
    key = ".".join(map(str, first["loc"]))
    return f"{key}: {first['msg'].removeprefix(_VALUE_ERROR)}".removeprefix(": ")


def _line_and_column(where: str) -> tuple[int, int]:
    _, line, column = where.rsplit(":", 2)
    return int(line), int(column)


def _translated(model: type[Section], source: YamlSource, details: list[ErrorDetails]) -> Iterator[ConfigError]:
    """Yield pydantic's findings in our words; findings about each member of a union become one error."""
    wrong_kind: dict[KeyPath, tuple[list[str], object]] = {}
    for detail in details:
        key = tuple(detail["loc"])
        message = detail["msg"]
        if detail["type"] == "missing":
            yield source.error(key, "required, but not there")
        elif detail["type"] == "extra_forbidden":
            yield source.error(_shown(source, key), _unknown_key(_section_at(model, key[:-1]), key[-1]), at_key=True)
        elif message.startswith(_SHOULD_BE):
            wanted = message.removeprefix(_SHOULD_BE).removeprefix("a valid ")
            wrong_kind.setdefault(_shown(source, key), ([], detail["input"]))[0].append(_WORDS.get(wanted, wanted))
        else:
            yield source.error(_shown(source, key), message.removeprefix(_VALUE_ERROR))
    for key, (wanted_each, found) in wrong_kind.items():
        instead = f", not {found!r}" if isinstance(found, str | int | float | None) else ""
        yield source.error(key, f"expected {' or '.join(wanted_each)}{instead}")


def _unknown_key(section: type[Section], key: str | int) -> str:
    """Return the error for a key that is not in the section."""
    new_name = section.renamed.get(str(key))
    if new_name is not None:
        return f"this key is now called {new_name}"
    return f"unknown key; expected one of {', '.join(_keys_of(section))}"


def _shown(source: YamlSource, key: KeyPath) -> KeyPath:
    """Remove what pydantic appends to a path for its own purposes, such as the member of a union."""
    while key and key not in source.values:
        key = key[:-1]
    return key


def _section_at(model: type[Section], key: KeyPath) -> type[Section]:
    """Return the model of the mapping at this path, which validation has already visited."""
    for part in key:
        for name, field in model.model_fields.items():
            if part == (field.alias or name):
                model = next(_sections_in(field.annotation), model)
    return model


def _sections_in(annotation: object) -> Iterator[type[Section]]:
    if isinstance(annotation, type) and issubclass(annotation, Section):
        yield annotation
    for inner in get_args(annotation):
        yield from _sections_in(inner)


def _keys_of(model: type[Section]) -> list[str]:
    return [field.alias or name for name, field in model.model_fields.items()]
