"""What is to be scored, as a person or a queue states it."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple, get_args

from pydantic import BaseModel, ConfigDict, Field, field_validator

from ahoy_core.avatar.full_config import ABLATIONS
from ahoy_core.captures import KINDS, Capture, read_dataset
from ahoy_core.metrics.protocol import PROTOCOLS
from ahoy_core.metrics.score import REFERENCES
from storage_schema.store import ArtifactStore
from tasks.evaluation.baselines import BASELINES
from tasks.evaluation.config import InputSetting
from tasks.settings import Preset


class OtherSystem(NamedTuple):
    """Renders that another system made: what it is called, where they lie, what it was given."""

    name: str
    folder: Path
    input_setting: str

    @classmethod
    def of(cls, text: str) -> OtherSystem:
        """Read NAME=FOLDER or NAME=FOLDER@INPUT_SETTING.

        Raises:
            ValueError: it has another form, no such folder or setting, or the name of a configuration.
        """
        name, _, rest = text.partition("=")
        folder, _, setting = rest.partition("@")
        settings = get_args(InputSetting)
        if not name or not Path(folder).is_dir() or (setting or settings[0]) not in settings:
            raise ValueError(
                f"expected NAME=FOLDER or NAME=FOLDER@SETTING with a folder that exists and a setting among "
                f"{', '.join(settings)}, got {text!r}"
            )
        if name in ABLATIONS or name in REFERENCES or name in BASELINES:
            raise ValueError(f"expected another name than that of a configuration, got {name!r}")
        return cls(name, Path(folder), setting or settings[0])


class EvaluateRequest(BaseModel):
    """Parameters of the flow `evaluate`."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    dataset: str = Field(description="folder of captures, or a video")
    out: str = Field(description="folder for tables, pictures and the chart")
    store: str | None = Field(None, description="URL of the artifact store; by default OUT/store")
    preset: Preset = Field("standard", description="how much time to spend")
    ablate: tuple[str, ...] = Field(tuple(ABLATIONS), description="configurations: full, A, B1, B2, C1, C2, C, C3, D")
    overrides: tuple[str, ...] = Field((), description="knobs, as STAGE.KNOB=VALUE")
    only: tuple[str, ...] = Field((), description="names of captures; by default all")
    kind: str = Field("auto", description=f"layout of the data set: {', '.join(KINDS)}")
    input_camera: str = Field("", description="camera whose pictures are the input, where the layout leaves it open")
    truth_body: str | None = Field(None, description="body file (.npz) that true SMPL parameters belong to")
    give_camera: bool = Field(True, description="tell the method the input's camera, where it is known")
    protocols: tuple[str, ...] = Field(tuple(PROTOCOLS), description="names of protocols")
    size: int = Field(256, ge=32, le=4096, description="longest side of what is compared, pixels")
    renders: tuple[str, ...] = Field((), description="other systems: NAME=FOLDER or NAME=FOLDER@INPUT_SETTING")
    baselines: tuple[str, ...] = Field((), description=f"built-in baselines: {', '.join(BASELINES)}")
    export_inputs: str | None = Field(None, description="folder for what other systems are given")
    beside: tuple[str, ...] = Field((), description="metrics.parquet of earlier evaluations, for the same tables")
    withhold: int = Field(8, ge=2, description="of a plain video, every n-th frame is withheld")

    @field_validator("ablate")
    @classmethod
    def _known(cls, names: tuple[str, ...]) -> tuple[str, ...]:
        if unknown := [name for name in names if name not in ABLATIONS]:
            raise ValueError(f"expected configurations among {', '.join(ABLATIONS)}, got {', '.join(unknown)}")
        return tuple(dict.fromkeys(names))

    @field_validator("baselines")
    @classmethod
    def _built_in(cls, names: tuple[str, ...]) -> tuple[str, ...]:
        if unknown := [name for name in names if name not in BASELINES]:
            raise ValueError(f"expected baselines among {', '.join(BASELINES)}, got {', '.join(unknown)}")
        return tuple(dict.fromkeys(names))

    @field_validator("renders")
    @classmethod
    def _parsed(cls, texts: tuple[str, ...]) -> tuple[str, ...]:
        for text in texts:
            OtherSystem.of(text)
        return texts

    def captures(self) -> list[Capture]:
        """The captures that were asked for.

        Raises:
            ValueError: there are none, or no such.
        """
        body = Path(self.truth_body).expanduser() if self.truth_body else None
        found = read_dataset(Path(self.dataset).expanduser(), self.kind, self.input_camera, body)
        names = [capture.name for capture in found]
        if missing := sorted(set(self.only) - set(names)):
            raise ValueError(f"expected captures among {', '.join(names)}, got {', '.join(missing)}")
        return [capture for capture in found if not self.only or capture.name in self.only]

    def open_store(self) -> ArtifactStore:
        """Open the store that the cells are kept in."""
        return ArtifactStore(self.store or Path(self.out) / "store")
