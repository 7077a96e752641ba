"""Command ``gdp delegate rules``: an owner gives proxies the delegations that the rules of their files need.

I/O; ``gdp`` starts it, since the package ``gdp`` does not know ``proxy``. ``gdp-delegate`` is ``gdp delegate``.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from gdp.cli import delegate as group
from gdp.cli.node import Json, failing_clearly, report
from gdp.cli.program import Program
from gdp.config.yaml_source import read_yaml
from gdp.crypto.keys import PublicKey
from gdp.errors import LocalError
from gdp.stores.issue import DELEGATION_DAYS, valid_delegation, widened
from gdp.stores.keyring import CARD, OWNER_PUBLIC, load_card, load_delegations, load_owner, save_delegation
from gdp.terminal import echo
from gdp.trust.node_descriptor import NodeDescriptor
from proxy.check.core.required_delegations import Machine, RequiredDelegation, needs, unmet
from proxy.check.graph_snapshot import read_graphs
from proxy.config.config import ProxyConfig
from proxy.endpoints.core.endpoint import Graph

Files = Annotated[list[Path], typer.Argument(metavar="FILE...", help="the proxy.yaml of each machine")]
OwnerDir = Annotated[Path, typer.Option("--owner", metavar="DIR", help="the owner's directory")]
Live = Annotated[bool, typer.Option("--live", help="for patterns and missing types: what the first file's ROS has now")]
Days = Annotated[float, typer.Option("--days", min=0.001, help="how long a delegation is valid")]
Renew = Annotated[bool, typer.Option("--renew", help="make those again that are there")]

app = Program("gdp delegate rules")


@app.command(
    epilog="Examples: gdp delegate rules --owner owner --live robot/proxy.yaml;"
    " gdp delegate --owner owner robot/proxy.yaml",
)
def delegate_what_is_needed(
    files: Files,
    owner: OwnerDir,
    live: Live = False,
    days: Days = DELEGATION_DAYS,
    renew: Renew = False,
    json: Json = False,
) -> None:
    """Give each proxy the delegations to publish, read, serve or call that its rules need; valid ones are kept."""
    with failing_clearly():
        key = load_owner(owner).public
        configs = [ProxyConfig.load(file) for file in files]
        _refuse_other_owners(owner, key, files, configs)
        cards = [load_card(config.identity / CARD) for config in configs]
        machines = [
            Machine(config, load_delegations(config.delegations), _graphs(config, card) if live and not index else ())
            for index, (config, card) in enumerate(zip(configs, cards, strict=True))
        ]
        for file, machine, card, found in zip(files, machines, cards, needs(machines, key), strict=True):
            for need in found:
                held = valid_delegation(machine.held, card, need.name, time.time())
                is_new = renew or held is None or not need.rights <= held.rights
                if is_new:
                    made = widened(owner, card, need.metadata, need.rights, held, days=days)
                    save_delegation(machine.config.delegations, made, force=True)
                _tell(file, need, is_new=is_new, json=json)
            for rule in unmet([*machine.config.expose, *machine.config.imports], key, found):
                echo(f"{file}: {rule.name}: nothing is known yet that it means; try --live", err=True)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command with arguments; without, run ``gdp delegate`` with those of this process as ``gdp-delegate``."""
    if arguments is None:
        group.main()
    else:
        app.run(arguments)


def _refuse_other_owners(owner: Path, key: PublicKey, files: Sequence[Path], configs: Sequence[ProxyConfig]) -> None:
    """Refuse to delegate if no rule is of this owner; warn of a single file if other files have such rules."""
    missing = [
        f"no rule of {file} names this owner ({owner / OWNER_PUBLIC}); {_owners_named(file)}"
        for file, config in zip(files, configs, strict=True)
        if all(rule.owner.compressed != key.compressed for rule in (*config.expose, *config.imports))
    ]
    if len(missing) == len(files):
        raise LocalError("\n".join(missing))
    for text in missing:
        echo(text, err=True)


def _owners_named(file: Path) -> str:
    """Return the owners that a file's rules name, as the file writes them."""
    read = read_yaml(file).data
    data = read if isinstance(read, dict) else {}
    sides = [data.get(side) for side in ("expose", "import")]
    rules = [rule for side in sides if isinstance(side, list) for rule in side if isinstance(rule, dict)]
    named = dict.fromkeys(str(rule.get("owner") or data.get("owner")) for rule in rules)
    return f"they name {', '.join(str(file.parent / each) for each in named)}" if named else "it has no rules"


def _graphs(config: ProxyConfig, card: NodeDescriptor) -> list[Graph]:
    return [graph for _, graph in read_graphs(config.ros, card.name.to_text(), "delegate")]


def _tell(file: Path, need: RequiredDelegation, *, is_new: bool, json: bool) -> None:
    rights = sorted(right.value for right in need.rights)
    fields = {"name": need.name.to_text(), "rights": rights, "metadata": dict(need.metadata)}
    kind, name, type_name = (need.metadata[key] for key in ("kind", "name", "type"))
    text = f"{file}: {'+' if is_new else '='} {', '.join(rights)} {kind} {name} [{type_name}]"
    report("delegated" if is_new else "held", text, json=json, file=str(file), **fields)


if __name__ == "__main__":
    main()
