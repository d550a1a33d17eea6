"""Refining rough masks: crops go to the network and come back where they were."""

from __future__ import annotations

import numpy as np

from stages.perception.refining import MARGIN, SIDE_PX, crop_round, refine
from tests.stages.perception_clips import overlap


class Copies:
    """Answers with the rough mask it is shown; remembers the pictures."""

    def __init__(self) -> None:
        self.seen: list[np.ndarray] = []

    def __call__(self, inputs: np.ndarray) -> np.ndarray:
        self.seen.append(inputs)
        return 20.0 * (inputs[:, 3] - 0.5)


def test_what_the_network_copies_stays_where_it_was() -> None:
    rough = np.zeros((3, 90, 140), np.float32)
    rough[0, 20:60, 30:50] = rough[1, 0:50, 100:140] = 1.0  # the second is cut off by two sides of the picture
    frames = np.zeros((3, 90, 140, 3), np.uint8)
    frames[0, 20:60, 30:50] = 255
    network = Copies()
    found = refine(frames, rough, network)
    assert overlap(found[:2] > 0.5, rough[:2] > 0.5) > 0.95
    np.testing.assert_array_equal(found[2], 0)  # nothing to refine
    shown = network.seen[0]
    assert shown.shape == (2, 4, SIDE_PX, SIDE_PX)
    assert shown[0, 0][shown[0, 3] > 0.9].min() > 1.5 > -1.5 > shown[0, 0][shown[0, 3] < 0.1].max()


def test_the_crop_is_round_the_main_piece() -> None:
    rough = np.zeros((100, 100), np.float32)
    rough[30:70, 40:60] = 0.9
    rough[2:4, 90:92] = 0.9
    crop = crop_round(rough)
    assert crop is not None
    np.testing.assert_allclose(crop, [50 - 20 * MARGIN, 50 - 20 * MARGIN, 50 + 20 * MARGIN, 50 + 20 * MARGIN], atol=1)
    assert crop_round(np.zeros((100, 100), np.float32)) is None
