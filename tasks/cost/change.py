"""What a whole run of a sweep changed, as its row says it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

from tasks.cost.declared import END_TO_END

PRESET: Final = "preset"
"""The key of a setting that names a preset."""


@dataclass(frozen=True)
class Change:
    """What a whole run changed: one knob of a preset, or (knob `preset`) the preset itself."""

    preset: str
    knob: str
    value: Any

    @classmethod
    def of(cls, setting: Mapping[str, Any], base: str) -> Change:
        """Read a row's setting: `{knob: value}` round the base, `{"preset": P, knob: value}` round another preset."""
        preset = setting.get(PRESET, base)
        changed = [(knob, value) for knob, value in setting.items() if knob != PRESET]
        return cls(preset, *changed[0]) if changed else cls(base, PRESET, preset)

    def setting(self, base: str) -> dict[str, Any]:
        """Inverse of `of`."""
        return ({PRESET: self.preset} if self.preset != base else {}) | {self.knob: self.value}

    def sweep(self, base: str) -> str:
        """Of which sweep the run is a row."""
        return ".".join((END_TO_END, *((self.preset,) if self.preset != base else ()), self.knob))
