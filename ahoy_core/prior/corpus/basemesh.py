"""MakeHuman's base mesh hm08 with its invisible helper geometry, from which garments hang (needs the extra `train`)."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ahoy_core.body.packaged import PackagedBody
from ahoy_core.prior.corpus.makehuman import Garment

Array = NDArray[Any]

DECIMETRES = 10.0  # hm08's unit, a metre's tenth


class BaseMesh:
    """All 19,158 vertices of hm08 for any shape, with skinning weights on the joints of the packaged body.

    Args:
        body: the packaged body; its rest space is the mesh's own.

    Raises:
        ImportError: without `anny`, which carries the helper geometry.
    """

    def __init__(self, body: PackagedBody) -> None:
        self._model = _library()
        self._names = list(self._model.phenotype_labels)
        self.body = body
        parents = [int(p) for p in self._model.bone_parents]
        columns: list[int] = []
        for bone, name in enumerate(self._model.bone_labels):
            known = name in body.joint_names
            columns.append(body.joint_names.index(name) if known else columns[parents[bone]])
        indices = np.asarray(columns)[self._model.vertex_bone_indices.numpy()]
        self.lbs_weights: Array = np.zeros((len(indices), body.n_joints))
        np.add.at(
            self.lbs_weights, (np.arange(len(indices))[:, None], indices), self._model.vertex_bone_weights.numpy()
        )
        self.lbs_weights /= np.maximum(self.lbs_weights.sum(1, keepdims=True), 1e-9)

    def vertices(self, betas: Tensor) -> Array:
        """The mesh at rest [19158,3], metres, for a shape [S]."""
        values = {name: betas[k : k + 1].double() for k, name in enumerate(self._names)}
        with torch.no_grad():
            output = self._model(phenotype_kwargs=values)
        return np.asarray(output["rest_vertices"][0].numpy())

    def fit(self, garment: Garment, vertices: Array) -> tuple[Array, Array]:
        """A garment on a shaped body: its vertices at rest [V,3] in metres, and their skinning weights [V,J]."""
        mesh = DECIMETRES * np.stack([vertices[:, 0], vertices[:, 2], -vertices[:, 1]], 1)
        offsets = garment.offsets.copy()
        for axis, scale in enumerate(garment.scales):
            if scale is not None:
                first, second, distance = scale
                offsets[:, axis] *= abs(mesh[first, axis] - mesh[second, axis]) / distance
        fitted = np.einsum("nk,nkd->nd", garment.weights, mesh[garment.corners]) + offsets
        rest = np.stack([fitted[:, 0], -fitted[:, 2], fitted[:, 1]], 1) / DECIMETRES
        positive = np.clip(garment.weights, 0, None)
        positive /= positive.sum(1, keepdims=True)
        return rest, np.einsum("nk,nkj->nj", positive, self.lbs_weights[garment.corners])


@lru_cache(maxsize=1)
def _library() -> Any:
    try:
        from anny import Anny
        from anny.models.legacy import legacy_rig_to_anny
    except ImportError as error:
        raise ImportError("expected the package anny 0.6.2, got none; run pip install 'ahoy-avatars[train]'") from error
    return Anny(
        rig=legacy_rig_to_anny("default", "blender-rootidentity"),
        topology="anny-quads-full",
        phenotypes="default",
        pose_parameterization="local-ref",
        skinning_method="lbs",
    )
