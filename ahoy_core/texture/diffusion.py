"""Smooth fills on the surface: a coarse one over the mesh's vertices and a seamless one over the atlas's texels.

Both minimise  sum_links w (u_i - u_j - g_ij)^2 + sum_i s_i (u_i - target_i)^2  with some u given: harmonic where g
and s are 0 (Laplace), gradient-preserving where g is not (Poisson image editing, Perez et al. 2003), and pulled to a
target where s is not.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import cg, splu
from scipy.spatial import cKDTree

from ahoy_core.texture.rays import BoolArray, FloatArray, IntArray

# Links between separate pieces of a mesh (eyeballs, eyelashes and the head): weak, so that they only matter where
# nothing else speaks.
BRIDGE_WEIGHT = 1e-3
BRIDGE_NEIGHBOURS = 4
# Keeps a system without a single given colour regular.
LEAST_PULL = 1e-6
# The fill is stored in 8 bits; a relative residual of 1e-3 is below one level.
CG_TOLERANCE = 1e-3
CG_ITERATIONS = 400


@dataclass(frozen=True)
class Pull:
    """Soft targets: target [N,D] with strength [N] >= 0 (1: as strong as one link)."""

    target: FloatArray
    strength: FloatArray


def solve_links(
    pairs: IntArray,
    weights: FloatArray,
    given: FloatArray,
    fixed: BoolArray,
    pull: Pull,
    gradient: FloatArray | None = None,
    direct: bool = False,
) -> FloatArray:
    """Minimise the energy above.

    Args:
        pairs: [E,2] linked nodes.
        weights: [E] positive.
        given: [N,D] values of the fixed nodes; of the others, where the iterations start.
        fixed: [N] bool.
        pull: soft targets.
        gradient: [E,D] wanted differences value[first] - value[second]; None for zero.
        direct: factorise (small systems) instead of iterating.

    Returns:
        [N,D] float64; fixed nodes keep their given values.
    """
    result = np.array(given, dtype=np.float64)
    free = np.flatnonzero(~fixed)
    if len(free) == 0:
        return result
    count = len(fixed)
    first, second = pairs[:, 0], pairs[:, 1]
    strength = np.maximum(pull.strength, LEAST_PULL)
    off = sparse.coo_array((weights, (first, second)), shape=(count, count))
    adjacency = (off + off.T).tocsr()
    diagonal = np.asarray(adjacency.sum(axis=1)).ravel() + strength
    right = strength[:, None] * pull.target
    if gradient is not None:
        flow = weights[:, None] * gradient
        for channel in range(flow.shape[1]):
            right[:, channel] += np.bincount(first, flow[:, channel], count) - np.bincount(
                second, flow[:, channel], count
            )
    known = np.where(fixed[:, None], result, 0)
    right = (right + adjacency @ known)[free]
    matrix = (sparse.diags_array(diagonal[free]) - adjacency[free][:, free]).tocsc()
    if direct:
        result[free] = splu(matrix).solve(right)
        return result
    matrix = matrix.tocsr()
    precondition = sparse.diags_array(1 / diagonal[free])
    for channel in range(result.shape[1]):
        start = result[free, channel]
        result[free, channel], _ = cg(
            matrix, right[:, channel], x0=start, rtol=CG_TOLERANCE, maxiter=CG_ITERATIONS, M=precondition
        )
    return result


def vertex_links(faces: IntArray, vertices: FloatArray) -> tuple[IntArray, FloatArray]:
    """Pairs [E,2] and weights [E] over a mesh's edges, with weak bridges between its separate pieces."""
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    edges = np.unique(edges, axis=0)
    count = min(BRIDGE_NEIGHBOURS + 1, len(vertices))
    _, near = cKDTree(vertices).query(vertices, k=count)
    near = near.reshape(len(vertices), count)
    bridges = np.stack([np.repeat(np.arange(len(vertices)), count - 1), near[:, 1:].ravel()], axis=1)
    pairs = np.concatenate([edges, bridges]).astype(np.int64)
    weights = np.concatenate([np.ones(len(edges)), np.full(len(bridges), BRIDGE_WEIGHT)])
    return pairs, weights
