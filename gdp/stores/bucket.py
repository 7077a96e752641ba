"""Objects under a prefix of an S3-compatible bucket.

I/O; each call waits for the server. boto3 finds endpoint, region and credentials; it is imported when a bucket is
opened.
Source: Amazon S3 API reference (PutObject, GetObject, ListObjectsV2, DeleteObject, conditional writes).
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Final, NamedTuple

from gdp.closing import ClosedOnExit
from gdp.errors import LocalError, StoreError
from gdp.extras import require_extra
from gdp.intervals import CONNECT_S, SERVER_S

_SCHEME: Final = "s3://"
_ATTEMPTS: Final = 2
_CHANGED: Final = ("PreconditionFailed", "ConditionalRequestConflict", "412")
_WHAT_TO_DO: Final = {
    "AccessDenied": "the credentials need to list, get, put and delete objects there",
    "InvalidAccessKeyId": "the credentials are not valid",
    "NoSuchBucket": "there is no such bucket: make it first",
    "QuotaExceeded": "it is full: raise its quota, or let the holder keep less",
    "SignatureDoesNotMatch": "the credentials are not valid",
    "XMinioStorageFull": "it is full: add disks, or let the holder keep less",
}


class ChangedError(StoreError):
    """An object is not the one that was to be replaced."""


class StoredObject(NamedTuple):
    """An object: its bytes, and the tag (ETag) that changes with them."""

    size: int
    tag: str


class Bucket(ClosedOnExit):
    """Objects of a bucket whose keys begin with a prefix, by the rest of their keys. Thread-safe.

    Args:
        url: ``s3://NAME/PREFIX``.

    Every method may raise these too.

    Raises:
        LocalError: the URL, the credentials or the permissions are wrong, or boto3 is not installed.
        StoreError: the bucket cannot be reached, or is full; a repetition may succeed.
    """

    def __init__(self, url: str) -> None:
        self.url = url
        self._name, _, prefix = url.removeprefix(_SCHEME).partition("/")
        self._prefix = f"{prefix.rstrip('/')}/" if prefix else ""
        if not url.startswith(_SCHEME) or not self._name:
            raise LocalError(f"{url}: expected {_SCHEME}NAME/PREFIX")
        require_extra("aws", ["boto3"], url)
        import boto3
        from botocore.config import Config

        config = Config(
            connect_timeout=CONNECT_S,
            read_timeout=SERVER_S,
            retries={"mode": "standard", "total_max_attempts": _ATTEMPTS},
        )
        with self._translated(""):
            self._client: Any = boto3.session.Session().client("s3", config=config)

    def put(self, key: str, data: bytes, replaces: str | None) -> str:
        """Write an object, whole or not at all; return its tag.

        Args:
            replaces: tag of the object that is there; None: there is none.

        Raises:
            ChangedError: another one is there.
        """
        condition = {"IfNoneMatch": "*"} if replaces is None else {"IfMatch": replaces}
        with self._translated(key):
            answer = self._client.put_object(Bucket=self._name, Key=self._prefix + key, Body=data, **condition)
            return str(answer["ETag"])

    def get(self, key: str) -> tuple[bytes, str] | None:
        """Return an object and its tag; None: there is none."""
        from botocore.exceptions import ClientError

        with self._translated(key):
            try:
                answer = self._client.get_object(Bucket=self._name, Key=self._prefix + key)
            except ClientError as error:
                if error.response["Error"]["Code"] == "NoSuchKey":
                    return None
                raise
            return answer["Body"].read(), str(answer["ETag"])

    def list(self, folder: str = "") -> Iterator[tuple[str, StoredObject]]:
        """Yield the objects whose keys begin with ``folder``, each with its key."""
        pages = self._client.get_paginator("list_objects_v2")
        with self._translated(folder):
            for page in pages.paginate(Bucket=self._name, Prefix=self._prefix + folder):
                for each in page.get("Contents", ()):
                    yield each["Key"][len(self._prefix) :], StoredObject(each["Size"], each["ETag"])

    def delete(self, key: str) -> None:
        """Remove an object, if it is there."""
        with self._translated(key):
            self._client.delete_object(Bucket=self._name, Key=self._prefix + key)

    def close(self) -> None:
        """Close the connections."""
        self._client.close()

    @contextmanager
    def _translated(self, key: str) -> Iterator[None]:
        from botocore import exceptions as boto

        where = f"{self.url}{f': {key}' if key else ''}"
        try:
            yield
        except boto.ClientError as error:
            code = str(error.response.get("Error", {}).get("Code", ""))
            status = int(error.response.get("ResponseMetadata", {}).get("HTTPStatusCode", 0))
            if code in _CHANGED or status == 412:
                raise ChangedError(f"{where}: another object is there") from error
            kind = StoreError if status >= 500 or "Full" in code or "Quota" in code else LocalError
            raise kind(f"{where}: {_WHAT_TO_DO.get(code, 'the bucket refuses')} ({error})") from error
        except (boto.EndpointConnectionError, boto.HTTPClientError, boto.IncompleteReadError) as error:
            raise StoreError(f"{where}: the bucket cannot be reached: {error}") from error
        except (boto.BotoCoreError, ValueError) as error:  # credentials, region, profile or name of the bucket
            raise LocalError(f"{where}: {error}") from error
