"""The catalogue of mutants stays applicable and covers every hard case (`make mutants` runs it)."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

from tests.mutants.catalogue import MUTANTS, Mutant

ROOT = Path(__file__).resolve().parents[2]


def functions_of(path: Path) -> set[str]:
    tree = ast.parse(path.read_text())
    names = {node.name for node in tree.body if isinstance(node, ast.FunctionDef) and node.name.startswith("test_")}
    return {f"{path.relative_to(ROOT / 'tests').as_posix()}::{name}" for name in names}


@pytest.mark.parametrize("mutant", MUTANTS, ids=lambda mutant: mutant.name)
def test_the_patch_applies_exactly_once_and_changes_something(mutant: Mutant) -> None:
    assert (ROOT / mutant.file).read_text().count(mutant.old) == 1
    assert mutant.old != mutant.new


def test_every_hard_case_has_a_mutant_that_it_catches() -> None:
    hard = set().union(*(functions_of(path) for path in sorted((ROOT / "tests" / "numerics").glob("test_*.py"))))
    named = {test.split("[")[0] for mutant in MUTANTS for test in mutant.tests}
    assert not hard - named, "hard cases without a mutant"


def test_every_named_test_exists_and_names_are_unique() -> None:
    for test in {test.split("[")[0] for mutant in MUTANTS for test in mutant.tests}:
        assert test in functions_of(ROOT / "tests" / test.split("::")[0]), test
    assert len({mutant.name for mutant in MUTANTS}) == len(MUTANTS)
