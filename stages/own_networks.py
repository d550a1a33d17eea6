"""The networks this product brings along, trained on generated bodies only (docs/networks.md)."""

from __future__ import annotations

import hashlib
import io
from pathlib import Path

import numpy as np

from stages.onnx_runtime import open_session

WEIGHTS = Path(__file__).parent / "weights"
CATEGORIES = ("quadruped", "human")
DIGESTS = {
    "posenet-quadruped.onnx": "d07aacb02603fb6e3aef885cb47ecb08912d40e5f0ec408c86842e248730baf3",
    "posenet-human.onnx": "d2e2a25b8e9e82b84e6d616471c5d07078b2b0560cad0e0a6e87df25ce17e866",
    "quadruped.npz": "08131d368bb1b29ac53b50747c55186bab028996b8e0a1b92598f7c03aaa02ed",
    "human.npz": "95b6eebf697fe08a808e36dd866b8130d306c1b612b96f3e7979c2fc18e4e99e",
    "refine-int8.onnx": "5d7d4926aef1b59f2dcf7b0cb8ada7f01713f143a95bdaf3519d87cf5786fc28",
    "finder-int8.onnx": "705a6cd33ea5cca6cf91cd8cdb1483fd7c84bff9bb191610105fddc4b2754abd",
    "trunk-int8.onnx": "76f2bdbe04278e2b25b3b91db130af831653a2df15c4fc2753e004db0a276cf4",
    "quadruped-skeleton.npz": "aabfb977e9d3dab9fc71b28930737a8da2837fa47dfe0ac5b703ca83574b950a",
    "human-skeleton.npz": "a2f5140035bcfba243a3ac916b55fa8c415e76c00904a8233e49cd5872d2d111",
}
"""sha256 of the files this code was written with; they are code as far as a result's key is concerned."""


class WeightsDamaged(RuntimeError):
    """A file of ours is missing or not what it should be: the installation is at fault."""


class OwnNetwork:
    """A category's PoseNet: view, dense mask and embedding, category (see stages.perception.viewpoint.PoseNetwork)."""

    def __init__(self, category: str, *, device: str = "cpu", threads: int = 1) -> None:
        self.category = category
        self.name = f"posenet-{category}.onnx"
        self._session = open_session(_read(self.name), device, threads)
        self.providers: list[str] = self._session.get_providers()
        self._outputs = [o.name for o in self._session.get_outputs()]

    def __call__(self, inputs: np.ndarray) -> dict[str, np.ndarray]:
        """`view` (N, 60), `dense` (N, 17, 48, 48), `category` (N, 3) of (N, 4, 96, 96) float32."""
        return dict(zip(self._outputs, self._session.run(None, {"input": inputs.astype(np.float32)}), strict=True))


class _OwnFile:
    """A file of ours, opened. In 8-bit integers: for processors, on which these networks run."""

    name: str

    def __init__(self, *, threads: int = 1) -> None:
        self._session = open_session(_read(self.name), "cpu", threads)


class OwnRefiner(_OwnFile):
    """The network that makes rough masks exact (see stages.perception.refining.RefiningNetwork)."""

    name = "refine-int8.onnx"

    def __call__(self, inputs: np.ndarray) -> np.ndarray:
        """(N, S, S) logits of (N, 4, S, S) float32, S a multiple of 16."""
        (logit,) = self._session.run(["logit"], {"input": inputs.astype(np.float32)})
        return np.asarray(logit[:, 0])


class OwnTrunk(_OwnFile):
    """What the categories' networks share (see stages.perception.lost_frames.TrunkNetwork)."""

    name = "trunk-int8.onnx"

    def __call__(self, inputs: np.ndarray) -> np.ndarray:
        """(N, 64, H/8, W/8) features of (N, 3, H, W) float32, H and W multiples of 16."""
        (features,) = self._session.run(["features"], {"image": inputs.astype(np.float32)})
        return np.asarray(features)


class OwnFinder(_OwnFile):
    """Masks of all categories on pictures of any size (see stages.perception.prior.FindingNetwork)."""

    name = "finder-int8.onnx"

    def __call__(self, images: np.ndarray) -> np.ndarray:
        """(N, len(CATEGORIES), H/2, W/2) logits of (N, 3, H, W) float32, H and W multiples of 16."""
        (masks,) = self._session.run(["masks"], {"image": images.astype(np.float32)})
        return np.asarray(masks)


def canonical_surface(category: str) -> dict[str, np.ndarray]:
    """`vertices` (V, 3) and `faces` (F, 3) of the category's canonical surface, `embedding` (V, 16) of unit length."""
    arrays = own_arrays(f"{category}.npz")
    return {name: arrays[name] for name in ("vertices", "faces", "embedding")}


def own_arrays(name: str) -> dict[str, np.ndarray]:
    """The arrays of a file of ours, by its name with ``.npz``.

    Raises:
        WeightsDamaged: it is missing or not what it should be.
    """
    with np.load(io.BytesIO(_read(name)), allow_pickle=False) as file:
        return dict(file)


def _read(name: str) -> bytes:
    try:
        data = (WEIGHTS / name).read_bytes()
    except OSError as error:
        raise WeightsDamaged(f"stages/weights/{name} cannot be read ({error.strerror}); install again") from error
    if hashlib.sha256(data).hexdigest() != DIGESTS[name]:
        raise WeightsDamaged(f"stages/weights/{name} is not the file that was shipped; install again")
    return data
