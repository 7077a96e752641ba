"""YAML source: a file as plain data with the position of each value.

I/O; reads the one file that it is given and changes nothing.
Source: YAML 1.2, core schema (section 10.3) for the meaning of an unquoted word: ``yes``, ``0x10:20`` or a date stay
text, as in every other modern reader. Anchors and tags are refused: a configuration states each value in its place.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, TypeAlias

import yaml

from gdp.errors import ConfigError
from gdp.stores.files import read_at_most

Plain: TypeAlias = "bool | int | float | str | list[Plain] | dict[str, Plain] | None"
KeyPath: TypeAlias = "tuple[str | int, ...]"
Mark: TypeAlias = "tuple[int, int]"  # line and column, both from 1

# libyaml, if PyYAML has it: for 8 KiB of brackets the reader in Python takes 0.3 s, and more than linear time
LOADER: Final[Any] = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
_FILE_MAX_BYTES: Final = 1 << 20
_DEPTH_MAX: Final = 32
_NULL: Final = re.compile(r"(?:~|null|Null|NULL|)\Z")
_BOOL: Final = {"true": True, "True": True, "TRUE": True, "false": False, "False": False, "FALSE": False}
_INT: Final = re.compile(r"[-+]?[0-9]+\Z")
_OTHER_INT: Final = re.compile(r"0(?:x[0-9a-fA-F]+|o[0-7]+)\Z")
_FLOAT: Final = re.compile(r"[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?\Z")


class ConfigFileError(ConfigError):
    """All errors of one file, in the order of the file; as text one line per error.

    Args:
        errors: at least one.
    """

    def __init__(self, errors: Sequence[ConfigError]) -> None:
        first = errors[0]
        super().__init__(first.where, first.key, first.expected)
        self.errors = tuple(errors)

    def __str__(self) -> str:
        return "\n".join(str(error) for error in self.errors)


@dataclass(frozen=True, slots=True)
class YamlSource:
    """The data of a file, and the positions of its keys and values."""

    path: Path
    data: Plain
    keys: Mapping[KeyPath, Mark]
    values: Mapping[KeyPath, Mark]

    def error(self, key: KeyPath, expected: str, *, at_key: bool = False) -> ConfigError:
        """Return the error about ``key``, at its position or, if it is missing, at that of its parent."""
        known = key
        while known not in self.values:
            known = known[:-1]
        mark = self.keys.get(known, self.values[known]) if at_key else self.values[known]
        return ConfigError(f"{self.path}:{mark[0]}:{mark[1]}", dotted(key), expected)


def dotted(key: KeyPath) -> str:
    """Return a path of keys in the usual notation, such as ``expose[0].type``."""
    text = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in key)
    return text.removeprefix(".")


def read_yaml(path: Path) -> YamlSource:
    """Read one YAML document.

    Raises:
        ConfigError: the file is missing, not UTF-8, too large or too deep, not YAML, or has a duplicate key, an anchor
            or a tag.
    """
    try:
        with path.open("rb") as file:
            raw = read_at_most(file, _FILE_MAX_BYTES)
    except OSError as error:
        raise ConfigError(str(path), "", f"a readable file is expected: {error.strerror}") from error
    if len(raw) > _FILE_MAX_BYTES:
        raise ConfigError(str(path), "", f"a configuration has at most {_FILE_MAX_BYTES} bytes")
    try:
        return _Reader(path).read(raw.decode())
    except UnicodeDecodeError as error:
        line = raw.count(b"\n", 0, error.start) + 1
        raise ConfigError(f"{path}:{line}", "", "UTF-8 text is expected") from error
    except yaml.reader.ReaderError as error:
        raise ConfigError(str(path), "", f"text is expected, not the character {_char(error.character)!r}") from error
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        where = f"{path}:{mark.line + 1}:{mark.column + 1}" if mark else str(path)
        raise ConfigError(where, "", f"YAML is expected: {error.problem or error.context}") from error


class _Reader:
    """Converter of the node tree of one file into data and marks."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._keys: dict[KeyPath, Mark] = {}
        self._values: dict[KeyPath, Mark] = {}

    def read(self, text: str) -> YamlSource:
        """Return the data of the file, with the marks stored."""
        loader = LOADER(text)
        try:
            self._refuse_anchors(text)
            node = loader.get_single_node()
        finally:
            loader.dispose()
        if node is None:
            self._values[()] = (1, 1)
            data: Plain = {}
        else:
            data = self._plain(node, ())
        return YamlSource(self._path, data, self._keys, self._values)

    def _refuse_anchors(self, text: str) -> None:
        """Check the events first, which avoids composing a deep or self-containing tree."""
        depth = 0
        for event in yaml.parse(text, Loader=LOADER):
            depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
            mark = _mark(event)
            if isinstance(event, yaml.AliasEvent) or (isinstance(event, yaml.NodeEvent) and event.anchor):
                raise self._error(mark, (), "anchors and aliases are not accepted")
            if isinstance(event, yaml.ScalarEvent | yaml.CollectionStartEvent) and event.tag:
                raise self._error(mark, (), f"tags such as {event.tag} are not accepted")
            if depth > _DEPTH_MAX:
                raise self._error(mark, (), f"nested deeper than {_DEPTH_MAX}")

    def _plain(self, node: yaml.Node, at: KeyPath) -> Plain:
        self._values[at] = _mark(node)
        if isinstance(node, yaml.MappingNode):
            return self._mapping(node, at)
        if isinstance(node, yaml.SequenceNode):
            return [self._plain(item, (*at, index)) for index, item in enumerate(node.value)]
        text = str(node.value)
        return _scalar(text) if isinstance(node, yaml.ScalarNode) and not node.style else text

    def _mapping(self, node: yaml.MappingNode, at: KeyPath) -> dict[str, Plain]:
        result: dict[str, Plain] = {}
        for key_node, value_node in node.value:
            mark = _mark(key_node)
            if not isinstance(key_node, yaml.ScalarNode):
                raise self._error(mark, at, "a key is a text")
            key = str(key_node.value)
            path = (*at, key)
            if key in result:
                raise self._error(mark, path, f"stands twice; first in line {self._keys[path][0]}")
            self._keys[path] = mark
            result[key] = self._plain(value_node, path)
        return result

    def _error(self, mark: Mark, key: KeyPath, expected: str) -> ConfigError:
        return ConfigError(f"{self._path}:{mark[0]}:{mark[1]}", dotted(key), expected)


def _mark(node: yaml.Node | yaml.Event) -> Mark:
    mark = node.start_mark
    return (mark.line + 1, mark.column + 1) if mark else (1, 1)


def _char(character: int | str | bytes) -> str | bytes:
    """Return the character that an error concerns; libyaml gives its number."""
    return chr(character) if isinstance(character, int) else character


def _scalar(text: str) -> Plain:
    """Convert an unquoted word; a word that is not null, a boolean or a number is text."""
    if _NULL.match(text):
        return None
    if text in _BOOL:
        return _BOOL[text]
    if _INT.match(text):
        return int(text) if len(text) <= 20 else text  # longer than any 64-bit number
    if _OTHER_INT.match(text):
        return int(text, 0)
    if _FLOAT.match(text):
        return float(text)
    return text
