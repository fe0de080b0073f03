"""An address in the place of a path: the command, the policy of the environment, the cache, exit statuses."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from flows.request import VideoRequest
from tests.sources.conftest import clip, server
from tests.sources.server import Served

__all__ = ["clip", "server"]


def test_ahoy_run_takes_an_address(server: Served, clip: bytes, tmp_path: Path) -> None:
    url = server.file("/My walk.mp4".replace(" ", "%20"), clip, ETag='"one"')
    command = [sys.executable, "-m", "flows", "run", url, "--out", str(tmp_path / "out"), "--stages", "ingest"]
    environment = {**os.environ, "AHOY_SOURCE_CACHE": str(tmp_path / "cache")}
    refused = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert refused.returncode == 2 and "PRIVATE_HOSTS" in refused.stdout and server.requests == []
    environment["AHOY_SOURCES__PRIVATE_HOSTS"] = '["127.0.0.1"]'
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert list((tmp_path / "out").glob("My-walk-????????")) and server.asked("/My%20walk.mp4") == 1


def test_the_policy_of_the_environment_is_asked(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    clip: bytes,
) -> None:
    (tmp_path / "clip.mp4").write_bytes(clip)
    request = VideoRequest(video=str(tmp_path / "clip.mp4"), out=str(tmp_path))
    assert request.source().name == "clip"
    monkeypatch.setenv("AHOY_SOURCES__LOCAL", "false")
    with pytest.raises(ValueError, match="not allowed"):
        request.source()
