"""Content of the pages: commands parse and run, examples load, links resolve, numbers equal the code's."""

from __future__ import annotations

import importlib
import os
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import typer
import yaml

import fleet_demo
from fog.cli.app import app as fog
from fog.launch.load import load as load_launch_file
from fog.site import SiteConfig
from fog_demo import cli as demo
from gdp.cli import gdp, relay, rib, switch
from gdp.config.config import RibConfig, SwitchConfig
from gdp.config.relay_config import RelayConfig
from gdp.config.schema import Section
from gdp.crypto.keys import SigningKey
from gdp.errors import ConfigError
from internet_demo import cli as internet_demo
from memory_demo import __main__ as memory_demo
from proxy.cli import delegate, proxy, replay
from proxy.config.config import ProxyConfig
from ring import cli as ring
from tests.machines import Machines
from tests.pages import PAGES, ROOT, Block, anchors, blocks, blocks_between, claims, commands, links, rows

README = ROOT / "README.md"
TWO_MACHINES = ROOT / "docs/tutorials/two-machines.md"
CONFIGURATION = ROOT / "docs/reference/configuration.md"
CREDENTIALS = ROOT / "docs/how-to/keys.md"
FOG = ROOT / "docs/reference/fog-yaml.md"
PROVIDERS = ROOT / "docs/reference/providers.md"

APPS = {
    "gdp": gdp.app,
    "gdp-switch": switch.app,
    "gdp-relay": relay.app,
    "gdp-rib": rib.app,
    "gdp-proxy": proxy.app,
    "gdp-delegate": delegate.app,
    "gdp-replay": replay.app,
    "fog": fog,
    "scripts/ring_topology.sh": ring.app,
    "scripts/fog_demo.sh": demo.app,
    "scripts/internet_demo.sh": internet_demo.app,
    "scripts/memory_demo.sh": memory_demo.app,
    "scripts/fleet_demo.sh": fleet_demo.app,
}
SHELLS = ("bash", "sh")
MODELS: dict[str, type[Section]] = {
    "switch.yaml": SwitchConfig,
    "relay.yaml": RelayConfig,
    "rib.yaml": RibConfig,
    "proxy.yaml": ProxyConfig,
}
NODES = ("gdp-switch ", "gdp-rib ", "gdp-proxy ")
UNITS = {"": 1, "s": 1, "ms": 0.001, "KiB": 1 << 10, "MiB": 1 << 20}
_LIMIT = re.compile(r"[a-z_.]*[A-Z][A-Z_]+(?:\.[a-z_]+)?")
_COMMON = ("gdp.limits", "gdp.intervals")  # have the names without a module


def _every_command() -> Iterator[Any]:
    for page in PAGES:
        for block in blocks(page):
            if block.language in SHELLS:
                for words in commands(block.lines):
                    yield pytest.param(words, id=f"{page.name}: {' '.join(words)[:60]}")
    for words in commands(sorted({text for claim in claims() for text, _ in claim.commands})):
        yield pytest.param(words, id=f"papers.md: {' '.join(words)[:60]}")


def _parse(command: Any, words: list[str]) -> None:
    """Parse a command line like the command, without running it."""
    program, *rest = words
    while hasattr(command, "commands"):
        if "rules" in command.commands and rest[0] not in command.commands:
            command = typer.main.get_command(APPS["gdp-delegate"])  # what gdp delegate does without a command
            break
        program, *rest = rest
        command = command.commands[program]
    command.make_context(program, rest)


def _spelled_out(words: list[str]) -> list[str]:
    """Return the arguments that a script hands to its Python."""
    match words[0]:
        case "scripts/ring_topology.sh":
            return list(ring.spelled_out(words))
        case "scripts/fog_demo.sh":
            return [words[0], str(ROOT / "examples/echo.launch.py"), *words[1:]]
    return words


@pytest.mark.parametrize("words", list(_every_command()))
def test_a_command_that_a_page_shows_is_understood(words: list[str]) -> None:
    if words[0] in APPS:
        _parse(typer.main.get_command(APPS[words[0]]), _spelled_out(words))
    else:
        assert os.access(ROOT / words[0], os.X_OK)


def test_a_command_that_is_not_understood_would_be_noticed() -> None:
    command = typer.main.get_command(APPS["gdp"])
    with pytest.raises(Exception, match="No such option"):
        _parse(command, ["gdp", "cert", "issue", "--domain", "lab", "--nod", "x"])


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_of_a_page_lead_somewhere(page: Path) -> None:
    for link in links(page):
        if link.startswith("https://"):
            continue
        path, _, anchor = link.partition("#")
        target = (page.parent / path).resolve() if path else page
        assert target.exists(), link
        assert not anchor or anchor in anchors(target), link


def test_scripts_that_a_page_names_exist() -> None:
    for page in PAGES:
        for path in re.findall(r"`(scripts/[\w/]+\.(?:py|sh))[` ]", page.read_text()):
            assert (ROOT / path).is_file(), path


def test_source_files_that_a_page_names_exist() -> None:
    text = "".join(page.read_text() for page in PAGES)
    for path in re.findall(r"`((?:gdp|proxy|fog|gdp_extensions)/[\w/]+\.py)`", text):
        assert (ROOT / path).is_file(), path


def _constant(dotted: str) -> float:
    module, name, attribute = re.fullmatch(r"([a-z_.]*?)\.?([A-Z_]+)\.?([a-z_]*)", dotted).groups()  # type: ignore[union-attr]
    places = [module if module.startswith(("proxy.", "ring.")) else f"gdp.{module}"] if module else _COMMON
    found: Any = next(getattr(each, name) for each in map(importlib.import_module, places) if hasattr(each, name))
    value: float = getattr(found, attribute) if attribute else found
    return value


def test_limits_that_a_page_states_are_the_limits() -> None:
    stated = [row for page in PAGES for row in rows(page.read_text()) if _LIMIT.fullmatch(row[0])]
    assert stated
    for name, text in stated:
        number, _, unit = text.replace(",", "").partition(" ")
        assert float(number) * UNITS[unit] == pytest.approx(_constant(name)), name


def _furnish(folder: Path, text: str) -> None:
    """Make the files and directories that an example names."""
    example = yaml.safe_load(text)
    domain = example["domain"]
    rules = [*example.get("expose", ()), *example.get("import", ())]
    owners = {rule.get("owner", example.get("owner")) for rule in rules}
    for file in [domain["root"], *domain.get("trusts", ()), *owners]:
        (folder / file).parent.mkdir(parents=True, exist_ok=True)
        (folder / file).write_bytes(SigningKey.generate().public.to_pem())
    for key in {"identity", "delegations", "revocations"} & example.keys():
        (folder / example[key]).mkdir(parents=True, exist_ok=True)
    if "peers" in (links := example.get("links", {})):
        (folder / links["peers"]).mkdir(parents=True, exist_ok=True)


def _every_example() -> Iterator[Any]:
    for page in PAGES:
        for block in blocks(page):
            if block.language == "yaml" and Path(block.title).name in MODELS:
                yield pytest.param(block, id=f"{page.name}: {block.title}")


@pytest.mark.parametrize("block", list(_every_example()))
def test_an_example_of_a_configuration_loads(block: Block, tmp_path: Path) -> None:
    _furnish(tmp_path, block.text)
    path = tmp_path / Path(block.title).name
    path.write_text(block.text)
    load: Callable[[Path], Section] = MODELS[path.name].load  # type: ignore[attr-defined]
    assert len(load(path).model_fields_set) >= len(yaml.safe_load(block.text))


def _every_launch_file() -> Iterator[Any]:
    for page in PAGES:
        for block in blocks(page):
            if block.language == "python" and "def generate_launch_description" in block.text:
                yield pytest.param(block, id=page.name)


@pytest.mark.parametrize("block", list(_every_launch_file()))
def test_a_launch_file_that_a_page_shows_comes_to_a_plan(block: Block, tmp_path: Path) -> None:
    path = tmp_path / "shown.launch.py"
    path.write_text(block.text)
    assert len(load_launch_file(path, {}).plan.machines) == 2


def test_examples_of_a_site_load(tmp_path: Path) -> None:
    (site,) = (block for block in blocks_between(FOG, "`fog.yaml`") if block.language == "yaml")
    shown = yaml.safe_load(site.text)
    for folder in (shown["domain"], shown["owner"]):
        (tmp_path / folder).mkdir(parents=True)
    for file in (*shown["robots"], shown["switch"]):
        (tmp_path / file).parent.mkdir(exist_ok=True)
        (tmp_path / file).touch()
    path = tmp_path / "fog.yaml"
    (tmp_path / "lab").mkdir()
    for text in ("", *(block.text for block in blocks(PROVIDERS) if block.language == "yaml")):
        stated = shown | (yaml.safe_load(text) or {})
        if "border" in stated:  # it takes the place of these
            others = ("domain", "owner", "robots", "switch", "watch")
            stated = {key: value for key, value in stated.items() if key not in others} | {"border": "lab"}
        path.write_text(yaml.safe_dump(stated))
        assert SiteConfig.load(path).model_fields_set == stated.keys()


def test_the_example_of_errors_is_what_is_printed(tmp_path: Path) -> None:
    shown = blocks_between(CONFIGURATION, "Errors")
    _furnish(tmp_path, shown[0].text)
    (tmp_path / "swich").rmdir()
    (tmp_path / "wrong.yaml").write_text(shown[0].text)
    with pytest.raises(ConfigError) as caught:
        SwitchConfig.load(tmp_path / "wrong.yaml")
    assert str(caught.value).replace(f"{tmp_path}/", "") == shown[1].text.rstrip()


def test_the_readme_has_the_one_command_of_the_tests_and_links_the_rules_for_a_change() -> None:
    section = README.read_text().partition("\n## Tests\n")[2].partition("\n## ")[0]
    assert "sudo scripts/test.sh\n" in section
    assert "(CONTRIBUTING.md)" in section
    assert "(CHANGELOG.md)" in section


def test_the_readme_has_at_most_130_lines() -> None:
    assert len(README.read_text().splitlines()) <= 130


@pytest.fixture(scope="module")
def machines(tmp_path_factory: pytest.TempPathFactory) -> Machines:
    """Two machines set up as in the tutorial."""
    two = Machines(tmp_path_factory.mktemp("machines"))
    for block in blocks(TWO_MACHINES):
        if block.language == "yaml":
            two.write(block)
        elif block.title:
            for line in block.lines:
                if line.startswith(NODES):
                    two.run(f"{line.removesuffix(' &')} --check", two.home_of(block))
                elif line.startswith(("gdp ", "for ", "cp ", "scp ", "sed ", "echo ")):
                    two.run(line, two.home_of(block))
    return two


def test_following_the_tutorial_makes_two_machines_whose_commands_accept_their_files(machines: Machines) -> None:
    checked = [line.split()[0] for line in machines.done if line.endswith("--check")]
    assert checked == ["gdp-switch", "gdp-rib", "gdp-switch", "gdp-proxy"]


def test_both_machines_of_the_tutorial_mean_the_same_name(machines: Machines) -> None:
    sent = machines.run("gdp-proxy --config robot/proxy.yaml --check --json", machines.robot)
    wanted = machines.run("gdp-proxy --config server/proxy.yaml --check --json", machines.server)
    assert re.findall(r'"overlay":"(\w{64})"', sent) == re.findall(r'"overlay":"(\w{64})"', wanted) != []


def test_the_commands_of_the_page_on_credentials_work_one_after_the_other(machines: Machines) -> None:
    for heading in ("Keys that stay where they were made", "New epochs", "Taking back"):
        for block in blocks_between(CREDENTIALS, heading):
            for line in block.lines:
                machines.run(line, machines.home_of(block))
    assert len(list((machines.robot / "revoked").iterdir())) == 2
