"""What a run will cost and what single knobs would buy, from the measured set."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ahoy_core.cost.choose import Gains
from ahoy_core.cost.work import FRAMES, KNOBS, PIXELS
from ahoy_core.formats.npz import load_npz
from ahoy_core.formats.video import scan
from ahoy_core.formats.video_frames import Size, limited
from ahoy_core.ingest import IngestConfig
from ahoy_core.ingest.run import select
from tasks.cost.measured import MeasuredSet
from tasks.presets import PRESETS
from tasks.prior_folder import NONE
from tasks.settings import Preset, Settings

LEAST_GAIN_DB = 0.05  # smaller differences between single runs are noise


@dataclass(frozen=True)
class Clip:
    """What decides the work of a video: times of its frames, and its size in pixels."""

    pts: Any
    width: int
    height: int

    @classmethod
    def of(cls, path: Path) -> Clip:
        """Look at a video without decoding it.

        Raises:
            VideoError: it cannot be used.
        """
        video = scan(path)
        return cls(video.pts, video.probe.width, video.probe.height)

    def given(self, config: IngestConfig) -> dict[str, int]:
        """Frames that ingest keeps, and the pixels of each."""
        size = limited(Size(self.width, self.height), config.max_size)
        return {FRAMES: len(select(self.pts, config)[1]), PIXELS: size.width * size.height}


def ingested(ingest: Path) -> dict[str, int]:
    """Frames that ingest kept, and the pixels of each, from its artifact."""
    shape = load_npz(ingest / "frames.npz", ["frames"])["frames"].shape
    return {FRAMES: int(shape[0]), PIXELS: int(shape[1] * shape[2])}


def work_knobs(settings: Settings, clip: Mapping[str, int]) -> dict[str, Any]:
    """What decides the work of every stage, by name."""
    values = settings.model_dump(mode="json")
    named = {name: values[name.partition(".")[0]][name.partition(".")[2]] for name in KNOBS if name not in clip}
    return {**clip, **named}


class Predictor:
    """Seconds of whole runs of one video.

    Args:
        measured: the set.
        base: settings that changes are made to.
        clip: the video.
        factor: seconds here for a CPU second of the set's machine.
    """

    def __init__(self, measured: MeasuredSet, base: Settings, clip: Clip, factor: float) -> None:
        self._measured, self._base, self._clip, self._factor = measured, base, clip, factor
        self._at_base = work_knobs(base, {FRAMES: 0, PIXELS: 0})
        self._known: dict[tuple[Any, ...], float] = {}
        self._given: dict[str, dict[str, int]] = {}

    def at(self, factor: float) -> Predictor:
        """The same on a machine of another pace."""
        return Predictor(self._measured, self._base, self._clip, factor)

    def by_stage(self, changes: Mapping[str, Any]) -> dict[str, float]:
        """Seconds of each stage that was measured."""
        seconds = self._measured.times.all_seconds(self._knobs(changes))
        if self._base.prior == NONE:
            seconds.pop("complete", None)
        return {stage: self._factor * took for stage, took in seconds.items()}

    def seconds(self, changes: Mapping[str, Any]) -> float:
        """Seconds of all stages together."""
        key = tuple(sorted(changes.items()))
        if key not in self._known:
            self._known[key] = sum(self.by_stage(changes).values())
        return self._known[key]

    def _knobs(self, changes: Mapping[str, Any]) -> dict[str, Any]:
        ingest = {name.partition(".")[2]: value for name, value in changes.items() if name.startswith("ingest.")}
        config = self._base.ingest.model_copy(update=ingest)
        clip = self._given.setdefault(config.model_dump_json(), self._clip.given(config))
        return {**self._at_base, **clip, **{name: value for name, value in changes.items() if name in KNOBS}}


def gains_of(measured: MeasuredSet, fixed: Sequence[str] = (), preset: Preset | None = None) -> Gains:
    """What single knobs gain over a preset, in dB, sharpness counted.

    Args:
        measured: the set.
        fixed: knobs that are left out.
        preset: that they were swept round; the set's base by default.
    """
    preset = preset or measured.preset
    settings = PRESETS[preset].with_overrides(measured.overrides).model_dump(mode="json")
    by_knob, base = {}, {}
    for knob, values in measured.gains(preset).items():
        if knob in fixed:
            continue
        group, _, name = knob.partition(".")
        base[knob] = settings[group][name]
        by_knob[knob] = {base[knob]: 0.0, **values}
    return Gains(by_knob, base)
