"""Messages as text: YAML as ``ros2 topic echo`` prints it, and JSON as rosbridge writes it; and back from YAML."""

from __future__ import annotations

from typing import Final

import numpy as np
import orjson
import yaml

from gdp.errors import DropReason, LocalError, RemoteError
from proxy.serial.channel import Channel
from proxy.serial.json_dialect import JsonDialect
from proxy.serial.rosbridge_json import RosbridgeCodec
from proxy.serial.schema import DefinitionError, Number, parse
from proxy.serial.serializer import Codec, native_codec

TRUNCATE_LENGTH: Final = 128  # of arrays and strings; ros2 topic echo --truncate-length
_ELLIPSIS: Final = "..."
_DTYPES: Final = {"?": np.dtype("?"), **{code: np.dtype(f"<{code}") for code in "bBhHiIqQfd"}}
_DUMMY: Final = "structure_needs_at_least_one_member"  # rosidl's field of an empty type


class _Dialect(JsonDialect):
    """Plain values of Python: YAML has forms for infinities, NaN and integers of any size."""

    guarded = ""

    def plain(self, values: tuple[float, ...]) -> bool:
        """Return True: no number needs another form."""
        del values
        return True

    def number(self, code: str, value: float, bits: int) -> object:
        """Return the number."""
        del code, bits
        return value

    def array(self, item: Number, raw: memoryview) -> object:
        """Return a list of numbers, for octets, too."""
        values: list[object] = np.frombuffer(raw, dtype=_DTYPES[item.code]).tolist()
        return values


class MessageText:
    """Texts of one channel's messages.

    Args:
        truncate: longest array and string of the YAML form; None: all of them.

    Raises:
        LocalError: the channel has no usable definition.
    """

    def __init__(self, channel: Channel, truncate: int | None = TRUNCATE_LENGTH) -> None:
        self._name = channel.type_name
        self._truncate = truncate
        try:
            record = parse(channel.type_name, channel.definition, channel.definition_format, channel.ros)
            self._codec = Codec(record, channel.ros, _Dialect(), native_codec(channel))
            self._json = RosbridgeCodec(channel)
        except DefinitionError as error:
            raise LocalError(f"{channel.topic}: the definition of {channel.type_name} is of no use: {error}") from error

    def to_yaml(self, raw: bytes) -> str:
        """Return the message in YAML, without the separator. Raises ``RemoteError``: it does not fit the definition."""
        tree = self._codec.to_tree(raw)
        if tree is None:
            raise RemoteError(DropReason.MALFORMED, f"a message that does not fit {self._name}")
        shown = _shortened(tree, self._truncate)
        return yaml.safe_dump(shown, sort_keys=False, default_flow_style=False, allow_unicode=True, width=1 << 30)

    def to_json(self, raw: bytes) -> orjson.Fragment:
        """Return the message as part of a JSON text, whole: octets are base64, NaN and infinities null.

        Raises:
            RemoteError: it does not fit the definition.
        """
        return orjson.Fragment(self._json.to_json(raw))


def request_tree(text: str) -> object:
    """Return the fields of a request in YAML. Raises ``LocalError``: the text is no YAML mapping."""
    try:
        tree: object = yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise LocalError(f"the request is no YAML: {str(error).splitlines()[0]}; write it as '{{a: 1}}'") from error
    if tree is None:
        tree = {}
    if not isinstance(tree, dict):
        raise LocalError("the request is no YAML mapping; write it as '{a: 1}', with a space after the colon")
    return tree


def request_of(channel: Channel, tree: object) -> bytes:
    """Return the wire form of a request; fields that it leaves out are zero, empty or false.

    Raises:
        LocalError: it does not fit the type.
    """
    try:
        return RosbridgeCodec(channel).to_raw(tree)
    except DefinitionError as error:
        raise LocalError(f"the definition of {channel.type_name} is of no use: {error}") from error
    except RemoteError as error:
        raise LocalError(
            f"the request does not fit {channel.type_name.removesuffix('_Request')}: {error.detail}"
        ) from error


def _shortened(value: object, limit: int | None) -> object:
    """Return a tree without long arrays and strings, and without rosidl's field of an empty type."""
    if isinstance(value, dict):
        return {key: _shortened(each, limit) for key, each in value.items() if key != _DUMMY}
    if isinstance(value, list):
        if limit is not None and len(value) > limit:
            return [*(_shortened(each, limit) for each in value[:limit]), _ELLIPSIS]
        return [_shortened(each, limit) for each in value]
    if isinstance(value, str) and limit is not None and len(value) > limit:
        return value[:limit] + _ELLIPSIS
    return value
