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


def udp_profile(folder: Path) -> Path:
    """Return the file of the profile without shared memory, which ``ros_environment`` writes."""
    return folder / "dds-udp.xml"


def ros_environment(folder: Path, domain: int, *, shared_memory: bool = False) -> list[str]:
    """Return the environment of a ROS process, as ``KEY=value``.

    The discovery range is ``SUBNET``, and the namespaces confine: ``LOCALHOST`` would change the transports. Shared
    memory crosses the network namespaces of a machine.

    Args:
        folder: where the profile is written.
        shared_memory: whether processes of one machine use it; they use UDP otherwise.
    """
    profile = folder / "dds-shm.xml" if shared_memory else udp_profile(folder)
    used = {"shm": _SHM, "udp": _UDP} if shared_memory else {"udp": _UDP}
    transports = "".join(f"<transport_id>{each}</transport_id>" for each in used)
    profile.write_text(_PROFILE.format(descriptors="".join(used.values()), transports=transports), encoding="utf-8")
    return [
        f"ROS_DOMAIN_ID={domain}",
        "ROS_AUTOMATIC_DISCOVERY_RANGE=SUBNET",
        "ROS_LOCALHOST_ONLY=",
        "ROS_STATIC_PEERS=",
        "RMW_IMPLEMENTATION=rmw_fastrtps_cpp",
        f"FASTRTPS_DEFAULT_PROFILES_FILE={profile}",  # its name before Fast DDS 3
        f"FASTDDS_DEFAULT_PROFILES_FILE={profile}",
    ]
