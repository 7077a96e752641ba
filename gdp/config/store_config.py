"""Configuration of a holder of capsules: every key of ``store.yaml``, its bounds and its default.

I/O; loading reads files and changes nothing. ``docs/reference/configuration.md`` explains the keys to users.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Final

from pydantic import Field

from gdp.config.schema import Directory, Domain, Identity, Ifname, Section, StateFolder, Unique, load
from gdp.intervals import MINUTE_S

MIN: Final = 0.001


class HolderConfig(Section):
    """What a holder keeps, and how much."""

    folder: Directory = Field(description="Where the capsules are.")
    service: str = Field(default="store", min_length=1, description="Its service, as the owner delegated it.")
    quota_gb: float = Field(default=100.0, ge=MIN, description="GB of all topics of one owner.")
    days: float | None = Field(default=None, ge=MIN, description="Older segments go.")
    most_gb: float | None = Field(default=None, ge=MIN, description="GB of one capsule, whose oldest segments go.")
    bucket: str | None = Field(default=None, description="s3://NAME/PREFIX that gets the segments.")
    cache_gb: float = Field(default=10.0, ge=MIN, description="GB of the disk, for what the bucket has or shall have.")
    upload_s: float = Field(default=MINUTE_S, gt=0, description="s after which the bucket gets an open segment, too.")
    peers: Annotated[tuple[str, ...], Unique] = Field(default=(), description="Services of holders to equal.")


class StoreConfig(Section):
    """``store.yaml``: a member of the overlay that holds capsules."""

    identity: Identity
    domain: Domain = Field(description="The trust domain, and the others whose members are believed.")
    iface: Ifname = Field(description="Device towards its switch.")
    delegations: Directory | None = Field(default=None, description="Default: `delegations` in `identity`.")
    state: StateFolder = None
    holds: HolderConfig = Field(description="The capsules.")

    @classmethod
    def load(cls, path: Path) -> StoreConfig:
        """Read ``store.yaml``, or the section ``store`` of ``machine.yaml``."""
        return load(cls, path, section="store")
