"""Signatures of the bridge's tests."""

from tests.insiders.signatures import signatures

__all__ = ["signatures"]
