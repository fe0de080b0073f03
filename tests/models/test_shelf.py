"""Networks read before a fork: every adapter makes of them what it makes of its files, without reading those again."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import torch

from ahoy_core.models import checkpoint, shelf
from ahoy_core.models.adapter import Fill
from ahoy_core.models.catalogue import ADAPTERS, adapter
from tasks.fills import Fills
from tasks.model_check import PROBES
from tests.models.checkpoints import build
from tests.models.conftest import Tiny

ROOT = Path(__file__).resolve().parents[2]
BY_SHELF = [
    (each.role, each.name) for each in ADAPTERS if not each.is_command and each.role not in ("body", "perceptual")
]
"""Those of networks large enough to keep; LPIPS' are read in milliseconds, and bodies are tables."""


@pytest.fixture(autouse=True)
def _empty_shelf(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shelf, "_kept", {})


def _answer(role: str, model: Any) -> dict[str, Any]:
    torch.manual_seed(3)
    with torch.no_grad():
        answer: dict[str, Any] = PROBES[role](model)
    return answer


class ReadAgainError(BaseException):
    """Not an `Exception`, which loaders turn into words about broken files."""


def _read_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: Any, **__: Any) -> Any:
        raise ReadAgainError

    monkeypatch.setattr(checkpoint, "_complete", refuse)
    monkeypatch.setattr(torch.jit, "load", refuse)


@pytest.mark.parametrize(("role", "name"), BY_SHELF)
def test_what_was_read_before_a_fork_answers_as_what_is_read_anew(
    role: str, name: str, tiny: Tiny, monkeypatch: pytest.MonkeyPatch
) -> None:
    fill, declared = tiny(role, name), adapter(role, name)
    anew = _answer(role, declared.open(fill))
    with shelf.filling():
        declared.open(fill)
    _read_nothing(monkeypatch)
    kept = _answer(role, declared.open(fill))
    assert anew.keys() == kept.keys()
    for key, value in anew.items():
        assert torch.equal(value, kept[key]) if isinstance(value, torch.Tensor) else value == kept[key]
    with pytest.raises(ReadAgainError):  # whoever took it may have changed it
        declared.open(fill)


def test_a_file_that_changed_is_read_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fill = build("head", "sapiens2", tmp_path)
    with shelf.filling():
        adapter("head", "sapiens2").open(fill)
    assert fill.path is not None
    weights = fill.path / "model.safetensors"
    os.utime(weights, ns=(0, 0))
    _read_nothing(monkeypatch)
    with pytest.raises(ReadAgainError):
        adapter("head", "sapiens2").open(fill)


def test_a_gpus_models_are_kept_for_forks_and_a_cold_one_is_not(tiny: Tiny, monkeypatch: pytest.MonkeyPatch) -> None:
    """The device alone is imagined; nothing is put on it while models are being read for forks."""
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    fill = tiny("head", "sapiens2").model_copy(update={"device": "cuda"})
    assert Fills({"head": fill.model_copy(update={"warm": False})}).preload() == [] and not shelf._kept
    assert Fills({"head": fill}).preload() == ["head"]
    (network,) = shelf._kept.values()
    weights = {(w.device.type, w.dtype) for w in network.parameters()}
    assert weights == {("cpu", torch.bfloat16)}, "in the GPU's type, in the CPU's memory"


FORK = """
import os, sys
import torch
from ahoy_core.models import checkpoint, shelf
from ahoy_core.models.adapter import Fill
from ahoy_core.models.catalogue import adapter
from tasks.model_check import PROBES

torch.set_num_threads(1)
fill = Fill.model_validate_json(sys.argv[1])
with shelf.filling():
    adapter("video", fill.fill).open(fill)

def refuse(*_):
    raise AssertionError("weights were read again")

checkpoint._complete = refuse
for run in range(2):
    if (pid := os.fork()) == 0:
        with torch.no_grad():
            print(run, PROBES["video"](adapter("video", fill.fill).open(fill)).keys(), flush=True)
        os._exit(0)
    assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 0
"""


def test_one_reading_serves_the_runs_of_several_forks(tiny: Tiny) -> None:
    fill: Fill = tiny("video", "wan2.2-5b")
    done = subprocess.run(
        [sys.executable, "-c", FORK, fill.model_dump_json()], cwd=ROOT, capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stderr[-2000:]
    assert [line.split()[0] for line in done.stdout.splitlines() if line[:1].isdigit()] == ["0", "1"]
