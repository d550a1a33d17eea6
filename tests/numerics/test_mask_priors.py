"""A category network's idea of the object counts where it fits what moves."""

import numpy as np
import pytest

from stages.perception.background import MotionCues
from stages.perception.segmentation import choose_prior, prior_evidence


def _disc(row: float, column: float, radius: float, size: int = 64, count: int = 6) -> np.ndarray:
    rows, columns = np.mgrid[:size, :size] + 0.5
    return np.repeat((np.hypot(rows - row, columns - column) < radius)[None], count, axis=0)


def _cues(moving: np.ndarray) -> MotionCues:
    return MotionCues(moving.astype(np.float32), np.where(moving, 2.0, -0.5).astype(np.float32))


def test_the_prior_that_covers_what_moves_is_chosen() -> None:
    here, there = _disc(32, 20, 10), _disc(32, 50, 10)
    priors = {"human": (255 * there).astype(np.uint8), "quadruped": (240 * here).astype(np.uint8)}
    assert choose_prior(priors, _cues(here)) == "quadruped"
    assert choose_prior(priors, _cues(there)) == "human"


def test_where_nothing_moves_the_surest_prior_is_chosen() -> None:
    here = _disc(32, 20, 10)
    priors = {"human": (140 * here).astype(np.uint8), "quadruped": (250 * here).astype(np.uint8)}
    assert choose_prior(priors, _cues(np.zeros_like(here))) == "quadruped"


@pytest.mark.parametrize(
    "prior", [np.zeros((6, 64, 64), np.uint8), (60 * _disc(32, 20, 10)).astype(np.uint8)], ids=["nothing", "unsure"]
)
def test_a_network_that_sees_nothing_has_no_say(prior: np.ndarray) -> None:
    assert choose_prior({"quadruped": prior}, _cues(_disc(32, 20, 10))) == ""


def test_a_prior_elsewhere_than_all_motion_has_no_say() -> None:
    prior = (255 * _disc(32, 50, 8)).astype(np.uint8)
    assert choose_prior({"quadruped": prior}, _cues(_disc(32, 14, 10))) == ""


def test_evidence_is_signed_and_bounded() -> None:
    evidence = prior_evidence((255 * _disc(32, 20, 10)).astype(np.uint8), (32, 32))
    assert evidence.shape == (6, 32, 32)
    assert evidence[0, 16, 10] == pytest.approx(3.0) and evidence[0, 2, 2] == pytest.approx(-3.0)
