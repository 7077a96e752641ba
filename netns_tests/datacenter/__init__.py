"""Data centre of namespaces: machines that boot a minimal Debian with cloud-init, behind a NAT, for a simulated EC2.

``debian_root``: the image; ``machine``: one booted machine; ``router``: addresses, NAT and firewall;
``metadata_service``: 169.254.169.254; ``ec2``: the connection to moto.
"""
