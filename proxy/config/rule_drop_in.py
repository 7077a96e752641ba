"""Drop-in ``gdp-rule.yaml``: rules and denied names that ``gdp rule`` added.

I/O; replaces that one file. ``proxy.yaml`` with its comments never changes. A change is kept only if the configuration
as a whole is accepted, and if the running proxy takes it.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal, TypeAlias

from gdp.config.drop_in import drop_in_directory, locked, read_drop_in, write_drop_in
from gdp.config.yaml_source import Plain, read_yaml
from gdp.errors import GdpError, LocalError
from gdp.sharing.proxy_files import ProxyFiles
from proxy.config.config import ProxyConfig

RuleList: TypeAlias = Literal["expose", "import", "deny"]
RULE_LISTS: Final[tuple[RuleList, ...]] = ("expose", "import", "deny")
_FILE: Final = "gdp-rule.yaml"
_HEAD: Final = "# Rules of 'gdp rule add'; 'gdp rule remove' takes them away.\n"


@dataclass(frozen=True, slots=True)
class ListedRule:
    """One rule, or one denied name, of the configuration.

    Args:
        keys: of the rule, as its file has them; of a denied name ``name`` alone.
        where: ``file:line:column``.
        is_own: whether ``gdp rule`` added it, and may remove it.
    """

    side: RuleList
    keys: Mapping[str, Plain]
    where: str
    is_own: bool

    def is_about(self, side: RuleList, kind: str, name: str) -> bool:
        """Return whether it is the rule of this list for exactly this name or pattern."""
        return (self.side, self.keys.get("name")) == (side, name) and kind in ("", self.keys.get("kind", "topic"))


class RuleDropIn:
    """The drop-in of ``gdp rule`` of one proxy; ``path``: of ``proxy.yaml``."""

    def __init__(self, path: Path) -> None:
        self._path = path.absolute()
        self._file = drop_in_directory(self._path) / _FILE

    def rules(self) -> list[ListedRule]:
        """Return all rules and denied names, those of ``proxy.yaml`` first.

        Raises:
            ConfigError: a file is not YAML.
        """
        drop_ins = sorted(drop_in_directory(self._path).glob("[!.]*.yaml"))
        return [each for file in (self._path, *drop_ins) for each in self._listed(file)]

    def add(self, side: RuleList, keys: Mapping[str, Plain]) -> bool:
        """Add a rule; return whether a running proxy carries it now.

        Args:
            keys: as in a rule; paths in it start at the folder of the drop-in. Of a denied name ``name`` alone.

        Raises:
            LocalError: there is such a rule, or the proxy refuses it; nothing has changed.
        """
        kind, name = str(keys.get("kind", "topic")), str(keys["name"])
        with locked(self._path):
            for each in self.rules():
                if each.is_about(side, "" if side == "deny" else kind, name):
                    raise LocalError(f"{each.where}: {side} {name} is there already; remove it first")
            return self._replace([*self._own(), ListedRule(side, keys, str(self._file), is_own=True)])

    def remove(self, side: RuleList, kind: str, name: str) -> bool:
        """Remove a rule that ``add`` made; return whether a running proxy applies it now.

        Args:
            kind: empty: any.

        Raises:
            LocalError: there is none, there are several, it stands in another file, or the proxy refuses.
        """
        with locked(self._path):
            found = [each for each in self.rules() if each.is_about(side, kind, name)]
            own = [each for each in found if each.is_own]
            if found and not own:
                raise LocalError(f"{found[0].where}: {side} {name} was not added by 'gdp rule'; edit that file")
            if not own:
                stated = sorted({str(each.keys.get("name")) for each in self._own() if each.side == side})
                raise LocalError(f"no rule {side} {name}; 'gdp rule add' made: {', '.join(stated) or 'none'}")
            if len(own) > 1:
                kinds = ", ".join(str(each.keys.get("kind", "topic")) for each in own)
                raise LocalError(f"several rules {side} {name}; say which with --kind: {kinds}")
            return self._replace([each for each in self._own() if each != own[0]])

    def _own(self) -> list[ListedRule]:
        return list(self._listed(self._file)) if self._file.exists() else []

    def _listed(self, file: Path) -> Iterator[ListedRule]:
        source = read_yaml(file)
        data = source.data if isinstance(source.data, dict) else {}
        for side in RULE_LISTS:
            listed = data.get(side)
            for index, each in enumerate(listed if isinstance(listed, list) else []):
                line, column = source.values[side, index]
                keys = each if isinstance(each, dict) else {"name": each}
                yield ListedRule(side, keys, f"{file}:{line}:{column}", is_own=file == self._file)

    def _replace(self, rules: Sequence[ListedRule]) -> bool:
        """Write the rules; restore the earlier ones unless the configuration and the running proxy take them."""
        before = read_drop_in(self._file)
        write_drop_in(self._path, _FILE, _text(rules))
        try:
            ProxyConfig.load(self._path)
            return ProxyFiles.read(self._path).reload()
        except GdpError:
            write_drop_in(self._path, _FILE, before)
            raise


def _text(rules: Sequence[ListedRule]) -> str | None:
    """Return the content of the file; None without a rule."""
    lines = [_HEAD] if rules else []
    for side in RULE_LISTS:
        own = [each for each in rules if each.side == side]
        lines += [f"{side}:\n"] if own else []
        lines += [f"- {json.dumps(each.keys['name'] if side == 'deny' else each.keys)}\n" for each in own]
    return "".join(lines) or None
