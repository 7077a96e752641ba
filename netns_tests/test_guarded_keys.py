"""Commands with keys in a token and under a passphrase: they start, drop their privileges, and continue to sign."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from gdp.crypto.certificates import Role
from gdp.stores.issue import admit_node, make_node_keys
from gdp.stores.keyring import store_again
from gdp.stores.token import generate_token_key
from netns_tests.spaces import Space
from netns_tests.test_rights import Commands, commands
from tests.gdp.stores.tokens import PIN, soft_token

__all__ = ["commands"]

pytestmark = [
    pytest.mark.netns,
    pytest.mark.momentary("about how keys are opened, no lease matters"),
    pytest.mark.skipif(os.geteuid() != 0, reason="only root has capabilities to give away"),
]


def test_a_switch_signs_with_its_token_and_a_rib_with_a_key_under_a_passphrase(
    commands: Commands, space: Space, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("GDP_PASSPHRASE", PIN)
    with soft_token(tmp_path / "token", monkeypatch) as token:
        key = generate_token_key(token.uri("switch"))
        make_node_keys(tmp_path / "switch", Role.SWITCH, "lab", key=key, passphrase=PIN.encode(), force=True)
        admit_node(tmp_path / "lab", tmp_path / "switch", force=True)
        store_again(tmp_path / "rib", PIN.encode())
        with (tmp_path / "switch.yaml").open("a") as file:
            file.write("token_folders: [token]\n")
        switch = commands.start("gdp.cli.switch", "switch", "--data-plane", "raw")
        switch.until('"ready"')
        rib = commands.start("gdp.cli.rib", "rib", "--await-iface", "30")
        rib.until('"ready"')
        switch.until("neighbour up port=rib0-s role=rib")
        assert "node.key=token kem.key=passphrase" in switch.log.read_text()
        assert "node.key=passphrase kem.key=passphrase" in rib.log.read_text()
        assert (switch.end(), rib.end()) == (0, 0)
        monkeypatch.setenv("GDP_PASSPHRASE", "another")
        refused = commands.start("gdp.cli.rib", "rib", "--check")
        assert refused.process.wait(60) == 2
        assert "rib/node.key: does not open: a wrong passphrase" in refused.log.read_text()
