"""Incarnations of readers and publishers with keys of their own, and the control datagrams that each can make."""

from __future__ import annotations

import hashlib
from functools import cache
from os import urandom

from gdp.client.control_keys import ControlKeys
from gdp.client.identities import ReaderIdentity, WriterIdentity
from gdp.client.key_epochs import Secrets
from gdp.crypto.control_seal import ControlContext, ControlSealer, control_key
from gdp.crypto.envelope import Signer, seal_key
from gdp.crypto.exchange import EXCHANGE_KEY_BYTES, ExchangeKey
from gdp.crypto.introduction import Introduction
from gdp.crypto.keys import SigningKey
from gdp.crypto.subject import Subject
from gdp.frame.codec import Kind
from gdp.message.acknack import AckNack, AckNackFlag
from gdp.names import Name


@cache
def key_of(label: bytes) -> SigningKey:
    return SigningKey.generate()


def subject_of(label: bytes) -> Subject:
    """Return the reader identity of a label; the same each time."""
    return Subject(hashlib.sha256(label).digest(), key_of(label).public.compressed)


def name_of(label: bytes) -> Name:
    return subject_of(label).name


def note_keys() -> ControlKeys:
    return ControlKeys(ExchangeKey.from_random(urandom(EXCHANGE_KEY_BYTES)))


def source_of(name: Name, incarnation: int, signer: Signer) -> WriterIdentity:
    return WriterIdentity(name, incarnation, signer, urandom, note_keys())


def reader_of(label: bytes, incarnation: int = 7, *, started: int | None = None) -> ReaderIdentity:
    """Return an incarnation of a reader, by default later than those of lower numbers."""
    notes, at = note_keys(), incarnation if started is None else started
    wire = Introduction.make(subject_of(label), key_of(label), incarnation, at, notes.public)
    return ReaderIdentity(name_of(label), incarnation, notes, lambda: wire)


class Notes:
    """Control datagrams that one incarnation of a reader can send, under any name; by default its own, and true."""

    def __init__(
        self,
        reader: ReaderIdentity,
        publisher: WriterIdentity,
        topic: Name,
        secrets: Secrets,
        *,
        as_name: Name | None = None,
    ) -> None:
        self._reader = reader
        self._publisher = publisher
        self._topic = topic
        self._secrets = secrets
        self._name = reader.name if as_name is None else as_name

    def introduction(self, epoch: int = 1, wire: bytes | None = None, *, incarnation: int | None = None) -> bytes:
        incarnation_id = self._reader.incarnation if incarnation is None else incarnation
        key = seal_key(self._secrets[epoch], Kind.INTRODUCTION, self._name, incarnation_id, self._publisher.name)
        sealer = self._sealer(key, epoch, Kind.INTRODUCTION, incarnation_id)
        return sealer.seal(self._reader.introduction() if wire is None else wire)

    def report(self, acknack: AckNack, epoch: int = 1, *, incarnation: int | None = None) -> bytes:
        incarnation_id = self._reader.incarnation if incarnation is None else incarnation
        publisher = self._publisher
        shared = self._reader.control_keys.shared(publisher.control_keys.public)
        ends = self._name, incarnation_id, publisher.name, publisher.incarnation
        key = control_key(shared, self._secrets[epoch], Kind.ACKNACK, *ends, self._topic)
        return self._sealer(key, epoch, Kind.ACKNACK, incarnation_id).seal(acknack.to_wire())

    def hello(self, epoch: int = 1) -> list[bytes]:
        """Return the first frames of a reader."""
        return [self.introduction(epoch), self.report(AckNack(AckNackFlag.NEW, 0, 0, ()), epoch)]

    def _sealer(self, key: bytes, epoch: int, kind: Kind, incarnation_id: int) -> ControlSealer:
        publisher = self._publisher
        return ControlSealer(
            key=key,
            epoch=epoch,
            context=ControlContext(
                kind, self._name, incarnation_id, publisher.name, publisher.incarnation, self._topic
            ),
            numbers=self._reader.note_numbers,
        )
