"""Pulling model files: from a real (tiny) wheel in a folder, through the real pip."""

from __future__ import annotations

import hashlib
import json
import zipfile
from collections.abc import Mapping
from pathlib import Path

import pytest

from tasks import model_files
from tasks.model_files import ModelFileError, ModelMissingError

WHEEL = "tinynets-1.0-cp311-cp311-manylinux_2_28_x86_64.whl"
MEMBERS = {"tinynets/one.tflite": b"first network", "tinynets/two.tflite": b"second network"}


def sha256(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def build_wheel(folder: Path, members: Mapping[str, bytes]) -> Path:
    info = "tinynets-1.0.dist-info"
    metadata = {
        f"{info}/METADATA": b"Metadata-Version: 2.1\nName: tinynets\nVersion: 1.0\n",
        f"{info}/WHEEL": b"Wheel-Version: 1.0\nRoot-Is-Purelib: false\nTag: cp311-cp311-manylinux_2_28_x86_64\n",
        f"{info}/RECORD": b"",
    }
    path = folder / WHEEL
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in {**members, **metadata}.items():
            archive.writestr(name, content)
    return path


@pytest.fixture
def source(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with the wheel and a manifest that describes it; the cache is empty and of this test alone."""
    monkeypatch.setenv("AHOY_MODELS", str(tmp_path / "cache"))
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    monkeypatch.setenv("PIP_FIND_LINKS", str(tmp_path))
    wheel = build_wheel(tmp_path, MEMBERS)
    describe(tmp_path, sha256(wheel.read_bytes()))
    return tmp_path


def describe(folder: Path, wheel_sha256: str, member_sha256: Mapping[str, str] | None = None) -> Path:
    wheel = {"version": "1.0", "file": WHEEL, "sha256": wheel_sha256, "size": (folder / WHEEL).stat().st_size}
    wheel |= {"python_version": "3.11", "implementation": "cp", "abi": "cp311", "platform": "manylinux_2_28_x86_64"}
    models = [
        {
            "name": Path(member).stem,
            "role": "pose",
            "purpose": "test",
            "wheel": "tinynets",
            "member": member,
            "sha256": (member_sha256 or {}).get(member, sha256(content)),
            "size": len(content),
            "licence": "Apache-2.0",
        }
        for member, content in MEMBERS.items()
    ]
    path = folder / "models.json"
    path.write_text(json.dumps({"wheels": {"tinynets": wheel}, "models": models}))
    return path


def cached(folder: Path) -> list[Path]:
    cache = folder / "cache"
    return sorted(cache.rglob("*")) if cache.exists() else []


def test_pull_takes_every_network_out_of_the_wheel_and_a_second_pull_needs_no_wheel(source: Path) -> None:
    manifest = source / "models.json"
    seen: list[tuple[int, int, str]] = []
    paths = model_files.pull(lambda done, total, note: seen.append((done, total, note)), manifest=manifest)
    assert [path.read_bytes() for path in paths] == list(MEMBERS.values())
    assert {status.state for status in model_files.verify(manifest)} == {"ok"}
    assert seen[-1][0] == seen[-1][1] and "2 networks" in seen[-1][2]
    assert cached(source) == sorted(paths), "something besides the networks was left in the cache"
    (source / WHEEL).unlink()
    assert model_files.pull(manifest=manifest) == paths
    assert model_files.model_path("one", manifest) == paths[0]


def test_a_file_that_was_never_pulled_is_refused_with_the_command_that_pulls_it(source: Path) -> None:
    with pytest.raises(ModelMissingError, match="ahoy models pull"):
        model_files.model_path("one", source / "models.json")
    assert {status.state for status in model_files.verify(source / "models.json")} == {"missing"}


def test_a_damaged_file_is_refused_and_the_next_pull_replaces_it(source: Path) -> None:
    manifest = source / "models.json"
    first, _ = model_files.pull(manifest=manifest)
    first.write_bytes(b"first networ")
    with pytest.raises(ModelFileError, match=f"expected .* {sha256(MEMBERS['tinynets/one.tflite'])}, got .*pull"):
        model_files.model_path("one", manifest)
    assert model_files.verify(manifest)[0].state == "wrong hash"
    model_files.pull(manifest=manifest)
    assert first.read_bytes() == MEMBERS["tinynets/one.tflite"]


def test_a_wheel_with_another_hash_is_refused_and_leaves_nothing(source: Path) -> None:
    good = sha256((source / WHEEL).read_bytes())
    wheel = build_wheel(source, {**MEMBERS, "tinynets/extra.py": b"import os"})
    with pytest.raises(ModelFileError, match=f"{good}, got {sha256(wheel.read_bytes())}; it was refused"):
        model_files.pull(manifest=describe(source, good))
    assert cached(source) == []


def test_a_network_with_another_hash_than_the_manifest_leaves_nothing(source: Path) -> None:
    wrong = {"tinynets/one.tflite": "0" * 64}
    manifest = describe(source, sha256((source / WHEEL).read_bytes()), wrong)
    with pytest.raises(ModelFileError, match=r"tinynets/one\.tflite .* got"):
        model_files.pull(manifest=manifest)
    assert [path for path in cached(source) if path.is_file()] == []


def test_a_wheel_without_the_network_is_refused(source: Path) -> None:
    wheel = build_wheel(source, {"tinynets/other.tflite": b"x"})
    with pytest.raises(ModelFileError, match="a wheel without it"):
        model_files.pull(manifest=describe(source, sha256(wheel.read_bytes())))


def test_when_pip_finds_nothing_its_words_and_the_next_step_are_in_the_error(source: Path) -> None:
    (source / WHEEL).unlink()
    with pytest.raises(ModelFileError, match=r"(?s)got no wheel \(exit 1\).*tinynets.*ahoy models pull"):
        model_files.pull(manifest=source / "models.json")
    assert cached(source) == []


def test_an_unknown_name_lists_the_known_ones() -> None:
    with pytest.raises(ModelFileError, match="pose_detection, pose_landmark_full"):
        model_files.model_path("nose_detection")


def test_the_packaged_manifest_states_source_hash_size_and_licence_of_every_network() -> None:
    models = model_files.list_models()
    assert {model.name for model in models} >= {"pose_detection", "pose_landmark_full"}
    for model in models:
        assert len(model.sha256) == len(model.wheel.sha256) == 64
        assert model.size > 0 and model.licence and model.role and model.purpose
        assert model.wheel.version in model.wheel.file
