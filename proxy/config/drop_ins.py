"""Drop-in directory of a proxy: further rules in files of their own.

I/O; reads files. ``proxy.yaml.d`` lies in the folder of ``proxy.yaml``. Its files ``*.yaml`` are read in the order of
their names, and their lists ``expose``, ``import`` and ``deny`` are appended to those of ``proxy.yaml``. A drop-in has
no other keys, and its relative paths start at its own folder. Programs that manage rules, such as ``fog``, write a file
there and leave ``proxy.yaml`` alone.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final

from pydantic import Field, ValidationInfo

from gdp.config.drop_in import drop_in_directory
from gdp.config.schema import Section, load
from gdp.config.yaml_source import KeyPath, YamlSource, read_yaml
from gdp.errors import ConfigError
from proxy.config.rule import NamePatterns, Rule

DROP_INS: Final = "drop_ins"  # key of the validation context
_FILES_MAX: Final = 1_000


class DropIn(Section):
    """One file of a drop-in directory."""

    expose: tuple[Rule, ...] = Field(default=(), description="Rules for what leaves this machine.")
    imports: tuple[Rule, ...] = Field(default=(), alias="import", description="Rules for what comes from elsewhere.")
    deny: NamePatterns = Field(default=(), description="Names, and patterns of such, that never cross.")

    def rules(self, side: str) -> tuple[Rule, ...]:
        """Return the rules of ``expose`` or ``import``."""
        return self.expose if side == "expose" else self.imports


@dataclass(frozen=True, slots=True)
class DropIns:
    """The drop-in files of one proxy, in the order in which their rules are appended."""

    files: tuple[tuple[Path, DropIn], ...] = ()

    @classmethod
    def load(cls, path: Path) -> DropIns:
        """Read the drop-in files of the configuration at ``path``; without a directory there are none.

        Raises:
            ConfigError: every error of the first wrong file, each with line and column; or the directory is unreadable.
        """
        directory = drop_in_directory(path)
        try:
            files = sorted(each for each in directory.iterdir() if each.suffix == ".yaml" and each.name[0] != ".")
        except FileNotFoundError:
            return cls()
        except OSError as error:
            raise ConfigError(str(directory), "", f"a readable directory is expected: {error.strerror}") from error
        if len(files) > _FILES_MAX:
            raise ConfigError(str(directory), "", f"at most {_FILES_MAX} files are expected")
        return cls(tuple((file, load(DropIn, file)) for file in files))

    def rules(self, side: str) -> tuple[Rule, ...]:
        """Return the rules of ``expose`` or ``import``, in the order of the files."""
        return tuple(rule for _, drop_in in self.files for rule in drop_in.rules(side))

    def locate(self, main: YamlSource, key: KeyPath) -> tuple[YamlSource, KeyPath]:
        """Return the file that a key of the joined configuration comes from, and the key there."""
        if len(key) < 2 or key[0] not in ("expose", "import", "deny") or not isinstance(key[1], int):
            return main, key
        side, index = str(key[0]), key[1]
        own = main.data.get(side) if isinstance(main.data, dict) else None
        index -= len(own) if isinstance(own, list) else 0
        if index < 0:
            return main, key
        for file, drop_in in self.files:
            count = len(drop_in.deny if side == "deny" else drop_in.rules(side))
            if index < count:
                return read_yaml(file), (side, index, *key[2:])
            index -= count
        return main, key


def add_drop_in_rules(rules: tuple[Rule, ...], info: ValidationInfo) -> tuple[Rule, ...]:
    """Append the rules of drop-in files, and apply ``prefix`` and ``deny``; validates ``expose`` and ``import``."""
    added = _drop_ins(info).rules("expose" if info.field_name == "expose" else "import")
    prefix, denied = info.data.get("prefix"), info.data.get("deny", ())
    return tuple(rule.within(prefix, denied) for rule in rules + added)


def add_drop_in_patterns(patterns: tuple[str, ...], info: ValidationInfo) -> tuple[str, ...]:
    """Append the patterns of drop-in files to those of ``proxy.yaml``; a validator of ``deny``."""
    return patterns + tuple(pattern for _, drop_in in _drop_ins(info).files for pattern in drop_in.deny)


def _drop_ins(info: ValidationInfo) -> DropIns:
    found = info.context.get(DROP_INS) if isinstance(info.context, dict) else None
    return found if isinstance(found, DropIns) else DropIns()
