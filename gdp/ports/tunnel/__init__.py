"""Tunnels: WireGuard devices, VXLAN devices in them, and the MTU that they leave."""
