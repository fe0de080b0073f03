"""Keys change with what a result depends on, and with nothing else."""

from __future__ import annotations

import hashlib
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from storage_schema.keys import canonical_json, file_sha256, stage_key

# Text without lone surrogates: those are not Unicode and are refused (tested below).
TEXT = st.text(st.characters(exclude_categories=["Cs"]), max_size=6)
LEAVES = st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | TEXT
VALUES = st.recursive(LEAVES, lambda v: st.lists(v, max_size=3) | st.dictionaries(TEXT, v, max_size=3), max_leaves=8)
CONFIGS = st.dictionaries(TEXT, VALUES, min_size=1, max_size=4)
HASH = hashlib.sha256(b"input").hexdigest()


def reordered(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: reordered(value[key]) for key in reversed(value)}
    return [reordered(item) for item in value] if isinstance(value, list) else value


def identity(value: Any) -> Any:
    """The value with its types, in a form where == means the same: 1, 1.0, True, 0.0 and -0.0 are told apart."""
    if isinstance(value, dict):
        return frozenset((key, identity(item)) for key, item in value.items())
    if isinstance(value, list):
        return tuple(identity(item) for item in value)
    return type(value), value.hex() if isinstance(value, float) else value


def key_of(config: Any) -> str:
    return stage_key("toy", 1, config, {"video": HASH}, {"body": HASH})


@given(CONFIGS)
def test_the_order_in_which_keys_are_given_does_not_matter(config: dict[str, Any]) -> None:
    assert key_of(config) == key_of(reordered(config))


@given(CONFIGS, VALUES, st.data())
def test_any_change_of_any_value_changes_the_key(config: dict[str, Any], value: Any, data: st.DataObject) -> None:
    name = data.draw(st.sampled_from(sorted(config)))
    assume(identity(config[name]) != identity(value))
    assert key_of(config) != key_of({**config, name: value})
    assert key_of(config) != key_of({k: v for k, v in config.items() if k != name})


@given(st.floats(allow_nan=False, allow_infinity=False))
def test_floats_are_exact_to_the_last_bit(number: float) -> None:
    neighbour = math.nextafter(number, math.inf)
    assume(math.isfinite(neighbour))
    assert key_of({"x": number}) != key_of({"x": neighbour})


@given(VALUES, VALUES)
def test_two_values_have_the_same_json_exactly_if_they_are_the_same(one: Any, other: Any) -> None:
    assert (canonical_json(one) == canonical_json(other)) == (identity(one) == identity(other))


def test_every_part_of_a_stage_counts() -> None:
    other = hashlib.sha256(b"other").hexdigest()
    keys = {
        stage_key("toy", 1, {}, {}, {}),
        stage_key("toy", 2, {}, {}, {}),
        stage_key("other", 1, {}, {}, {}),
        stage_key("toy", 1, {"a": None}, {}, {}),
        stage_key("toy", 1, {}, {"a": HASH}, {}),
        stage_key("toy", 1, {}, {"b": HASH}, {}),
        stage_key("toy", 1, {}, {"a": other}, {}),
        stage_key("toy", 1, {}, {}, {"a": HASH}),
    }
    assert len(keys) == 8


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, "\ud800"])
def test_values_that_json_cannot_hold_are_refused_with_their_place(bad: Any) -> None:
    with pytest.raises(ValueError, match=r"key\.config\.a\[1\]"):
        key_of({"a": [0, bad]})


@pytest.mark.parametrize("bad", [{1}, b"x", Path("x"), np.float32(1), np.zeros(2), object(), 1j, {1: 2}])
def test_types_that_are_not_json_are_refused_with_their_place(bad: Any) -> None:
    with pytest.raises(TypeError, match=r"key\.config\.a"):
        key_of({"a": bad})


@pytest.mark.parametrize("path", ["videos/clip.mp4", "C:\\clip", "../x", "", "a b", 3])
def test_an_input_given_as_a_path_is_refused(path: Any) -> None:
    with pytest.raises(ValueError, match="file_sha256"):
        stage_key("toy", 1, {}, {"video": path}, {})


@pytest.mark.parametrize(
    ("stage", "version"), [("../x", 1), ("Toy", 1), ("", 1), ("toy", 0), ("toy", True), ("toy", 1.0)]
)
def test_bad_stages_and_versions_are_refused(stage: str, version: Any) -> None:
    with pytest.raises(ValueError, match="expected"):
        stage_key(stage, version, {}, {}, {})


def test_a_file_is_known_by_its_bytes_and_progress_adds_up_to_its_size(tmp_path: Path) -> None:
    data = np.random.default_rng(0).bytes(3_000_000)
    (tmp_path / "a").write_bytes(data)
    pieces: list[int] = []
    assert file_sha256(tmp_path / "a", pieces.append) == hashlib.sha256(data).hexdigest()
    assert sum(pieces) == len(data) and len(pieces) > 1
