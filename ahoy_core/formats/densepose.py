"""DensePose's table of its 24 charts on the SMPL mesh: the user's `UV_Processed.mat`.

Nothing of it ships with the package. Names and numbering are the file's: `All_vertices` [1,N] is the SMPL vertex (from
1) that each of N chart points is, `All_U_norm` and `All_V_norm` [N,1] its place in its chart, `All_Faces` [F,3]
triangles of chart points (from 1), `All_FaceIndices` [F,1] the chart of each triangle, 1 to 24.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy.io import loadmat

from ahoy_core.formats.errors import BodyFileError

CHARTS: Final = 24
SMPL_VERTICES: Final = 6890
_NAMES: Final = ("All_vertices", "All_U_norm", "All_V_norm", "All_Faces", "All_FaceIndices")


@dataclass(frozen=True)
class ChartTable:
    """Charts on the SMPL mesh, numbered from 0 but for the charts.

    Attributes:
        vertices: [N] SMPL vertex of each chart point.
        uv: [N,2] in [0,1].
        faces: [F,3] into chart points.
        chart: [F] 1 to 24, of each triangle.
    """

    vertices: NDArray[np.int64]
    uv: NDArray[np.float64]
    faces: NDArray[np.int64]
    chart: NDArray[np.int64]


def read_chart_table(path: Path) -> ChartTable:
    """Read the table; MATLAB's format holds arrays, and nothing in it is executed.

    Raises:
        BodyFileError: it is no such table; the text says what is missing or does not fit.
    """
    try:
        held: dict[str, Any] = loadmat(path, variable_names=list(_NAMES))
    except Exception as error:  # scipy's reader raises whatever it meets in a broken file
        raise BodyFileError(
            f"expected DensePose's UV_Processed.mat, got {path.name!r}, which cannot be read as a MATLAB file "
            f"({type(error).__name__}: {error}); take it from DensePose's own download of UV data"
        ) from error
    if missing := [name for name in _NAMES if name not in held]:
        raise BodyFileError(f"expected {', '.join(_NAMES)} in {path.name!r}, got no {', '.join(missing)}")
    vertices, u, v, chart = (held[name].ravel() for name in ("All_vertices", "All_U_norm", "All_V_norm", _NAMES[-1]))
    faces = held["All_Faces"].astype(np.int64) - 1
    table = ChartTable(
        vertices.astype(np.int64) - 1, np.stack([u, v], -1).astype(np.float64), faces, chart.astype(np.int64)
    )
    _check(path.name, table)
    return table


def _check(name: str, table: ChartTable) -> None:
    points = len(table.vertices)
    fits = {
        "one u and v a chart point": len(table.uv) == points and bool(np.isfinite(table.uv).all()),
        "u and v in [0,1]": bool((table.uv >= 0).all() and (table.uv <= 1).all()),
        f"vertices of SMPL (1 to {SMPL_VERTICES})": points > 0
        and bool((table.vertices >= 0).all() and (table.vertices < SMPL_VERTICES).all()),
        "triangles of chart points": table.faces.ndim == 2
        and table.faces.shape[1] == 3
        and bool((table.faces >= 0).all() and (table.faces < points).all()),
        f"charts 1 to {CHARTS}, one a triangle": len(table.chart) == len(table.faces)
        and set(np.unique(table.chart).tolist()) <= set(range(1, CHARTS + 1)),
    }
    if wrong := [what for what, true in fits.items() if not true]:
        raise BodyFileError(f"expected in {name!r} {'; '.join(wrong)}; it is damaged or another table")
