"""Section of a rule about coordinate frames: how those of a robot are called on this machine.

Section of a configuration file.
"""

from __future__ import annotations

from typing import Annotated, Final

from pydantic import ConfigDict, Field, model_validator

from gdp.config.schema import Section

_CHARS_MAX: Final = 255
_Text = Annotated[str, Field(max_length=_CHARS_MAX, pattern=r"^[^\x00-\x20\x7f]*$")]


class Frames(Section):
    """How the coordinate frames in messages are renamed."""

    model_config = ConfigDict(json_schema_extra={"oneOf": [{"required": ["add"]}, {"required": ["remove"]}]})

    add: _Text = Field(default="", description="Text in front of every frame, such as `robot1/`.")
    remove: _Text = Field(default="", description="Text to take away in front of frames; others stay.")
    common: tuple[_Text, ...] = Field(default=(), description="Frames of all robots, such as `map`, which stay.")

    @model_validator(mode="after")
    def _is_one(self) -> Frames:
        if bool(self.add) == bool(self.remove):
            raise ValueError("expected either add or remove, such as {add: robot1/, common: [map]}")
        return self

    def rename(self, frame: bytes) -> bytes:
        """Return what a frame is called here; one without a name, and one in common, keep theirs."""
        name = frame.removeprefix(b"/")  # of tf before tf2
        if not name or name.decode(errors="replace") in self.common:
            return frame
        if self.add:
            return self.add.encode() + name
        return name.removeprefix(self.remove.encode()) or frame
