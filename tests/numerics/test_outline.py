"""An outline that is some pixels off moves to where the colours change; without contrast it stays."""

import cv2
import numpy as np
import pytest

from stages.perception.outline import settle_outline


def _scene(front: tuple[int, int, int], back: tuple[int, int, int]) -> tuple[np.ndarray, np.ndarray]:
    """A soft-edged disc on noise (96, 96, 3), and its true mask."""
    rows, columns = np.mgrid[:96, :96] + 0.5
    alpha = np.clip(24.5 - np.hypot(rows - 48, columns - 48), 0, 1)[..., None]
    noise = np.random.default_rng(0).normal(0, 4, (96, 96, 3))
    image = alpha * np.array(front) + (1 - alpha) * np.array(back) + noise
    return np.clip(image, 0, 255).astype(np.uint8), alpha[..., 0] > 0.5


def _overlap(a: np.ndarray, b: np.ndarray) -> float:
    return np.count_nonzero(a & b) / np.count_nonzero(a | b)


@pytest.mark.parametrize("grown_px", [-2, 2])
def test_a_fat_or_thin_mask_comes_to_fit(grown_px: int) -> None:
    image, truth = _scene((180, 120, 60), (90, 100, 110))
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (5, 5))
    change = cv2.dilate if grown_px > 0 else cv2.erode
    off = cv2.GaussianBlur(change(truth.astype(np.float32), disc), (0, 0), 1.5)
    found = settle_outline(off, image)
    assert _overlap(off > 0.5, truth) < 0.9
    assert _overlap(found > 0.5, truth) > 0.97


def test_what_looks_alike_stays_as_it_was() -> None:
    image, truth = _scene((100, 100, 100), (100, 100, 100))
    mask = cv2.GaussianBlur(truth.astype(np.float32), (0, 0), 1.5)
    assert _overlap(settle_outline(mask, image) > 0.5, mask > 0.5) > 0.97


def test_nothing_stays_nothing() -> None:
    image, _ = _scene((180, 120, 60), (90, 100, 110))
    assert settle_outline(np.zeros((96, 96), np.float32), image).max() < 1e-6


def test_what_is_certain_stays_certain() -> None:
    """A fit takes a mask's values as the opacity it wants: background that stays at 6 % would be fog."""
    image, truth = _scene((180, 120, 60), (90, 100, 110))
    found = settle_outline(truth.astype(np.float32), image)
    far_in = cv2.erode(truth.astype(np.uint8), np.ones((15, 15))) > 0
    far_off = cv2.dilate(truth.astype(np.uint8), np.ones((41, 41))) == 0
    assert found[far_in].min() > 0.999
    assert found[far_off].max() < 0.001
