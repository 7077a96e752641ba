"""Holders whose segments are in a bucket: S3 on a loopback port, and what of a store is where."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from gdp.capsule.descriptor import Descriptor
from gdp.capsule.holder import Ask, HolderAnswer, HolderRequest
from gdp.names import Name
from gdp.stores import capsule_store
from gdp.stores.bucket import Bucket
from gdp.stores.bucket_upkeep import BucketUpkeep
from gdp.stores.capsule_store import CapsuleStore, StoredCapsule, StoreLimits
from tests.gdp.capsule.owned import NOW_S
from tests.gdp.stores.holder_sites import ABOUT

NAME = "capsules"
FILE_BYTES = 3_000
LIMITS = StoreLimits(owner_bytes=1 << 24, spare_bytes=0, cache_bytes=1 << 24)
HOLDER, OTHER = Name(b"h" * 32), Name(b"o" * 32)
AGED_S = 61.0


@contextmanager
def s3_server(folder: Path) -> Iterator[str]:
    """Run S3 with one bucket, and have boto3 find it; return its URL."""
    boto3 = pytest.importorskip("boto3", reason="the extra `aws` is not installed")
    moto_server = pytest.importorskip("moto.server", reason="moto of the extra `dev` is not installed")
    server = moto_server.ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    with pytest.MonkeyPatch.context() as patch:
        for key, value in environment(f"http://{host}:{port}", folder).items():
            patch.setenv(key, value)
        patch.delenv("AWS_PROFILE", raising=False)
        boto3.client("s3").create_bucket(Bucket=NAME)
        yield f"http://{host}:{port}"
    server.stop()


def environment(url: str, folder: Path) -> dict[str, str]:
    """Return what boto3 reads to find a server."""
    absent = str(folder / "absent")
    return {
        "AWS_ENDPOINT_URL": url,
        "AWS_ACCESS_KEY_ID": "testing",
        "AWS_SECRET_ACCESS_KEY": "testing",
        "AWS_DEFAULT_REGION": "us-east-1",
        "AWS_CONFIG_FILE": absent,
        "AWS_SHARED_CREDENTIALS_FILE": absent,
        "AWS_EC2_METADATA_DISABLED": "true",
    }


def short_segments(patch: pytest.MonkeyPatch) -> None:
    """Have segments end after some records."""
    patch.setattr(capsule_store, "SEGMENT_BYTES", FILE_BYTES * capsule_store._BACKED_PARTS)


class BackedSite:
    """A holder with a bucket."""

    def __init__(self, folder: Path, prefix: str, limits: StoreLimits = LIMITS, *, about: Descriptor = ABOUT) -> None:
        self.folder, self.url, self.limits, self.holder = folder, f"s3://{NAME}/{prefix}", limits, HOLDER
        self.about = about
        self.unix_s: float = NOW_S
        self.now_s = 0.0
        self.bucket = Bucket(self.url)
        self.open()

    def open(self, *, takes: bool = False) -> None:
        """Start."""
        self.store = CapsuleStore(self.folder, self.limits, lambda: self.unix_s)
        self.upkeep = BucketUpkeep(self.store, self.bucket)
        try:
            self.upkeep.open(self.holder, takes=takes)
        except Exception:
            self.close()
            raise

    def close(self) -> None:
        """Stop."""
        self.upkeep.close()
        self.store.close()

    def restart(self, *, takes: bool = False) -> None:
        """Stop and start."""
        self.close()
        self.open(takes=takes)

    def append(self, data: bytes, offset: int) -> HolderAnswer:
        """Append as the writer."""
        request = HolderRequest(
            ask=Ask.APPEND, capsule=self.about.name, offset=offset, data=data, descriptor=self.about
        )
        return HolderAnswer.from_cbor(self.store.handle(request.to_cbor(), self.about.writer.name))

    def ask(self, ask: Ask, offset: int = 0, time_ns: int = 0) -> HolderAnswer:
        """Ask as a reader."""
        request = HolderRequest(ask=ask, capsule=self.about.name, offset=offset, time_ns=time_ns)
        return HolderAnswer.from_cbor(self.store.handle(request.to_cbor(), Name(b"r" * 32)))

    def round(self, aged_s: float = AGED_S) -> int:
        """Have the bucket get what is due, open segments too; return the confirmed head."""
        self.upkeep.run_round(self.now_s)
        self.now_s += aged_s
        self.upkeep.run_round(self.now_s)
        return self.ask(Ask.HEAD).head

    @property
    def capsule(self) -> StoredCapsule:
        """Return the only capsule."""
        (capsule,) = self.store.capsules
        return capsule

    @property
    def begin(self) -> int:
        """Return the offset of the first byte that is held."""
        return self.capsule.segments.begin

    @property
    def data(self) -> bytes:
        """Return all records, as a reader gets them."""
        pieces, at = list[bytes](), self.begin
        while (answer := self.ask(Ask.READ, at)).data:
            assert answer.offset == at
            pieces.append(answer.data)
            at += len(answer.data)
        return b"".join(pieces)

    @property
    def files(self) -> dict[int, int]:
        """Return the segments on the disk, by offset, with their bytes."""
        found = (self.folder / self.about.name.to_text()).glob("*.records")
        return {int(path.stem, 16): path.stat().st_size for path in sorted(found)}

    @property
    def objects(self) -> dict[int, int]:
        """Return the segments in the bucket, by offset, with their bytes."""
        found = self.bucket.list(f"{self.about.name.to_text()}/")
        return {int(key[-24:-8], 16): each.size for key, each in found if key.endswith(".records")}

    def key(self, offset: int) -> str:
        """Return the key of a segment."""
        return f"{self.about.name.to_text()}/{offset:016x}.records"

    def overwrite(self, offset: int, data: bytes) -> None:
        """Exchange an object."""
        found = self.bucket.get(self.key(offset))
        self.bucket.put(self.key(offset), data, None if found is None else found[1])

    @property
    def faults(self) -> list[str]:
        """Return, once, what was found wrong."""
        return list(self.store.poll_faults().values())


def client() -> Any:
    """Return a client of the server."""
    import boto3

    return boto3.client("s3")
