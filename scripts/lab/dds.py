"""Environment of ROS processes in namespaces: Fast DDS over UDP or shared memory, with buffers for a camera image.

I/O. Writes a profile.
"""

from __future__ import annotations

from pathlib import Path
from typing import Final

BUFFER_BYTES: Final = 4 << 20  # of a socket, and of a segment of shared memory: both hold a camera image
_UDP: Final = f"""<transport_descriptor>
  <transport_id>udp</transport_id><type>UDPv4</type>
  <sendBufferSize>{BUFFER_BYTES}</sendBufferSize><receiveBufferSize>{BUFFER_BYTES}</receiveBufferSize>
 </transport_descriptor>"""
_SHM: Final = f"""<transport_descriptor>
  <transport_id>shm</transport_id><type>SHM</type><segment_size>{BUFFER_BYTES}</segment_size>
 </transport_descriptor>"""
_PROFILE: Final = """<?xml version="1.0" encoding="UTF-8" ?>
<dds xmlns="http://www.eprosima.com"><profiles>
 <transport_descriptors>{descriptors}</transport_descriptors>
 <participant profile_name="participant" is_default_profile="true"><rtps>
  <userTransports>{transports}</userTransports><useBuiltinTransports>false</useBuiltinTransports>
 </rtps></participant>
</profiles></dds>
"""
UDP_PROFILE: Final = _PROFILE.format(descriptors=_UDP, transports="<transport_id>udp</transport_id>")


def ros_environment(folder: Path, domain: int, *, shared_memory: bool = False) -> list[str]:
    """Return the environment of a ROS process, as ``KEY=value``.

    The discovery range is ``SUBNET``, and the namespaces confine: ``LOCALHOST`` would change the transports.

    Args:
        folder: where the profile is written.
        shared_memory: whether processes of one machine use it; they use UDP otherwise.
    """
    profile = folder / f"dds-{'shm' if shared_memory else 'udp'}.xml"
    transports = "<transport_id>shm</transport_id><transport_id>udp</transport_id>"
    text = _PROFILE.format(descriptors=_SHM + _UDP, transports=transports) if shared_memory else UDP_PROFILE
    profile.write_text(text, encoding="utf-8")
    return [
        f"ROS_DOMAIN_ID={domain}",
        "ROS_AUTOMATIC_DISCOVERY_RANGE=SUBNET",
        "RMW_IMPLEMENTATION=rmw_fastrtps_cpp",
        f"FASTRTPS_DEFAULT_PROFILES_FILE={profile}",  # its name before Fast DDS 3
        f"FASTDDS_DEFAULT_PROFILES_FILE={profile}",
    ]
