"""masks: the built-in segmentation, hints, flags, and honest words."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline import BadInput, Folder, Given, Interrupted, Run
from stages.formats import read_clip, read_mask_facts, read_masks
from stages.masks import MaskSettings, _check, _sheet, masks
from stages.perception import segmentation
from stages.perception.appearance import PixelColours
from stages.perception.background import background_flow, bend_to_surroundings, motion_cues, polynomial_basis
from stages.perception.segmentation import Effort, Hint, hint_evidence, segment, tight_probability
from stages.perception.temporal import area_steadiness, describe, flow_median, main_component, mask_box, touches_border
from tests.stages.perception_clips import moving_clip, overlap, texture, write_frames_folder

IMAGES, TRUTH, _ = moving_clip(10, 96)
QUICK = MaskSettings()


def run_masks(frames: Folder, out: Path, given: Given | None = None, settings: MaskSettings = QUICK) -> Run:
    out.mkdir()
    run = Run(video="clip")
    masks(frames=frames, given=given or Given(), settings=settings, out=out, run=run)
    _check(out=out, frames=frames)
    return run


def test_finds_what_moves_and_says_so(tmp_path: Path) -> None:
    frames = write_frames_folder(tmp_path / "frames", IMAGES)
    run = run_masks(frames, tmp_path / "out")
    found = read_masks(tmp_path / "out", read_clip(frames.path)) > 127
    assert overlap(found, TRUTH) > 0.8
    facts = read_mask_facts(tmp_path / "out")
    assert facts.provider == "builtin" and facts.confidence.mean() > 0.6 and not run.warnings
    np.testing.assert_allclose(facts.box, [mask_box(m) for m in found], atol=0.01)
    _sheet(out=tmp_path / "out", frames=frames, picture=tmp_path / "sheet.png")
    assert (tmp_path / "sheet.png").stat().st_size > 1000


def test_same_seed_same_bytes(tmp_path: Path) -> None:
    frames = write_frames_folder(tmp_path / "frames", IMAGES[:4])
    for name in ("a", "b"):
        run_masks(frames, tmp_path / name)
    for path in (tmp_path / "a").iterdir():
        assert path.read_bytes() == (tmp_path / "b" / path.name).read_bytes()


def test_a_scene_without_an_object_is_not_trusted(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    room = texture(rng, 96, 130, (30, 50, 30), (120, 140, 120))
    images = np.stack([room[:, 2 * t : 2 * t + 96] for t in range(8)])
    frames = write_frames_folder(tmp_path / "frames", images)
    try:
        run = run_masks(frames, tmp_path / "out")
    except BadInput as error:
        assert "hints.toml" in str(error)
    else:
        assert run.warnings and run.metrics["mask_confidence"] < 0.6


def test_a_still_scene_with_a_box_gives_the_boxed_thing(tmp_path: Path) -> None:
    still = np.repeat(IMAGES[:1], 6, axis=0)
    box = mask_box(TRUTH[0])
    result = segment(still, (Hint(0, box=box),), Effort())
    assert overlap(result.probability > 127, np.repeat(TRUTH[:1], 6, axis=0)) > 0.6


class Copier:
    """A refining network that gives back the rough mask; counts its calls."""

    calls = 0

    def __call__(self, inputs: np.ndarray) -> np.ndarray:
        self.calls += 1
        return 20.0 * (inputs[:, 3] - 0.5)


@pytest.mark.parametrize(
    ("known", "refinements", "refined"),
    [(True, 1, True), (True, 2, True), (True, 0, False), (False, 1, False)],
    ids=["once", "twice", "never", "no category"],
)
def test_outlines_are_tightened_by_colour_where_no_network_does(
    monkeypatch: pytest.MonkeyPatch, known: bool, refinements: int, refined: bool
) -> None:
    tightened: list[bool] = []

    def tight(*inputs: Any) -> np.ndarray:
        tightened.append(True)
        return tight_probability(*inputs)

    monkeypatch.setattr(segmentation, "tight_probability", tight)
    images, truth = IMAGES[:6], TRUTH[:6]
    priors = {"quadruped": (255 * truth).astype(np.uint8)} if known else {}
    network = Copier()
    result = segment(images, effort=Effort(refinements=refinements), priors=priors, refiner=network)
    assert result.refined == refined and bool(tightened) != refined
    assert network.calls == (refinements if refined else 0)
    assert overlap(result.probability > 127, truth) > 0.75


def test_hints_count_after_refining() -> None:
    """A click outside takes a part away that the network would keep."""
    images, truth = IMAGES[:4], TRUTH[:4]
    priors = {"quadruped": (255 * truth).astype(np.uint8)}
    row, column = (int(v.mean()) for v in np.nonzero(truth[2]))
    hint = Hint(2, outside=np.array([[column + 0.5, row + 0.5]]))
    plain, told = (
        segment(images, hints, Effort(), priors=priors, refiner=Copier()).probability[2, row, column]
        for hints in ((), (hint,))
    )
    assert plain > 127 > told


def test_hints_are_put_where_they_say() -> None:
    hint = Hint(1, np.array([20.0, 20.0, 60.0, 60.0]), np.array([[30.0, 30.0]]), np.array([[50.0, 50.0]]))
    told = hint_evidence((hint,), (100, 200), (50, 100), 3)
    assert not told[0].any() and not told[2].any()
    assert told[1, 15, 15] == 6 and told[1, 25, 25] == -6 and told[1, 45, 90] == -5 and told[1, 20, 20] > 0


def test_toml_hints_steer(tmp_path: Path) -> None:
    frames = write_frames_folder(tmp_path / "frames", IMAGES)
    x0, y0, x1, y1 = mask_box(TRUTH[4])
    path = tmp_path / "clip.hints.toml"
    path.write_text(
        f"[[hint]]\nframe = 4\nbox = [{x0}, {y0}, {x1}, {y1}]\ninside = [[{(x0 + x1) / 2}, {(y0 + y1) / 2}]]\n"
    )
    run_masks(frames, tmp_path / "out", Given({".hints.toml": path}))
    found = read_masks(tmp_path / "out", read_clip(frames.path)) > 127
    assert overlap(found, TRUTH) > 0.8


@pytest.mark.parametrize(
    ("text", "word"),
    [
        ("[[hint]\n", "TOML"),
        ("box = [1, 2, 3, 4]\n", "[[hint]]"),
        ("[[hint]]\nbox = [1, 2, 30, 40]\n", "frame or time_s"),
        ("[[hint]]\nframe = 0\n", "box, inside or outside"),
        ("[[hint]]\nframe = 0\nbox = [1, 2, 3]\n", "x0, y0, x1, y1"),
        ("[[hint]]\nframe = 0\nbox = [30, 2, 3, 40]\n", "x0 < x1"),
        ("[[hint]]\nframe = 0\ninside = [[500, 2]]\n", "outside the picture"),
        ("[[hint]]\nframe = 0\ncolour = 'red'\n", "colour"),
    ],
)
def test_wrong_hints_are_refused(tmp_path: Path, text: str, word: str) -> None:
    frames = write_frames_folder(tmp_path / "frames", IMAGES[:2])
    path = tmp_path / "clip.hints.toml"
    path.write_text(text)
    with pytest.raises(BadInput, match=r"clip\.hints\.toml") as caught:
        run_masks(frames, tmp_path / "out", Given({".hints.toml": path}))
    assert word in str(caught.value)


def test_stop_is_heard(tmp_path: Path) -> None:
    frames = write_frames_folder(tmp_path / "frames", IMAGES[:4])
    run = Run()
    run.request_stop()
    with pytest.raises(Interrupted):
        masks(frames=frames, given=Given(), settings=QUICK, out=tmp_path, run=run)


# --------------------------------------------------------------------------------------------- numerics


def test_background_fit_recovers_a_polynomial_under_an_outlier() -> None:
    rng = np.random.default_rng(0)
    basis = polynomial_basis(48, 64)
    true = (basis @ rng.normal(0, 1.5, (10, 2))).reshape(48, 64, 2).astype(np.float32)
    flow = true + rng.normal(0, 0.02, true.shape).astype(np.float32)
    flow[15:35, 20:45] += (6.0, -3.0)
    fitted, scatter = background_flow(flow, np.ones((48, 64), np.float32), basis)
    assert np.abs(fitted - true).max() < 0.5 and scatter < 0.2


def test_background_bends_to_its_surroundings() -> None:
    flow = np.full((64, 64, 2), 1.5, np.float32)
    weight = np.ones((64, 64), np.float32)
    flow[24:40, 24:40], weight[24:40, 24:40] = 9.0, 0.0
    bent = bend_to_surroundings(np.zeros_like(flow), flow, weight)
    assert np.abs(bent[32, 32] - 1.5).max() < 0.1


def test_motion_evidence_is_sharper_than_flow() -> None:
    cues = motion_cues(list(IMAGES[:8]))
    t = 4
    assert cues.evidence[t][TRUTH[t]].mean() > 0.5
    assert cues.evidence[t][~TRUTH[t]].mean() < 0.05
    assert cues.moving[t][TRUTH[t]].mean() > 2 * cues.moving[t][~TRUTH[t]].mean()


def test_pixel_colours_learn_and_refuse_one_class() -> None:
    rng = np.random.default_rng(0)
    values = rng.normal(0, 1, (4000, 3)).astype(np.float32)
    label = (values[:, 0] > 0.3).astype(np.float32)
    model = PixelColours(3, seed=1)
    assert model.fit(values, label, np.ones(4000, np.float32), steps=150)
    assert ((model.logit(values) > 0) == (label > 0.5)).mean() > 0.95
    assert not PixelColours(3, seed=1).fit(values, np.zeros(4000), np.ones(4000))


def test_the_gradient_of_pixel_colours_is_that_of_their_loss() -> None:
    rng = np.random.default_rng(2)
    model = PixelColours(5, seed=1)
    inputs = rng.normal(0, 1, (400, 5)).astype(np.float32)
    wanted, trust = (rng.random((2, 400)) > 0.5).astype(np.float32)
    trust += 0.1

    def loss() -> float:
        odds = model.logit(inputs).astype(float)  # of values that are scaled by one: the network's own
        assert np.abs(odds).max() < 6, "not clipped"
        return float((trust * (np.log1p(np.exp(odds)) - wanted * odds)).mean())

    model._all *= 0.5
    gradient = model._gradient(inputs, wanted, trust)
    for _ in range(5):
        way = gradient / np.linalg.norm(gradient) + rng.normal(0, 0.03, len(gradient)).astype(np.float32)
        model._all += 1e-3 * way
        ahead = loss()
        model._all -= 2e-3 * way
        slope = (ahead - loss()) / 2e-3
        model._all += 1e-3 * way
        assert slope == pytest.approx(float(gradient @ way), rel=0.03)


def test_masks_and_features_do_without_torch() -> None:
    """It takes longer to import than a short clip's masks."""
    code = "import sys, stages.masks, stages.features, stages.flow; sys.exit('torch' in sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_flags_boxes_and_components() -> None:
    masks_ = np.zeros((4, 40, 60), bool)
    masks_[0, 10:30, 10:30] = masks_[1, 10:30, 12:32] = True
    masks_[2, 0:12, 40:60] = True  # elsewhere, and cut by the border
    track = describe(masks_, [None, masks_[0], masks_[1], masks_[2]])
    assert track.flags[3] == ["missing"] and "jumped" in track.flags[2] and "border" in track.flags[2]
    assert track.flags[0] == [] and track.flags[1] == []
    np.testing.assert_array_equal(track.box[0], [10, 10, 30, 30])
    assert not track.box[3].any()
    assert touches_border(masks_[2]) and not touches_border(masks_[0])
    speck = masks_[0].copy()
    speck[35, 50] = True
    speck[20, 20] = False
    np.testing.assert_array_equal(main_component(speck), masks_[0])


def test_flow_median_outvotes_one_frame() -> None:
    soft = np.zeros((5, 32, 32), np.float32)
    soft[:, 8:20, 8:20] = 1
    soft[2] = 0
    still = [np.zeros((16, 16, 2), np.float32)] * 4
    assert flow_median(soft, still, still)[2, 12, 12] > 0.5
    soft[2] = 1
    np.testing.assert_array_equal(flow_median(soft, still, still)[[0, 1, 3, 4]], soft[[0, 1, 3, 4]])


def test_area_steadiness_shows_the_frame_that_shrinks() -> None:
    steady = area_steadiness(np.array([0.1, 0.1, 0.11, 0.02, 0.1, 0.0, 0.1]))
    assert steady[3] < 0.25 and steady[5] == 0 and steady[[0, 1, 2, 4, 6]].min() > 0.85


def test_blends_count_as_what_they_are_mostly() -> None:
    rng = np.random.default_rng(0)
    label = (np.arange(3000) % 3 == 0).astype(np.float32)
    values = (label[:, None] + rng.normal(0, 0.05, (3000, 3))).astype(np.float32)
    edge = np.linspace(0, 1, 101, dtype=np.float32)[:, None].repeat(3, axis=1)
    model = PixelColours(3, seed=0)
    model.fit(values, label, np.ones(3000, np.float32), steps=200, mixed=0.9)
    crossing = edge[np.argmax(model.logit(edge) > 0), 0]
    assert 0.4 < crossing < 0.6
