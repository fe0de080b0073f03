"""No pickle anywhere, no shell strings: read off the syntax trees of all our packages."""

from __future__ import annotations

from pathlib import Path

import pytest

from .code_rules import broken_rules, modules

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ("ahoy_core", "storage_schema", "tasks", "flows", "benchmarks", "deploy")


def test_our_code_breaks_no_rule() -> None:
    seen = list(modules(ROOT, PACKAGES))
    assert len(seen) > 150, "the scan sees the packages"
    assert {path: broken for path, text in seen if (broken := broken_rules(text, path))} == {}


@pytest.mark.parametrize(
    "bad",
    [
        "import pickle",
        "import cloudpickle as cp",
        "from joblib import load",
        "def f():\n    from pickle import loads",
        "import torch\ntorch.load('a.pt')",
        "from torch import load\nload('a.pt', weights_only=False)",
        "import numpy as np\nnp.load('a.npy', allow_pickle=True)",
        "import numpy as np\nnp.load('a.npy', allow_pickle=flag)",
        "import pandas as pd\npd.read_pickle('a')",
        "import yaml\nyaml.load(text, Loader=yaml.Loader)",
        "eval('1')",
        "exec(code)",
        "import os\nos.system('ls')",
        "from os import popen\npopen('ls')",
        "import subprocess\nsubprocess.run('ls -l')",
        "import subprocess\nsubprocess.run(f'rm {path}')",
        "import subprocess\nsubprocess.run('rm ' + path)",
        "import subprocess as sp\nsp.Popen(args='ls')",
        "from subprocess import run\nrun(['ls'], shell=True)",
        "import subprocess\nsubprocess.run(['sh', '-c', text])",
        "import asyncio\nasyncio.create_subprocess_shell('ls')",
        "from prefect import task\ntask(persist_result=True)",
        "import tempfile\ntempfile.mktemp()",
        "import tarfile\ntarfile.open('a').extractall()",
        "from jinja2 import Environment\nEnvironment(loader=x)",
        "import av\nav.open(path)",
        "import cv2\ncv2.VideoCapture(path)",
        "class A:\n    def __reduce__(self):\n        return None",
    ],
)
def test_the_scan_sees_what_it_is_for(bad: str) -> None:
    assert broken_rules(bad)


@pytest.mark.parametrize(
    "good",
    [
        "import torch\ntorch.load('a.pt', weights_only=True)",
        "import numpy as np\nnp.load('a.npy', allow_pickle=False)",
        "import subprocess\nsubprocess.run([sys.executable, '-m', 'pip', name])",
        "import subprocess\nsubprocess.run([*command, path], shell=False)",
        "import subprocess\nsubprocess.Popen(command)",
        "import yaml\nyaml.safe_load(text)",
        "model.eval()",
        "from prefect import flow\nflow(persist_result=False)",
        "import numpy as np\nnp.load('a.npy')",
    ],
)
def test_the_scan_lets_good_code_pass(good: str) -> None:
    assert broken_rules(good) == []


def test_media_may_be_opened_where_it_is_guarded() -> None:
    assert broken_rules("import av\nav.open(path)", "ahoy_core/formats/video_open.py") == []
