"""Timelines: operations that the controller does by itself (docs/control.md section 6)."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any, Mapping, Sequence, Union

#: The path of a file, the text of one, or its steps.
Timeline = Union[None, str, "os.PathLike[str]", Sequence[Mapping[str, Any]]]


def timeline_file(timeline: Union[str, os.PathLike[str], Sequence[Mapping[str, Any]]], folder: Path) -> str:
    """The path of a file with this timeline."""
    if isinstance(timeline, os.PathLike):
        return os.fspath(timeline)
    if isinstance(timeline, str):
        if "\n" not in timeline and "=" not in timeline and timeline.strip():
            return timeline
        text = timeline
    else:
        text = "".join(_step(step) for step in timeline)
    path = folder / "timeline.toml"
    path.write_text(text, encoding="utf-8")
    return str(path)


def _step(step: Mapping[str, Any]) -> str:
    lines = [f"{json.dumps(key)} = {_value(value)}" for key, value in step.items()]
    return "\n".join(["[[step]]", *lines, "", ""])


def _value(value: Any) -> str:
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{json.dumps(str(key))} = {_value(item)}" for key, item in value.items()) + " }"
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(_value(item) for item in value) + "]"
    if isinstance(value, (bool, int, float, str)):
        # Of these JSON and TOML write all that is finite in the same way.
        return json.dumps(value, ensure_ascii=False)
    raise TypeError(f"a timeline cannot hold {value!r}")
