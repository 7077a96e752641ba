"""Parser of a recording's YAML with bounds: no deep nesting, no anchors, no tags.

Sans-I/O. rosbags reads QoS profiles and ``metadata.yaml`` with a reader that takes seconds for 8 KiB of brackets;
``BoundedYaml`` replaces it. The events are checked before any object is built.
"""

from __future__ import annotations

from typing import Any, Final

import yaml
from ruamel.yaml import YAML

from proxy.recordings.unpacking import SalvageError

_LOADER: Final[Any] = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # libyaml, where PyYAML was built with it
_BYTES_MAX: Final = 1 << 20
_DEPTH_MAX: Final = 16


def load_plain(text: str) -> object:
    """Return the value of a YAML text.

    Raises:
        SalvageError: it is too long, too deep, has anchors or tags, or is no YAML.
    """
    if len(text) > _BYTES_MAX:
        raise SalvageError(f"YAML of {len(text)} characters; at most {_BYTES_MAX} are read")
    depth = 0
    try:
        for event in yaml.parse(text, Loader=_LOADER):
            depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
            if depth > _DEPTH_MAX:
                raise SalvageError(f"YAML nested deeper than {_DEPTH_MAX}")
            if isinstance(event, yaml.AliasEvent) or (isinstance(event, yaml.NodeEvent) and event.anchor):
                raise SalvageError("YAML with anchors")
            if isinstance(event, yaml.ScalarEvent | yaml.CollectionStartEvent) and event.tag:
                raise SalvageError("YAML with tags")
        loaded: object = yaml.load(text, _LOADER)
    except (yaml.YAMLError, ValueError, OverflowError, TypeError) as error:  # of dates, and of keys that are lists
        raise SalvageError(f"no YAML: {error}") from error
    return loaded


class BoundedYaml(YAML):
    """rosbags' reader of YAML, bounded."""

    def load(self, stream: Any) -> Any:
        """Return the value of a text."""
        return load_plain(stream)
