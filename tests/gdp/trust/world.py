"""Two domains, their nodes and an owner, for the tests of trust. Wall clock: ``NOW``, in unix seconds."""

from __future__ import annotations

from collections.abc import Sequence

from gdp.crypto.ca import CertificateAuthority
from gdp.crypto.certificates import Role
from gdp.crypto.identity import Identity, NodeKeys
from gdp.crypto.keys import SigningKey
from gdp.crypto.subject import Subject
from gdp.crypto.validity import Validity
from gdp.metadata import Metadata
from gdp.trust.adcert import AdCert
from gdp.trust.advertisement import UnverifiedAdvertisement
from gdp.trust.domain import Policy
from gdp.trust.node_descriptor import NodeDescriptor
from gdp.trust.owner import Owner
from gdp.trust.right import Right
from gdp.trust.rtcert import RtCert
from gdp.trust.verifier import AdvertisementVerifier

NOW = 1_800_000_000
DAY = Validity(NOW, NOW + 86_400)
HOUR = Validity(NOW, NOW + 3_600)
LATER = NOW + 10_000  # after the hour, within the day

SCHOOL = CertificateAuthority.create("school", SigningKey.generate(), DAY)
CLOUD = CertificateAuthority.create("cloud", SigningKey.generate(), DAY)
SWITCH = NodeKeys.generate(Role.SWITCH, "nuc1").join(SCHOOL, DAY)
ROBOT = NodeKeys.generate(Role.PROXY, "robot").join(SCHOOL, DAY)
GATEWAY = NodeKeys.generate(Role.PROXY, "gateway").join(SCHOOL, DAY)
STRANGER = NodeKeys.generate(Role.PROXY, "stranger").join(CLOUD, DAY)

LAB = Owner(SigningKey.generate(), bytes(range(32)))
CAMERA_METADATA = Metadata({"kind": "topic", "name": "/camera/image", "type": "sensor_msgs/msg/Image"})
CAMERA = LAB.subject(CAMERA_METADATA)


def card(node: Identity = ROBOT) -> NodeDescriptor:
    """Return a node's descriptor, verified."""
    return NodeDescriptor.from_wire(NodeDescriptor.make(node))


def adcert(
    node: Identity = ROBOT,
    rights: Sequence[Right] = (Right.PUBLISH,),
    *,
    subject: Subject = CAMERA,
    key: SigningKey = LAB.key,
    issuer: Identity | None = None,
    validity: Validity = DAY,
    may_delegate: bool = False,
) -> bytes:
    """Return an AdCert, by the owner unless ``issuer`` is given."""
    by, signing = (subject.name, key) if issuer is None else (issuer.name, issuer.key)
    return AdCert.make(signing, by, subject, node.subject, rights, validity, may_delegate=may_delegate)


def advertisement(
    node: Identity = ROBOT,
    right: Right = Right.PUBLISH,
    subject: Subject = CAMERA,
    *,
    chain: Sequence[bytes] | None = None,
    rtcert: bytes | None = None,
    sequence: int = 1,
    lease_s: float = 60.0,
) -> bytes:
    """Return a valid advertisement; by default the robot's, to publish the camera."""
    return UnverifiedAdvertisement(
        subject=subject,
        right=right,
        rtcert=RtCert.make(node, SWITCH.name, DAY) if rtcert is None else rtcert,
        sequence=sequence,
        incarnation=7,
        lease_ms=round(lease_s * 1_000),
        is_global=True,
        chain=(adcert(node),) if chain is None else tuple(chain),
    ).signed(node)


def verifier(*, allow_unowned: bool = False) -> AdvertisementVerifier:
    """Return a verifier of the school that trusts no other domain and remembers nothing yet."""
    return AdvertisementVerifier(Policy(SCHOOL.root), allow_unowned=allow_unowned)
