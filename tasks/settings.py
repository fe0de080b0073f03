"""The configuration of a whole run: one frozen model per stage, three presets, and overrides by name."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from ahoy_core.avatar.config import CoarseConfig
from ahoy_core.avatar.full_config import FullConfig
from ahoy_core.ingest import IngestConfig
from ahoy_core.perceive.perceive import PerceiveConfig
from ahoy_core.texture.texture import TextureConfig
from tasks.animate import AnimateConfig
from tasks.complete import CompleteConfig
from tasks.hallucinate import HallucinateConfig
from tasks.identity import IdentityStageConfig
from tasks.motions import MotionsConfig
from tasks.stage import NoKnobs

Preset = Literal["draft", "standard", "high"]


class Settings(BaseModel):
    """Every knob of a run, by stage."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    body: str = Field(default="packaged", description='"packaged", or the path of your SMPL, SMPL+H or SMPL-X .npz')
    prior: str = Field(default="packaged", description='"packaged", "none", or the folder of a prior (docs/prior.md)')
    ingest: IngestConfig = IngestConfig()
    perceive: PerceiveConfig = PerceiveConfig()
    texture: TextureConfig = TextureConfig()
    complete: CompleteConfig = CompleteConfig()
    coarse: CoarseConfig = CoarseConfig()
    identity: IdentityStageConfig = IdentityStageConfig()
    motions: MotionsConfig = MotionsConfig()
    hallucinate: HallucinateConfig = HallucinateConfig()
    avatar: FullConfig = FullConfig()
    animate: AnimateConfig = AnimateConfig()
    report: NoKnobs = NoKnobs()

    def with_overrides(self, overrides: Iterable[str]) -> Settings:
        """Return a copy with `stage.knob=value` (or `stage.group.knob=value`) applied, validated like any settings.

        Raises:
            ValueError: an override is not of that form, or names no knob, or its value does not fit.
        """
        values: dict[str, Any] = self.model_dump(mode="json")
        known = dict(_leaves(values))
        for text in overrides:
            name, equals, value = text.partition("=")
            path = tuple(name.strip().split("."))
            if not equals or path not in known:
                names = ", ".join(".".join(knob) for knob in known)
                raise ValueError(f"expected STAGE.KNOB=VALUE, got {text!r}; the knobs are: {names}")
            group = values
            for part in path[:-1]:
                group = group[part]
            group[path[-1]] = _literal(value)
        try:
            return Settings.model_validate(values)
        except ValidationError as error:
            lines = "; ".join(f"{'.'.join(map(str, e['loc']))}: {e['msg']}, got {e['input']!r}" for e in error.errors())
            raise ValueError(f"the settings do not fit: {lines}; `ahoy run --help` lists the knobs") from None


def _leaves(values: Mapping[str, Any], path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Every knob with the names that lead to it."""
    for name, value in values.items():
        if isinstance(value, Mapping):
            yield from _leaves(value, (*path, name))
        else:
            yield (*path, name), value


def _literal(text: str) -> Any:
    """Read `3`, `0.5`, `true`, `null` as JSON does, anything else as text."""
    try:
        return json.loads(text)
    except json.JSONDecodeError:
        return text
