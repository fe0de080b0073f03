"""Break the rasterizer on purpose and see that the tests notice: `python -m tests.mutants.run [NAME ...]`.

Every mutant of `catalogue.py` is applied to a copy of the package, and the tests it names are run against the copy.
The run fails if a patch no longer applies, if a named test does not fail, or if the mutant does not even compile.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import subprocess
import sys
import tempfile
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from itertools import chain
from pathlib import Path

from tests.mutants.catalogue import MUTANTS, Mutant

ROOT = Path(__file__).resolve().parents[2]
COPIED = ("ahoy_core", "tests/__init__.py", "tests/conftest.py", "tests/splat", "tests/numerics", "pyproject.toml")
NOT_A_CATCH = re.compile(
    r"SyntaxError|IndentationError|NameError|ImportError|ModuleNotFoundError|UnboundLocalError"
    r"|TypingError|LoweringError|UnsupportedError"
)


@dataclass(frozen=True)
class Outcome:
    """What became of one mutant; `problem` is empty if every named test caught it."""

    name: str
    problem: str


def copy_project(root: Path, folder: Path) -> None:
    """Copy what the tests need, so that the working tree is never touched."""
    for name in COPIED:
        source, target = root / name, folder / name
        target.parent.mkdir(parents=True, exist_ok=True)
        if source.is_dir():
            shutil.copytree(source, target, ignore=shutil.ignore_patterns("__pycache__", "*.nbc", "*.nbi"))
        else:
            shutil.copy(source, target)


def patch(folder: Path, mutant: Mutant) -> str:
    """Apply the mutant; returns what is wrong with it, or an empty string."""
    path = folder / mutant.file
    if not path.is_file():
        return f"expected the file {mutant.file}, found none: update the catalogue"
    text = path.read_text()
    found = text.count(mutant.old)
    if found != 1:
        return f"expected its text once in {mutant.file}, found it {found} times: update the catalogue"
    path.write_text(text.replace(mutant.old, mutant.new))
    return ""


def failed_tests(folder: Path, tests: Sequence[str]) -> tuple[set[str], str]:
    """Names of the test functions that failed on the copy in this folder, and pytest's output."""
    environment = {**os.environ, "PYTHONPATH": str(folder), "NUMBA_CACHE_DIR": str(folder / "numba")}
    report = folder / "report.xml"
    command = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", f"--rootdir={folder}", f"--junitxml={report}"]
    done = subprocess.run(
        [*command, *(f"tests/{test}" for test in dict.fromkeys(tests))],
        cwd=folder, env=environment, capture_output=True, text=True, check=False,
    )  # fmt: skip
    if done.returncode not in (0, 1) or not report.is_file():
        return set(), f"pytest could not run (exit code {done.returncode})\n{done.stdout}{done.stderr}"
    failed = set()
    for case in ET.parse(report).iter("testcase"):
        reasons = [node.get("message") or "" for node in case if node.tag in ("failure", "error")]
        if reasons and not any(NOT_A_CATCH.search(reason) for reason in reasons):
            failed.add(case.get("name", "").split("[")[0])
    return failed, done.stdout


def judge(snapshot: Path, mutant: Mutant) -> Outcome:
    """Apply one mutant to a copy of the snapshot and run its tests."""
    with tempfile.TemporaryDirectory(prefix="mutant-") as name:
        folder = Path(name)
        copy_project(snapshot, folder)
        if problem := patch(folder, mutant):
            return Outcome(mutant.name, problem)
        failed, output = failed_tests(folder, mutant.tests)
        survived = [test for test in mutant.tests if test.split("::")[1].split("[")[0] not in failed]
        problem = f"not caught by {', '.join(survived)}\n{output[-1500:]}" if survived else ""
        return Outcome(mutant.name, problem)


def baseline(snapshot: Path, mutants: Sequence[Mutant]) -> Outcome:
    """The tests must pass on the code as it is, or their failure proves nothing."""
    with tempfile.TemporaryDirectory(prefix="mutant-") as name:
        folder = Path(name)
        copy_project(snapshot, folder)
        failed, output = failed_tests(folder, [test for mutant in mutants for test in mutant.tests])
        broken = bool(failed) or not re.search(r"\d+ passed", output)
        return Outcome("(no mutant)", f"the tests fail without any mutant\n{output[-3000:]}" if broken else "")


def main() -> int:
    """Run the mutants named on the command line, or all; the exit code is the number of problems."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", help="mutants to run (default: all)")
    parser.add_argument("-j", "--jobs", type=int, default=2, help="mutants at a time (default: 2)")
    arguments = parser.parse_args()
    chosen = [mutant for mutant in MUTANTS if not arguments.names or mutant.name in arguments.names]
    if unknown := set(arguments.names) - {mutant.name for mutant in chosen}:
        parser.error(f"expected names of the catalogue, got {sorted(unknown)}: see tests/mutants/catalogue.py")
    problems = 0
    with tempfile.TemporaryDirectory(prefix="mutants-") as name, ThreadPoolExecutor(arguments.jobs) as pool:
        snapshot = Path(name)
        copy_project(ROOT, snapshot)
        for outcome in chain([baseline(snapshot, chosen)], pool.map(partial(judge, snapshot), chosen)):
            print(f"{'PROBLEM' if outcome.problem else 'caught':8} {outcome.name}  {outcome.problem}", flush=True)
            problems += bool(outcome.problem)
    print(f"{len(chosen)} mutants, {problems} problems")
    return problems


if __name__ == "__main__":
    sys.exit(main())
