"""Charts and baked textures against a painted sphere."""

import numpy as np
import pytest

from stages.geometry.raster import Fragments, rasterise
from stages.meshing.atlas import Baker, Texels, sample, texels_of, unwrap
from stages.meshing.surface import Mesh, clean_surface, extract

SIZE = 96
INTRINSICS = np.array([[130.0, 0, SIZE / 2], [0, 130.0, SIZE / 2], [0, 0, 1]])


def ball() -> Mesh:
    raw = extract(lambda p: p.norm(dim=-1) - 0.8, np.array([[-1.0] * 3, [1.0] * 3]), 40)
    return clean_surface(raw, 1500)[0]


def paint(points: np.ndarray) -> np.ndarray:
    """A smooth colour (N, 3) in 0..1 that differs everywhere on the sphere."""
    return 0.5 + 0.3 * np.sin(points * [3, 4, 5] + [0.0, 1.0, 2.0])


def cameras() -> list[np.ndarray]:
    """Six views along the axes: camera_from_object."""
    poses = []
    for axis in range(3):
        for sign in (1.0, -1.0):
            forward, up = np.zeros(3), np.zeros(3)
            forward[axis], up[(axis + 1) % 3] = sign, 1.0
            right = np.cross(forward, up)
            pose = np.eye(4)
            pose[:3, :3] = np.stack([right, np.cross(forward, right), forward])
            pose[2, 3] = 3.0
            poses.append(pose)
    return poses


def photograph(mesh: Mesh, pose: np.ndarray) -> tuple[np.ndarray, Fragments, np.ndarray]:
    """Vertices in the camera's frame, fragments, and the frame (H, W, 3) uint8 of the painted sphere on magenta."""
    points = mesh.vertices @ pose[:3, :3].T + pose[:3, 3]
    fragments = rasterise(points, mesh.faces, INTRINSICS, SIZE, SIZE)
    place = fragments.interpolate(mesh.faces, mesh.vertices)
    frame = np.where(fragments.covered[..., None], paint(place), (1.0, 0.0, 1.0))
    return points, fragments, np.round(frame * 255).astype(np.uint8)


def baked(
    views: list[np.ndarray], field: float | None = None, gain: float = 1.0, contrast: float = 1.0
) -> tuple[Mesh, Texels, np.ndarray, float]:
    """Bake; the model's own colour is the truth at some contrast, or `field` everywhere."""
    mesh = ball()
    texels = texels_of(unwrap(mesh, 256), 256)
    points = texels.spread(mesh.faces, mesh.vertices)
    own = 0.5 + contrast * (paint(points) - 0.5) if field is None else np.full_like(points, field)
    baker = Baker(mesh, texels, own)
    for pose in views:
        camera, fragments, frame = photograph(mesh, pose)
        frame = np.clip(frame * gain, 0, 255).astype(np.uint8)
        baker.add(camera, INTRINSICS, fragments, frame, fragments.covered, 0.02)
    baker.end_clip()
    picture, share = baker.picture()
    return mesh, texels, picture, share


def test_charts_cover_every_face_and_fit_the_picture() -> None:
    mesh = ball()
    atlas = unwrap(mesh, 256)
    np.testing.assert_array_equal(atlas.vertex[atlas.faces], mesh.faces)
    assert atlas.uv.min() >= 0 and atlas.uv.max() <= 1
    corner = atlas.corner_uv
    edge = corner[:, 1:] - corner[:, :1]
    area = np.abs(edge[:, 0, 0] * edge[:, 1, 1] - edge[:, 0, 1] * edge[:, 1, 0]) / 2
    assert 0.3 < area.sum() < 1  # no chart lies on another
    texels = texels_of(atlas, 256)
    assert len(texels.pixel) / 256**2 > 0.9 * area.sum()
    assert len(np.unique(texels.face)) > 0.99 * len(mesh.faces)
    again = unwrap(mesh, 256)
    assert again.uv.tobytes() == atlas.uv.tobytes()


def test_texels_know_their_place_on_the_surface() -> None:
    mesh = ball()
    atlas = unwrap(mesh, 256)
    texels = texels_of(atlas, 256)
    row, column = np.divmod(texels.pixel, 256)
    uv = np.einsum("pk,pkc->pc", texels.weight, atlas.corner_uv[texels.face])
    np.testing.assert_allclose(uv * 256, np.stack([column + 0.5, row + 0.5], axis=1), atol=2e-2)
    points = texels.spread(mesh.faces, mesh.vertices)
    assert np.abs(np.linalg.norm(points, axis=1) - 0.8).max() < 0.01


def test_the_paint_is_recovered_from_the_frames() -> None:
    """A model that knows half the contrast and no more: six views bring back the rest."""
    mesh, texels, picture, share = baked(cameras(), contrast=0.5)
    truth = paint(texels.spread(mesh.faces, mesh.vertices))
    got = picture.reshape(-1, 3)[texels.pixel] / 255
    assert share > 0.85
    assert np.abs((truth - 0.5) / 2).mean() > 0.08  # what the model alone would be wrong by
    assert np.abs(got - truth).mean() < 0.02
    # no background: magenta would be far off
    assert np.abs(got - truth).max() < 0.2


def test_exposure_is_brought_to_the_models() -> None:
    mesh, texels, picture, _ = baked(cameras(), gain=0.7)
    truth = paint(texels.spread(mesh.faces, mesh.vertices))
    found = picture.reshape(-1, 3)[texels.pixel] / 255
    assert found.sum() / truth.sum() == pytest.approx(1 / np.sqrt(1.2), abs=0.04)  # of 0.7, the rest is kept as light


def test_where_nothing_was_seen_the_model_speaks() -> None:
    mesh, texels, picture, share = baked(cameras()[:1], field=0.5)
    points = texels.spread(mesh.faces, mesh.vertices)
    behind = points[:, 0] > 0.1  # the one camera looks along +x, from the side of -x
    got = picture.reshape(-1, 3)[texels.pixel] / 255
    np.testing.assert_allclose(got[behind], 0.5, atol=2 / 255)
    assert 0.05 < share < 0.5
    assert got[~behind].std() > 0.03


def test_gaps_between_charts_take_the_nearest_colour() -> None:
    _, texels, picture, _ = baked([], field=0.25)
    assert len(texels.pixel) < 256**2
    np.testing.assert_array_equal(picture, np.full((256, 256, 3), 64))


def test_sampling_is_bilinear_between_texel_centres() -> None:
    texture = np.zeros((4, 4, 3), np.uint8)
    texture[1, 2], texture[1, 3] = 100, 200
    uv = np.array([[2.5 / 4, 1.5 / 4], [3.0 / 4, 1.5 / 4], [2.5 / 4, 2.0 / 4], [1.0, 1.5 / 4]])
    np.testing.assert_allclose(sample(texture, uv)[:, 0] * 255, [100, 150, 50, 200], atol=1e-3)
