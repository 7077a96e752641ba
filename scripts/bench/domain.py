"""Domain of the benches without a network: identities, and signed advertisements of numbered topics.

Sans-I/O.
"""

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
from gdp.trust.advertisement import sign_advertisement
from gdp.trust.domain import Policy
from gdp.trust.right import Right
from gdp.trust.rtcert import RtCert
from gdp.trust.verifier import AdvertisementVerifier

__all__ = ["BenchDomain"]


class BenchDomain:
    """Trust domain with a switch and some proxies, and the owner of all topics."""

    def __init__(self, unix_s: float, proxies: int = 1) -> None:
        self.validity = Validity.lasting(unix_s, 86_400)
        self.authority = CertificateAuthority.create("bench", SigningKey.generate(), self.validity)
        self.switch = self.node(Role.SWITCH, "switch")
        self.proxies = [self.node(Role.PROXY, f"proxy{number}") for number in range(proxies)]
        self.owner = SigningKey.generate()
        self._rtcerts = [RtCert.make(proxy, self.switch.name, self.validity) for proxy in self.proxies]

    def node(self, role: Role, label: str) -> Identity:
        """Return a new member."""
        return NodeKeys.generate(role, label).join(self.authority, self.validity)

    def policy(self) -> Policy:
        """Return a policy that trusts the domain."""
        return Policy(self.authority.root)

    def verifier(self) -> AdvertisementVerifier:
        """Return a verifier with empty caches."""
        return AdvertisementVerifier(self.policy())

    def subject(self, number: int, owner: SigningKey | None = None) -> Subject:
        """Return the subject of the topic with this number."""
        metadata = Metadata({"kind": "topic", "name": f"/bench/{number}"})
        return Subject.of(metadata, (owner or self.owner).public.compressed)

    def proxy_of(self, number: int) -> Identity:
        """Return the proxy that advertises the topic with this number."""
        return self.proxies[number % len(self.proxies)]

    def adcert(self, number: int) -> bytes:
        """Return the owner's permission for the proxy to publish the topic with this number."""
        subject, proxy = self.subject(number), self.proxy_of(number)
        return AdCert.make(self.owner, subject.name, subject, proxy.subject, [Right.PUBLISH], self.validity)

    def advertisement(
        self,
        number: int,
        *,
        sequence: int = 1,
        incarnation: int = 1,
        lease_s: float = 60.0,
        subject: Subject | None = None,
        chain: Sequence[bytes] = (),
    ) -> bytes:
        """Return a signed advertisement of the topic with this number.

        Args:
            subject: of another owner; None: the topic's own.
            chain: AdCerts from the owner to the proxy; empty: one new AdCert.
        """
        return sign_advertisement(
            self.proxy_of(number),
            Right.PUBLISH,
            subject or self.subject(number),
            rtcert=self._rtcerts[number % len(self.proxies)],
            sequence=sequence,
            incarnation=incarnation,
            lease_s=lease_s,
            is_global=False,
            chain=chain or (self.adcert(number),),
        )
