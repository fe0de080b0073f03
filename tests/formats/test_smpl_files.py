"""Licensed body files that cannot be used are refused with a word on what to do; nothing in them is executed."""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np
import pytest

from ahoy_core.formats.errors import BodyFileError
from ahoy_core.formats.smpl import read_obj_uv, read_smpl
from tests.body import licensed

TRIPPED: list[str] = []


def trip(word: str) -> str:
    TRIPPED.append(word)
    return word


class Trap:
    """A pickled object that runs code when it is opened."""

    def __reduce__(self) -> tuple[object, tuple[str]]:
        return trip, ("opened",)


def small(**changes: np.ndarray | None) -> dict[str, np.ndarray]:
    """A file of SMPL's layout with six vertices: the reader asks for consistent sizes, not for the true ones."""
    rng = np.random.default_rng(0)
    held: dict[str, np.ndarray | None] = {
        "v_template": rng.normal(size=(6, 3)),
        "shapedirs": rng.normal(size=(6, 3, 10)),
        "posedirs": rng.normal(size=(6, 3, 207)),
        "J_regressor": np.full((24, 6), 1 / 6),
        "kintree_table": np.array([[2**32 - 1, *licensed.parents("smpl")[1:]], range(24)], dtype=np.int64),
        "weights": np.full((6, 24), 1 / 24),
        "f": np.array([[0, 1, 2], [3, 4, 5]], dtype=np.uint32),
        **changes,
    }
    return {key: value for key, value in held.items() if value is not None}


def test_a_consistent_file_is_read_with_its_tree(tmp_path: Path) -> None:
    np.savez(tmp_path / "model.npz", **small())
    file = read_smpl(tmp_path / "model.npz")
    assert file.kind == "smpl"
    assert file.parents == tuple(licensed.parents("smpl"))


def test_python_objects_beside_the_arrays_are_never_opened(tmp_path: Path) -> None:
    np.savez(tmp_path / "model.npz", **small(part2num=np.array(Trap(), dtype=object)))
    TRIPPED.clear()
    read_smpl(tmp_path / "model.npz")
    assert not TRIPPED
    with np.load(tmp_path / "model.npz", allow_pickle=True) as archive:
        _ = archive["part2num"]
    assert TRIPPED, "the trap works"


def test_a_pickle_is_refused_unopened_and_told_how_to_convert(tmp_path: Path) -> None:
    path = tmp_path / "SMPL_NEUTRAL.pkl"
    path.write_bytes(pickle.dumps(Trap()))
    TRIPPED.clear()
    with pytest.raises(BodyFileError, match=r"convert the file once as docs/models\.md shows"):
        read_smpl(path)
    assert not TRIPPED


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"weights": None}, r"none of \['weights'\]"),
        ({"weights": np.ones((6, 16)) / 16}, r"24 \(smpl\).*got 16"),
        ({"posedirs": np.zeros((6, 3, 459))}, r"posedirs \(6, 3, 207\)"),
        ({"v_template": np.zeros((5, 3))}, r"\(5,"),
        ({"v_template": np.full((6, 3), np.nan)}, "finite numbers in v_template"),
        ({"f": np.array([[0, 1, 6]])}, r"triangles of vertices 0\.\.5"),
        ({"J_regressor": np.array({"a": "sparse matrix"}, dtype=object)}, "convert it as docs"),
        ({"kintree_table": np.zeros((2, 24), dtype=int) + 5}, "parents before children"),
    ],
)
def test_what_is_wrong_is_named(tmp_path: Path, change: dict[str, np.ndarray | None], message: str) -> None:
    np.savez(tmp_path / "model.npz", **small(**change))
    with pytest.raises(BodyFileError, match=message):
        read_smpl(tmp_path / "model.npz")


def test_a_missing_and_a_damaged_file_are_told_apart(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        read_smpl(tmp_path / "nowhere.npz")
    (tmp_path / "broken.npz").write_bytes(b"PK\x03\x04 and no more")
    with pytest.raises(BodyFileError, match=r"broken\.npz"):
        read_smpl(tmp_path / "broken.npz")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("v 0 0 0\nf 1 2 3\n", "corners v/vt"),
        ("v 0 0 0\nvt 0 0\nf 1/1 2/1 3/1 4/1\n", "triangles with texture coordinates"),
        ("vt 0 0\nf 1/1 2/1 3/1\n", "it is another mesh"),
        ("", "got 0 polygons"),
    ],
)
def test_an_obj_of_another_kind_is_refused(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "uv.obj").write_text(text)
    with pytest.raises(BodyFileError, match=message):
        read_obj_uv(tmp_path / "uv.obj", small()["f"])


def test_corners_keep_their_coordinates_whatever_their_order(tmp_path: Path) -> None:
    (tmp_path / "uv.obj").write_text("vt 0 0\nvt 1 0\nvt 0 1\nf 5/3/1 6/1/1 4/2/1\nf 2/2 3/3 1/1\n")
    uvs, uv_faces = read_obj_uv(tmp_path / "uv.obj", small()["f"])
    np.testing.assert_array_equal(uv_faces, [[0, 1, 2], [1, 2, 0]])
    np.testing.assert_array_equal(uvs, [[0, 0], [1, 0], [0, 1]])
