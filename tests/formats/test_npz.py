"""Equal arrays give equal bytes; nothing is executed; nothing is half written."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from ahoy_core.formats.errors import NpzError
from ahoy_core.formats.npz import load_npz, save_npz

DTYPES = st.sampled_from(["uint8", "int32", "int64", "float32", "float64", "bool", "U5", ">f4", "complex64"])
SHAPES = hnp.array_shapes(min_dims=0, max_dims=4, min_side=0, max_side=4)


@settings(deadline=None, max_examples=60)
@given(
    arrays=st.dictionaries(
        st.text("abcxyz_", min_size=1, max_size=6), DTYPES.flatmap(lambda d: hnp.arrays(d, SHAPES)), max_size=4
    ),
    compress=st.booleans(),
)
def test_round_trip_is_lossless(tmp_path_factory: pytest.TempPathFactory, arrays: dict, compress: bool) -> None:
    path = tmp_path_factory.mktemp("npz") / "a.npz"
    save_npz(path, arrays, compress=compress)
    back = load_npz(path)
    assert set(back) == set(arrays)
    for name, values in arrays.items():
        assert back[name].dtype == values.dtype.newbyteorder("<") and back[name].shape == values.shape
        np.testing.assert_array_equal(back[name], values)


@pytest.mark.parametrize("compress", [False, True])
def test_bytes_depend_on_the_values_alone(tmp_path: Path, compress: bool) -> None:
    values = np.arange(24, dtype=np.float32).reshape(4, 6)
    other = np.arange(3)
    save_npz(tmp_path / "a.npz", {"x": values, "y": other}, compress=compress)
    os.utime(tmp_path / "a.npz", (0, 0))
    save_npz(tmp_path / "b.npz", {"y": other, "x": np.asfortranarray(values.astype(">f4"))}, compress=compress)
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()
    save_npz(tmp_path / "c.npz", {"x": values + 1, "y": other}, compress=compress)
    assert (tmp_path / "a.npz").read_bytes() != (tmp_path / "c.npz").read_bytes()


def test_bytes_are_the_same_in_another_process_and_umask(tmp_path: Path) -> None:
    program = (
        "import os,sys,numpy as np; os.umask(0o077)\n"
        "from ahoy_core.formats.npz import save_npz\n"
        "save_npz(sys.argv[1], {'x': np.arange(5)})"
    )
    subprocess.run([sys.executable, "-c", program, str(tmp_path / "a.npz")], check=True)
    save_npz(tmp_path / "b.npz", {"x": np.arange(5)})
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()


def test_numpy_reads_what_we_write_and_we_read_what_numpy_writes(tmp_path: Path) -> None:
    save_npz(tmp_path / "ours.npz", {"x": np.arange(5)})
    with np.load(tmp_path / "ours.npz") as archive:
        assert archive["x"].tolist() == [0, 1, 2, 3, 4]
    np.savez_compressed(tmp_path / "theirs.npz", x=np.arange(5))
    assert load_npz(tmp_path / "theirs.npz")["x"].tolist() == [0, 1, 2, 3, 4]


def test_only_the_named_arrays_are_read(tmp_path: Path) -> None:
    save_npz(tmp_path / "a.npz", {"x": np.arange(5), "y": np.arange(2)})
    assert set(load_npz(tmp_path / "a.npz", ["y"])) == {"y"}
    with pytest.raises(NpzError, match=r"expected arrays \['z'\].*got only \['x', 'y'\]"):
        load_npz(tmp_path / "a.npz", ["z"])


def test_python_objects_are_neither_written_nor_read(tmp_path: Path) -> None:
    objects = np.array([{"a": 1}], dtype=object)
    with pytest.raises(NpzError, match="Python objects in 'x'"):
        save_npz(tmp_path / "a.npz", {"x": objects})
    np.savez(tmp_path / "b.npz", x=objects)
    with pytest.raises(NpzError, match="plain arrays"):
        load_npz(tmp_path / "b.npz")


@pytest.mark.parametrize("name", ["", "a/b", "..\\x"])
def test_names_that_are_paths_are_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(NpzError, match="plain array names"):
        save_npz(tmp_path / "a.npz", {name: np.arange(2)})


@pytest.mark.parametrize("keep", [0, 10, 0.5, 0.99])
def test_cut_off_files_are_refused(tmp_path: Path, keep: float) -> None:
    save_npz(tmp_path / "a.npz", {"x": np.arange(1000)})
    data = (tmp_path / "a.npz").read_bytes()
    (tmp_path / "a.npz").write_bytes(data[: int(keep if keep > 1 else keep * len(data))])
    with pytest.raises(NpzError, match="expected a complete"):
        load_npz(tmp_path / "a.npz")


def test_flipped_byte_is_noticed(tmp_path: Path) -> None:
    save_npz(tmp_path / "a.npz", {"x": np.arange(1000)})
    data = bytearray((tmp_path / "a.npz").read_bytes())
    data[len(data) // 2] ^= 1
    (tmp_path / "a.npz").write_bytes(data)
    with pytest.raises(NpzError, match="CRC"):
        load_npz(tmp_path / "a.npz")


def test_single_npy_is_refused(tmp_path: Path) -> None:
    with (tmp_path / "a.npz").open("wb") as handle:
        np.save(handle, np.arange(3))
    with pytest.raises(NpzError, match="archive"):
        load_npz(tmp_path / "a.npz")


def test_failure_while_writing_leaves_the_older_file_and_no_rest(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    save_npz(tmp_path / "a.npz", {"x": np.arange(3)})
    before = (tmp_path / "a.npz").read_bytes()

    def full(*_args: object, **_options: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("numpy.lib.format.write_array", full)
    with pytest.raises(OSError, match="No space left"):
        save_npz(tmp_path / "a.npz", {"x": np.arange(9)})
    assert (tmp_path / "a.npz").read_bytes() == before and len(list(tmp_path.iterdir())) == 1


def test_missing_file_is_a_file_not_found_error(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        load_npz(tmp_path / "none.npz")
