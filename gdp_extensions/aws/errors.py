"""Mapping of EC2 errors to ``StoreError`` (try again or elsewhere) and ``LocalError`` (permanent).

I/O; waits for nothing itself.
Source: "Error codes for the Amazon EC2 API" of the EC2 API reference.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

from gdp.errors import LocalError, StoreError

_TRY_AGAIN: Final = {
    "InsufficientInstanceCapacity": "there is no such machine to be had there now",
    "InsufficientHostCapacity": "there is no such machine to be had there now",
    "InsufficientAddressCapacity": "there is no public address to be had there now",
    "InsufficientFreeAddressesInSubnet": "the subnet has no free address",
    "SpotMaxPriceTooLow": "the spot price is above the limit now",
    "InvalidGroup.NotFound": "the security group was removed a moment ago",
    "IdempotentParameterMismatch": "the machine was asked for a moment ago, and is not listed yet",
    "RequestLimitExceeded": "too many requests",
    "ResourceCountExceeded": "too many requests",
    "Throttling": "too many requests",
    "ThrottlingException": "too many requests",
}
_WHAT_TO_DO: Final = {
    "UnauthorizedOperation": "the credentials lack the permission; docs/reference/providers.md lists what they need",
    "AuthFailure": "the credentials are not valid, or the region is not enabled for the account",
    "InvalidClientTokenId": "the credentials are not valid",
    "OptInRequired": "the account is not subscribed to this",
    "PendingVerification": "the account is not verified yet",
    "VcpuLimitExceeded": "the account's quota of virtual CPUs is used up: ask for more in Service Quotas",
    "InstanceLimitExceeded": "the account's quota is used up: ask for more in Service Quotas",
    "MaxSpotInstanceCountExceeded": "the account's quota of spot machines is used up: ask for more in Service Quotas",
    "Unsupported": "this region does not sell this type of machine in that form",
    "InvalidKeyPair.NotFound": "the key pair of `aws.ssh` is not in this region: import it there",
    "InvalidAMIID.NotFound": "the image of `aws.images` is not in this region",
    "VPCIdNotSpecified": "the region has no default VPC: name one in `aws.subnets`",
}


@contextmanager
def asking(what: str) -> Iterator[None]:
    """Translate exceptions of boto3; ``what``: the request, such as ``us-east-1: create m3``.

    Raises:
        StoreError: the request may succeed later or elsewhere, or EC2 cannot be reached.
        LocalError: credentials, permissions, quota or parameters are wrong; the text states the remedy.
    """
    from botocore import exceptions as boto

    try:
        yield
    except boto.ClientError as error:
        raise _translated(what, error) from error
    except (
        boto.NoCredentialsError,
        boto.PartialCredentialsError,
        boto.CredentialRetrievalError,
        boto.ProfileNotFound,
        boto.TokenRetrievalError,
        boto.ParamValidationError,
        boto.NoRegionError,
        boto.InvalidRegionError,
    ) as error:
        raise LocalError(f"aws: {what}: {error}") from error
    except boto.BotoCoreError as error:
        raise StoreError(f"aws: {what}: {error}") from error


def is_code(error: Exception | None, code: str) -> bool:
    """Return whether EC2 responded with this code; ``error``: exception of boto3."""
    from botocore.exceptions import ClientError

    return isinstance(error, ClientError) and error.response["Error"]["Code"] == code


def _translated(what: str, error: Exception) -> LocalError | StoreError:
    response = getattr(error, "response", {})
    code = str(response.get("Error", {}).get("Code", ""))
    status = int(response.get("ResponseMetadata", {}).get("HTTPStatusCode", 0))
    if code in _TRY_AGAIN or (status >= 500 and code not in _WHAT_TO_DO):
        return StoreError(f"aws: {what}: {_TRY_AGAIN.get(code, 'EC2 failed')} ({error})")
    advice = _WHAT_TO_DO.get(code)
    return LocalError(f"aws: {what}: {advice} ({error})" if advice else f"aws: {what}: {error}")
