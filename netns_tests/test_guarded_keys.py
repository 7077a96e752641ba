"""Commands with keys in a token and under a passphrase: they start, drop their privileges, and continue to sign."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

pytest.importorskip("gdp_extensions.pkcs11")

from gdp.crypto.certificates import Role
from gdp.stores.issue import admit_node, make_node_keys
from gdp.stores.keyring import store_again
from gdp_extensions.pkcs11.token import generate_token_key
from lab.machine import LabMachine
from lab.namespaces import Space
from netns_tests.test_rights import end, nodes
from tests.gdp_extensions.pkcs11.tokens import PIN, soft_token

__all__ = ["nodes"]

pytestmark = [
    pytest.mark.netns,
    pytest.mark.momentary("about how keys are opened, no lease matters"),
    pytest.mark.skipif(os.geteuid() != 0, reason="only root has capabilities to give away"),
]


def test_a_switch_signs_with_its_token_and_a_rib_with_a_key_under_a_passphrase(
    nodes: LabMachine, space: Space, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("GDP_PASSPHRASE", PIN)
    with soft_token(tmp_path / "token", monkeypatch) as token:
        key = generate_token_key(token.uri("switch"))
        make_node_keys(tmp_path / "switch", Role.SWITCH, "lab", key=key, passphrase=PIN.encode(), force=True)
        admit_node(tmp_path / "domain", tmp_path / "switch", force=True)
        store_again(tmp_path / "rib", PIN.encode())
        with (tmp_path / "switch.yaml").open("a") as file:
            file.write("token_folders: [token]\n")
        switch = nodes.start("switch", "switch", "--data-plane", "raw")
        rib = nodes.start("rib", "rib", "--await-iface", "30")
        switch.until_logged("neighbour up port=rib0-s role=rib")
        assert "node.key=token kem.key=passphrase" in switch.logged
        assert "node.key=passphrase kem.key=passphrase" in rib.logged
        assert (end(switch), end(rib)) == (0, 0)
        monkeypatch.setenv("GDP_PASSPHRASE", "another")
        refused = nodes.launch_node("rib", "rib", "--check")
        said = refused.reap()
        assert refused.code == 2
        assert "rib/node.key: does not open: a wrong passphrase" in said + refused.logged
