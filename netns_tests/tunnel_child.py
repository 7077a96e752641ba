"""Owner of a tunnel device in a child process, confined as a switch is.

python -m netns_tests.tunnel_child CONFIG IFNAME PRIVATE_KEY INNER ALIAS

It opens the device, confines itself, and prints a JSON line with its state. Then each line of standard input is a JSON
list: a command and its arguments. It prints a JSON line with the result, or with ``error``.
"""

from __future__ import annotations

import json
import selectors
import subprocess
import sys
from pathlib import Path

from gdp.config.config import SwitchConfig
from gdp.control.endpoints import Endpoint
from gdp.errors import LocalError
from gdp.nodes.rights import confine_switch
from gdp.ports.tunnel.path_mtu import route_mtu
from gdp.ports.tunnel.vxlan import make_vxlan, remove_link, set_link_mtu
from gdp.ports.tunnel.wireguard import WireGuardDevice, open_wireguard


def main() -> None:
    """Serve commands until standard input ends."""
    config, ifname, private_key, inner, alias = sys.argv[1:]
    device = open_wireguard(
        ifname=ifname,
        private_key=bytes.fromhex(private_key),
        listen_port=0,
        inner=inner,
        mtu=1440,
        alias=alias,
        backend="wireguard-go",
    )
    confine_switch(SwitchConfig.load(Path(config)), "raw")
    try:
        subprocess.run(["/bin/true"], check=True)
    except OSError as error:
        say(confined=str(error), port=device.listen_port)
    with selectors.DefaultSelector() as selector:
        selector.register(sys.stdin, selectors.EVENT_READ)
        selector.register(device, selectors.EVENT_READ)
        while True:
            for key, _ in selector.select():
                if key.fileobj is device:
                    device.handle_events()
                    say(event=[len(device.peers())])
                    continue
                line = sys.stdin.readline()
                if not line:
                    device.close()
                    return
                try:
                    say(result=act(device, alias, *json.loads(line)))
                except LocalError as error:
                    say(error=str(error))


def act(device: WireGuardDevice, alias: str, command: str, *words: str) -> object:
    """Run one command."""
    match command:
        case "set_peer":
            key, inner, address, port = words
            endpoint = Endpoint(address, int(port)) if address else None
            device.set_peer(bytes.fromhex(key), inner=inner, endpoint=endpoint, keepalive_s=25)
        case "remove_peer":
            device.remove_peer(bytes.fromhex(words[0]))
        case "retry":
            device.retry_handshake(bytes.fromhex(words[0]))
        case "peers":
            return {key.hex(): state.handshake_unix_s for key, state in device.peers().items()}
        case "link":
            ifname, local, remote = words
            make_vxlan(ifname=ifname, vni=77, local=local, remote=remote, underlay=device.ifname, mtu=1370, alias=alias)
        case "unlink":
            remove_link(words[0], alias)
        case "mtu":
            device.set_mtu(int(words[1]))
            set_link_mtu(words[0], int(words[1]) - 70)
        case "route":
            return route_mtu(Endpoint(words[0], int(words[1])))
    return None


def say(**fields: object) -> None:
    """Print one JSON line."""
    print(json.dumps(fields), flush=True)


if __name__ == "__main__":
    main()
