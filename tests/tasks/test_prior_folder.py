"""Which prior a run asks, and every reason why it may not."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from ahoy_core.models.adapter import Fill
from tasks import prior_folder
from tasks.fills import Fills
from tasks.prior_folder import fills_prior, no_prior, prior_role


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """What tells an embedded prior from others; no weights."""
    (tmp_path / "model_index.json").write_text(json.dumps({"vae": ["ahoy_core", "FrameAutoencoder"]}))
    (tmp_path / "weights.safetensors").write_bytes(b"one")
    return tmp_path


def test_a_prior_and_the_packaged_body_have_no_obstacle(folder: Path) -> None:
    assert no_prior(str(folder), "packaged", Fills()) == ""


@pytest.mark.parametrize(
    ("source", "body", "reason"),
    [
        ("none", "packaged", "switched off"),
        ("FOLDER", "smplx.npz", "packaged body alone"),
    ],
)
def test_a_reason_says_what_is_in_the_way(folder: Path, source: str, body: str, reason: str) -> None:
    assert reason in no_prior(source.replace("FOLDER", str(folder)), body, Fills())


def test_a_version_without_weights_says_so(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(prior_folder, "prior_folder", lambda source: folder / "nothing")
    assert "no trained prior ships" in no_prior("packaged", "packaged", Fills())


def test_missing_libraries_are_named_with_the_extra(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(prior_folder, "find_spec", lambda name: None if name == "peft" else object())
    assert no_prior(str(folder), "packaged", Fills()) == "needs peft: pip install 'ahoy-avatars[prior]'"


def test_wan_as_published_reads_no_bodies_and_so_takes_any(folder: Path) -> None:
    (folder / "model_index.json").write_text(json.dumps({"vae": ["diffusers", "AutoencoderKLWan"]}))
    assert no_prior(str(folder), "smplx.npz", Fills()) == ""


def test_the_machines_video_model_is_asked_where_the_run_names_none(folder: Path) -> None:
    fills = Fills({"video": Fill(fill="wan2.2-5b", path=folder)})
    assert no_prior("packaged", "smplx.npz", fills) == "" and fills_prior("packaged", fills)
    assert not fills_prior(str(folder), fills) and "packaged body alone" in no_prior(str(folder), "smplx.npz", fills)
    assert "switched off" in no_prior("none", "packaged", fills)


def test_a_folder_without_a_prior_is_an_error_not_a_reason(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"model_index\.json"):
        no_prior(str(tmp_path), "packaged", Fills())


def test_a_prior_is_known_by_its_contents(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> None:
    other = tmp_path_factory.mktemp("copy")
    for path in folder.iterdir():
        (other / path.name).write_bytes(path.read_bytes())
    assert prior_role(str(folder)).weights_sha256 == prior_role(str(other)).weights_sha256
    (other / "weights.safetensors").write_bytes(b"two")
    assert prior_role(str(folder)).weights_sha256 != prior_role(str(other)).weights_sha256
