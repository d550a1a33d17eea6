"""What was seen, packed; and batches drawn from it: seeded, where they should be, with the right partners."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.ndimage import distance_transform_edt

from stages.fitting import batches
from stages.fitting.batches import draw, step_generator
from stages.fitting.observations import BESIDE_UNITS, FREE_PX, ObservationBuilder
from stages.geometry.cameras import project, transform
from tests.numerics.analytic_scene import Scene, describe_point, look, scene, sphere


@pytest.fixture(scope="module")
def seen() -> Scene:
    return scene(sphere(0.5), frames=5, steps=(1, -1, 4))


def test_rows_hold_the_pixels_near_the_object(seen: Scene) -> None:
    packed = seen.observations
    assert len(packed) == 10 and packed.video_idx.tolist() == [0] * 5 + [1] * 5
    for f in range(10):
        rows = slice(int(packed.offsets[f]), int(packed.offsets[f + 1]))
        x, y = packed.xy[rows].long().T
        mask = torch.from_numpy(seen.masks[f])
        near = distance_transform_edt(seen.masks[f] == 0) <= 4
        assert int(near.sum()) == len(x) and near[y.numpy(), x.numpy()].all()
        assert torch.equal(packed.mask[rows], mask[y, x])
        assert torch.equal(packed.rgb[rows], torch.from_numpy(seen.images[f])[y, x])
        assert packed.image_size[f].tolist() == [mask.shape[1], mask.shape[0]]
        small = packed.silhouettes[f, : mask.shape[0], : mask.shape[1]]
        assert float(packed.silhouette_scale[f]) == 1 and torch.equal(small, mask)
        assert int(packed.silhouettes[f].sum()) == int(mask.sum())


def test_partners_stay_in_their_video(seen: Scene) -> None:
    partner = seen.observations.partner
    assert partner[1].tolist() == [1, 2, 3, 4, -1, 6, 7, 8, 9, -1]
    assert partner[-1].tolist() == [-1, 0, 1, 2, 3, -1, 5, 6, 7, 8]
    assert partner[4].tolist() == [4, -1, -1, -1, -1, 9, -1, -1, -1, -1]


def test_generators_differ_by_seed_step_and_rank() -> None:
    def first(*key: int) -> float:
        return float(torch.rand(1, generator=step_generator(*key), dtype=torch.float64))

    assert first(1, 2, 3) == first(1, 2, 3)
    assert len({first(s, t, r) for s in range(3) for t in range(3) for r in range(3)}) == 27


def test_a_batch_is_what_seed_and_step_say(seen: Scene) -> None:
    one, same = (draw(seen.observations, 6, 20, step_generator(0, 7)) for _ in range(2))
    assert all(torch.equal(a, b) for a, b in zip(one, same, strict=True))
    other = draw(seen.observations, 6, 20, step_generator(0, 8))
    assert not torch.equal(one.pixels, other.pixels)


def test_a_batch_says_what_was_seen(seen: Scene) -> None:
    batch = draw(seen.observations, 40, 30, step_generator(0, 1))
    partners = set()
    for i, f in enumerate(batch.frame_idx.tolist()):
        cell = (batch.pixels[i] - 0.5).long()
        assert torch.equal(cell + 0.5, batch.pixels[i])
        x, y = cell.T
        assert torch.equal(batch.mask[i], torch.from_numpy(seen.masks[f])[y, x].float() / 255)
        assert torch.equal(batch.rgb[i], torch.from_numpy(seen.images[f])[y, x].float() / 255)
        partner = int(batch.partner_idx[i])
        partners.add(partner - f)
        if partner == f:
            assert not batch.flow_confidence[i].any() and not batch.flow[i].any()
            continue
        assert partner // 5 == f // 5
        on, points = look(seen.hit, seen.poses[f], seen.intrinsics[f], batch.pixels[i])
        assert torch.equal(batch.flow_confidence[i], on.float())
        expected = project(seen.intrinsics[partner], transform(seen.poses[partner], points)) - batch.pixels[i]
        assert torch.allclose(batch.flow[i][on], expected[on], atol=0.05)
    assert partners == {0, 1, -1, 4}


def test_features_are_those_of_the_nearest_cell(seen: Scene) -> None:
    batch = draw(seen.observations, 20, 30, step_generator(0, 2))
    assert batch.features is not None
    for i, f in enumerate(batch.frame_idx.tolist()):
        crop = seen.observations.crops[f]
        size = (crop[2:] - crop[:2]) / 24
        cell = ((batch.pixels[i] - crop[:2]) / size).floor()
        inside = ((cell >= 0) & (cell < 24)).all(1)
        on, points = look(seen.hit, seen.poses[f], seen.intrinsics[f], crop[:2] + (cell + 0.5) * size)
        known = on & inside
        assert torch.allclose(batch.features[i][known], describe_point(points[known]), atol=2e-3)
        assert not batch.features[i][~known].any()
        length = batch.features[i].norm(dim=1)
        assert torch.allclose(length[known], torch.ones(int(known.sum())), atol=1e-5)


def test_frames_are_drawn_by_their_weight() -> None:
    seen = scene(sphere(0.5), frames=3)
    seen.observations.frame_weight[:] = torch.tensor([0.0, 1, 3, 0, 0, 0])
    batch = draw(seen.observations, 4000, 1, step_generator(0, 0))
    share = torch.bincount(batch.frame_idx, minlength=6) / 4000
    assert torch.allclose(share, torch.tensor([0, 0.25, 0.75, 0, 0, 0]), atol=0.03)
    assert torch.equal(batch.weight[:, 0], seen.observations.frame_weight[batch.frame_idx])


def test_frames_without_a_mask_count_for_nothing() -> None:
    hidden = scene(sphere(0.3, torch.tensor([40.0, 0, 0])), frames=2)
    assert not hidden.observations.frame_weight.any()
    assert hidden.observations.offsets.tolist() == [0, 0, 0, 0, 0]


def test_the_rows_near_the_edge_come_first_and_can_be_drawn_alone(seen: Scene) -> None:
    packed = seen.observations
    margin = 4.0
    for f in (0, 7):
        mask = seen.masks[f] > 127
        distance = torch.from_numpy(np.where(mask, distance_transform_edt(mask), distance_transform_edt(~mask)))
        rows = slice(int(packed.offsets[f]), int(packed.offsets[f + 1]))
        x, y = packed.xy[rows].long().T
        near = distance[y, x] <= margin / 2
        count = int(packed.edge_count[f])
        assert 0 < count < len(near) and near[:count].all() and not near[count:].any()
    batch = draw(packed, 30, 40, step_generator(0, 3), edge_share=0.5)
    shares = []
    for i, f in enumerate(batch.frame_idx.tolist()):
        mask = seen.masks[f] > 127
        distance = torch.from_numpy(np.where(mask, distance_transform_edt(mask), distance_transform_edt(~mask)))
        x, y = (batch.pixels[i] - 0.5).long().T
        near = distance[y, x] <= margin / 2
        assert near[:20].all()
        shares.append(float(near[20:].float().mean()))
    assert 0.1 < sum(shares) / len(shares) < 0.9


def test_picked_pixels_are_those_of_the_batch(seen: Scene) -> None:
    batch = draw(seen.observations, 3, 12, step_generator(0, 4))
    columns = torch.tensor([[11, 0], [5, 5], [2, 7]])
    picked = batch.pixels_of(columns)
    for f in range(3):
        for i, column in enumerate(columns[f]):
            assert torch.equal(picked.pixels[f, i], batch.pixels[f, column])
            assert torch.equal(picked.rgb[f, i], batch.rgb[f, column])
            assert torch.equal(picked.flow[f, i], batch.flow[f, column])
            assert picked.features is not None and batch.features is not None
            assert torch.equal(picked.features[f, i], batch.features[f, column])
    assert picked.frame_idx is batch.frame_idx


def test_batches_know_how_far_from_the_mask_a_place_is(seen: Scene) -> None:
    batch = batches.look(seen.observations, torch.arange(len(seen.observations)), 4, step_generator(0, 0))
    assert batch.beside is not None
    assert torch.equal(batch.beside_scale[:, 0], seen.observations.silhouette_scale)
    for frame, beside in enumerate(batch.beside):
        rows = slice(int(seen.observations.offsets[frame]), int(seen.observations.offsets[frame + 1]))
        inside = seen.observations.xy[rows][seen.observations.mask[rows] > 127].double()
        scale = float(seen.observations.silhouette_scale[frame])
        width, height = (int(x) for x in seen.observations.image_size[frame])
        for x, y in ((0, 0), (width - 1, 3), (2, height - 2), (int(inside[0, 0]), int(inside[0, 1]))):
            nearest = float((inside - torch.tensor([x, y])).norm(dim=1).min())
            found = float(beside[int((y + 0.5) * scale), int((x + 0.5) * scale)]) / BESIDE_UNITS / scale
            assert found == pytest.approx(max(0.0, nearest - FREE_PX), abs=0.75 / scale)


def test_a_thin_leg_is_nothing_that_sticks_out_and_beyond_the_picture_all_is_free() -> None:
    """A leg much thinner than a cell of the small maps is in none of them, yet rays are drawn there."""
    mask = np.zeros((300, 600), np.uint8)
    mask[40:200, 100:104] = 255
    builder = ObservationBuilder((), small_px=60)
    builder.add(0, np.zeros((300, 600, 3), np.uint8), mask, {}, 1.0)
    observations = builder.finish()
    assert observations.beside is not None and int(observations.silhouettes[0].max()) < 127
    beside = observations.beside[0].numpy()
    assert beside[4:20, 10].max() <= 1 and beside[4:20, 20:30].min() > 8 * BESIDE_UNITS
    assert not beside[30:].any()  # below the picture


def test_an_empty_mask_pulls_nothing_back() -> None:
    empty = ObservationBuilder(())
    empty.add(0, np.zeros((12, 16, 3), np.uint8), np.zeros((12, 16), np.uint8), {}, 1.0)
    observations = empty.finish()
    assert observations.beside is not None and not observations.beside.any()
