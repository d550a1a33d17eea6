"""One body: limbs that came loose are tied to it again, specks that float beside it go.

A joint between two bones that move apart is carved through where the pictures do not show it, and specks grow to
explain pixels that a lagging limb should cover; sheets grow where no ray was ever drawn. All are mended on the grid
of signed distance.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from scipy.ndimage import distance_transform_edt, label
from scipy.spatial import cKDTree
from torch import Tensor

from stages.model.banmo import Banmo
from stages.model.fields import GridField

_CORNERS = np.ones((3, 3, 3))
_FAR = 0.1  # units; nearer than that the pictures shape the field
_REAL_SHARE = 0.5  # a limb that follows badly still lies on the masks in most frames, what floats seldom does


def capsule(points: Tensor, start: Tensor, end: Tensor, radius: float) -> Tensor:
    """Signed distance (...) of points (..., 3) from a tube of `radius` about the segment from `start` to `end` (3,)."""
    along = end - start
    share = (((points - start) @ along) / along.square().sum().clamp_min(1e-12)).clamp(0, 1)
    return (points - start - share[..., None] * along).norm(dim=-1) - radius


@torch.no_grad()
def mend(
    model: Banmo,
    seen: Callable[[Tensor], Tensor] | None = None,
    least_share: float = 0.005,
    reach: float = 0.3,
    radius: float = 0.035,
) -> tuple[int, int]:
    """Tie parts of at least `least_share` of the body to it if they are within `reach` (units); remove all others.

    `seen` gives for canonical points (N, 3) in how large a share (N,) of the frames they lie on the object's mask; a
    part that mostly does not is removed, however large it is.

    The tie is a tube of `radius` (units) between the two nearest nodes. Where something was removed, what lies beyond
    `_FAR` becomes the distance from the body again. Returns how many parts were tied and removed.
    Networks are left as they are.
    """
    field = model.field
    if not isinstance(field, GridField):
        return 0, 0
    nodes = field.node_positions()
    sdf = field.sdf(field.prepare(), nodes.reshape(-1, 3)).reshape(field.shape).cpu()
    labels, count = label((sdf < 0).numpy(), structure=_CORNERS)
    if count <= 1:
        return 0, 0
    places = nodes.cpu()
    sizes = np.bincount(labels.ravel())
    sizes[0] = 0
    body = int(sizes.argmax())
    tree = cKDTree(places[torch.from_numpy(labels == body)].numpy())
    changed, tied, removed = sdf.clone(), 0, 0
    for part in np.argsort(-sizes)[1:count]:
        mine = torch.from_numpy(labels == part)
        own = places[mine]
        gap, nearest = tree.query(own.numpy())
        closest = int(gap.argmin())
        within = sizes[part] >= least_share * sizes[body] and gap[closest] <= reach
        if within and (seen is None or float(seen(own[:: max(1, len(own) // 200)]).mean()) > _REAL_SHARE):
            end = torch.from_numpy(np.asarray(tree.data[nearest[closest]], np.float32))
            changed = torch.minimum(changed, capsule(places, own[closest], end, radius))
            tree = cKDTree(np.concatenate([tree.data, own.numpy()]))
            tied += 1
        else:
            changed[mine] = field.voxel
            removed += 1
    if removed:
        spacing = [float(s) for s in field.spacing.flip(0)]
        distance = torch.from_numpy(distance_transform_edt((changed > 0).numpy(), spacing).astype(np.float32))
        changed = torch.where(distance > _FAR, distance, changed)
    field.set_sdf(changed.to(nodes.device))
    return tied, removed
