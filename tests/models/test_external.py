"""External commands: real processes that fail, hang, print, and leave the wrong things."""

from __future__ import annotations

import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import pytest
import torch

from ahoy_core.conventions import GREY
from ahoy_core.models.adapter import Fill
from ahoy_core.models.boxes import mask_bounds
from ahoy_core.models.catalogue import adapter
from ahoy_core.models.errors import CommandError, ModelError
from ahoy_core.models.external import exchange, run_command
from tests.models.commands import synchuman

VIEWS = adapter("views", "synchuman")


def running(code: str, timeout_s: float = 30) -> Fill:
    return Fill(fill="synchuman", command=(sys.executable, "-c", code, "{in}", "{out}"), timeout_s=timeout_s)


def test_the_words_hold_the_folders_and_no_shell_reads_them() -> None:
    fill = running("import sys; open(sys.argv[2] + '/said', 'w').write(sys.argv[1] + '|' + sys.argv[3])")
    fill = fill.model_copy(update={"command": (*fill.command, "$HOME; {seed} `x`")})
    with exchange("test") as (given, made):
        run_command(fill, VIEWS, given, made, {"seed": "7"})
        assert (made / "said").read_text() == f"{given}|$HOME; 7 `x`"
    assert not given.exists()


def test_a_failing_command_is_quoted_with_its_last_words() -> None:
    with (
        exchange("test") as (given, made),
        pytest.raises(CommandError, match=r"(?s)status 3.*no memory left") as raised,
    ):
        run_command(running("import sys; print('x' * 9000); print('no memory left'); sys.exit(3)"), VIEWS, given, made)
    assert len(str(raised.value)) < 2000


def test_a_command_that_takes_too_long_is_ended_with_all_it_started(tmp_path: Path) -> None:
    child = f"import time; time.sleep(1.5); open({str(tmp_path / 'late')!r}, 'w').write('x')"
    start = f"subprocess.Popen([sys.executable, '-c', {child!r}])"
    code = f"import subprocess, sys, time; {start}; time.sleep(60)"
    with exchange("test") as (given, made), pytest.raises(CommandError, match=r"longer than 0\.8 s.*timeout_s"):
        run_command(running(code, timeout_s=0.8), VIEWS, given, made)
    time.sleep(1.6)
    assert not (tmp_path / "late").exists(), "a child of the command lived on"


def test_what_cannot_be_started_says_so() -> None:
    fill = Fill(fill="synchuman", command=("/no/such/program", "{in}"))
    with exchange("test") as (given, made), pytest.raises(CommandError, match="cannot start '/no/such/program'"):
        run_command(fill, VIEWS, given, made)


def test_passwords_of_the_worker_are_not_handed_on(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PREFECT_API_AUTH_STRING", "ahoy:secret")
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "secret")
    code = "import os, sys; open(sys.argv[2] + '/names', 'w').write(' '.join(os.environ))"
    with exchange("test") as (given, made):
        run_command(running(code), VIEWS, given, made)
        names = (made / "names").read_text().split()
    assert "PATH" in names and not {"PREFECT_API_AUTH_STRING", "AWS_SECRET_ACCESS_KEY"} & set(names)


def test_a_view_that_is_not_left_is_named() -> None:
    code = "import sys, shutil; shutil.copy(sys.argv[1] + '/image.png', sys.argv[2] + '/color_0.png')"
    role = VIEWS.open(running(code))
    mask = torch.zeros(1, 40, 30)
    mask[:, 5:35, 8:22] = 1
    with pytest.raises(CommandError, match=r"expected color_3\.png, color_2\.png, color_1\.png.*got color_0\.png"):
        role(torch.rand(3, 40, 30), mask)
    with pytest.raises(ModelError, match="external command, got none"):
        VIEWS.open(Fill(fill="synchuman"))


def test_nothing_is_left_behind_by_a_command_that_fails() -> None:
    before = set(Path(tempfile.gettempdir()).glob("ahoy-synchuman-*"))
    mask = torch.zeros(1, 40, 30)
    mask[:, 5:35, 8:22] = 1
    with pytest.raises(CommandError):
        VIEWS.open(running("import sys; sys.exit(1)"))(torch.rand(3, 40, 30), mask)
    assert set(Path(tempfile.gettempdir()).glob("ahoy-synchuman-*")) == before


def test_views_come_back_at_the_place_and_size_of_the_silhouette_and_by_side(tmp_path: Path) -> None:
    """The stand-in shrinks, shifts and tints; front, right, back, left have tints of their own."""
    role = VIEWS.open(synchuman(tmp_path))
    image, mask = torch.full((3, 96, 72), 0.8), torch.zeros(1, 96, 72)
    mask[:, 10:90, 26:46] = 1
    views, azimuths = role(image, mask)
    for view in views:
        shown = ((view - GREY).abs().amax(0) > 0.05).float()
        # Two resamplings of half a pixel each, at both ends.
        assert np.allclose(mask_bounds(shown), mask_bounds(mask[0]), atol=2), mask_bounds(shown)
    middle = {azimuth: view[:, 50, 36] for azimuth, view in zip(azimuths, views, strict=True)}
    strongest = {azimuth: int(colour.argmax()) for azimuth, colour in middle.items() if azimuth != 0}
    assert strongest == {270.0: 0, 180.0: 1, 90.0: 2}
