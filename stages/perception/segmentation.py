"""Which pixels are the object: motion, place and looks over the whole clip, and what networks of ours have learnt.

1. Motion against the background gives each frame sharp but sparse evidence (`background.motion_cues`).
2. A pixel classifier is fitted to it over the whole clip, so that frames without motion profit from those with it;
   where the object is, is carried between frames by flow.
3. Where that lost an object of a known category, features of the categories' network find it again (`lost_frames`);
   once more after the next step, where that has lost a part, and then that step again.
4. What a category's network knows: one that has learnt to mend rough masks (`refining`) does so at the pictures' own
   size. Anything else: the same again on plain colours, leaving the uncertain rim of the mask out of the fit; this
   tightens the outline.
5. Pieces that look like the background are added where other frames of the clip show it, and here it is not to be
   seen (`missing_pieces`).
6. Flicker is voted away along the flow, and the outline is settled at full resolution.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import pairwise

import cv2
import numpy as np

from stages.perception.appearance import PixelColours, coloured_surroundings, scaled_lab
from stages.perception.background import MotionCues, border_distance, motion_cues, shrink
from stages.perception.lost_frames import TrunkNetwork, find_again, look_again
from stages.perception.missing_pieces import with_missing_pieces
from stages.perception.optical_flow import Matcher, sample
from stages.perception.outline import settle_outline
from stages.perception.refining import RefiningNetwork, refine
from stages.perception.temporal import disc, flow_median, main_component, resize_maps, signed_distance

WORK_SIDE_PX = 256
COARSE_PIXELS = 2048  # learnt from at once
BLENDED_SHARE = 0.9  # of the object's pixels when plain colours are learnt; see PixelColours.fit
MOTION_SIDE_PX = 192  # motion tells no more at 256, at five times the work
CARRY_SIDE_PX = 128
LEAST_PRIOR_AREA = 2e-3
LEAST_PRIOR_SCORE = 0.35
OUTLINE_REACH_PX = 4.0  # at the working size
Tick = Callable[[int, int, str], None]


@dataclass(frozen=True)
class Hint:
    """What the user says of one frame, in pixels of the kept frames."""

    frame_idx: int
    box: np.ndarray | None = None  # (4,) x0, y0, x1, y1: the object fills it
    inside: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))  # (N, 2) clicks on the object
    outside: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))  # (N, 2) clicks on "not this"


@dataclass(frozen=True)
class Segmentation:
    """Foreground probability (T, H, W) uint8 and how well the cues agreed a frame (T,) in 0..1."""

    probability: np.ndarray
    agreement: np.ndarray
    prior: str = ""  # the category whose network had a say
    refined: bool = False  # whether a network went over the rough mask
    found_again: int = 0  # frames in which the object, or a whole piece of it, was lost or wrong
    looked_again: bool = False  # whether what was found there had a say in every frame
    with_pieces: int = 0  # frames that gained a piece that looks like the background


@dataclass(frozen=True)
class Effort:
    """How much work the built-in segmentation does."""

    rounds: int = 2
    refinements: int = 1
    seed: int = 0


class Carrier:
    """Moves maps between neighbouring frames along the flow, at a small size."""

    def __init__(self, work: list[np.ndarray]) -> None:
        grey = [cv2.cvtColor(shrink(image, CARRY_SIDE_PX), cv2.COLOR_RGB2GRAY) for image in work]
        matcher = Matcher("fast")
        self.size = grey[0].shape[::-1]
        pairs = list(pairwise(grey))
        self.to_next = [matcher(a, b) for a, b in pairs]  # frame t -> t+1
        self.to_previous = [matcher(b, a) for a, b in pairs]  # frame t+1 -> t

    def spread(self, maps: np.ndarray, decay: float, strongest: bool = True) -> np.ndarray:
        """(T, h, w) maps, each joined with its neighbours' carried here, weaker by `decay` a frame.

        `strongest` joins by the larger value, otherwise by the value larger in size (for signed maps).
        """
        small = [cv2.resize(m.astype(np.float32), self.size, interpolation=cv2.INTER_AREA) for m in maps]
        join = np.maximum if strongest else (lambda a, b: np.where(np.abs(a) >= np.abs(b), a, b))
        forth, back = list(small), list(small)
        for t in range(1, len(small)):
            forth[t] = join(small[t], decay * sample(forth[t - 1], self.to_previous[t - 1]))
        for t in range(len(small) - 2, -1, -1):
            back[t] = join(small[t], decay * sample(back[t + 1], self.to_next[t]))
        size = maps.shape[2], maps.shape[1]
        return np.stack(
            [cv2.resize(join(a, b), size, interpolation=cv2.INTER_LINEAR) for a, b in zip(forth, back, strict=True)]
        )


def segment(
    images: np.ndarray,
    hints: tuple[Hint, ...] = (),
    effort: Effort | None = None,
    tick: Tick = lambda done, total, label: None,
    priors: dict[str, np.ndarray] | None = None,
    refiner: RefiningNetwork | None = None,
    trunk: TrunkNetwork | None = None,
) -> Segmentation:
    """Foreground probability of every frame of a clip, (T, H, W, 3) uint8 RGB.

    `priors` are category networks' ideas of it, (T, H, W) uint8 each; the one that fits what moves has a say.
    `trunk` finds such an object again in frames that lost it, `refiner` makes the rough mask of it exact.
    """
    effort = effort or Effort()
    work = [shrink(image, WORK_SIDE_PX) for image in images]
    cues = _motion(work, tick)
    carrier = Carrier(work)
    told = hint_evidence(hints, images.shape[1:3], work[0].shape[:2], len(work))
    if hints:
        told = carrier.spread(told, 0.93, strongest=False)
    chosen = choose_prior(priors or {}, cues)
    if chosen:
        known = told + prior_evidence((priors or {})[chosen], work[0].shape[:2])
    else:
        known = told
    soft = coarse_probability(work, cues, known, carrier, effort)
    tick(1, 2, "learning")
    lost, looked_again, found = np.zeros(len(work), bool), False, None
    if trunk is not None and chosen:
        found = find_again(work, soft, told, trunk, effort.seed)
        soft, lost = found.probability, found.lost
    refined = refiner is not None and bool(chosen) and effort.refinements > 0
    if refiner is not None and refined:
        # Not of a tightened mask: where colours were wrong, that one has lost what the network would have seen.
        soft = refined_probability(images, soft, told, refiner, effort)
        if found is not None:
            again, changed = look_again(soft, told, effort.seed, found)
            looked_again = again is not soft
            if looked_again:
                soft = refined_probability(images, again, told, refiner, effort)
            lost = lost | changed
    else:
        soft = tight_probability(work, soft, cues, known, effort)
    tick(2, 2, "learning")
    soft, gained = with_missing_pieces(
        work, soft, told, carrier.to_next, carrier.to_previous, effort.seed,
        lambda done, total: tick(done, total, "backdrop"),
    )  # fmt: skip
    last = finish(images, soft, carrier)
    return Segmentation(
        last.probability, last.agreement, chosen, refined, int(lost.sum()), looked_again, int(np.count_nonzero(gained))
    )


# --------------------------------------------------------------------------------------------- the steps


def coarse_probability(
    work: list[np.ndarray], cues: MotionCues, told: np.ndarray, carrier: Carrier, effort: Effort
) -> np.ndarray:
    """(T, h, w) probability from motion evidence and colours in their surroundings; finds the object, a little fat.

    Worked out at half the size of the cues.
    """
    height, width = work[0].shape[:2]
    half = [cv2.resize(image, (width // 2, height // 2), interpolation=cv2.INTER_AREA) for image in work]
    evidence, moving, told = (resize_maps(maps, width // 2, height // 2) for maps in (cues.evidence, cues.moving, told))
    centre = np.exp(-0.5 * (border_distance(height // 2, width // 2) / 0.75) ** 6)
    seed = np.clip(evidence / 1.5, 0, 1) * centre * np.clip(moving / 0.3, 0, 1)
    seed = np.where(told > 0.5, np.maximum(seed, np.clip(told / 3, 0, 1)), np.where(told < -0.5, 0, seed))
    near = carrier.spread(_nearness(seed, 3.0), 0.95)
    away = np.clip(1 - 4 * near, 0, 1) * (evidence < 0.5) * np.clip(1.3 - 2 * moving, 0.2, 1)
    away = np.where(told < -0.5, 1.0, away)
    label = (seed > away).astype(np.float32)
    weight = np.where(seed > 0.2, seed, np.where(away > 0.2, 0.7 * away, 0)).astype(np.float32)
    values = np.stack([coloured_surroundings(image) for image in half])
    soft = seed.astype(np.float32)
    for turn in range(effort.rounds):
        colours = PixelColours(values.shape[-1], effort.seed + turn)
        if not colours.fit(values, label, weight, batch=COARSE_PIXELS):
            break
        looks = np.stack([cv2.GaussianBlur(x, (0, 0), 0.6) for x in colours.logit(values)])
        place = 1.5 * np.log(np.clip(3 * near, 0.03, 1))
        soft = _sigmoid(looks - 0.7 + 0.8 * np.clip(evidence, -1, 3) + place + told)
        near = carrier.spread(_nearness(np.where(soft > 0.5, soft, 0), 4.0), 0.95)
        label = (soft > 0.5).astype(np.float32)
        sure = np.abs(soft - 0.5) * 2
        weight = np.where(sure > 0.4, sure, 0).astype(np.float32)
    return resize_maps(np.stack([main_component(s > 0.5, s) * s for s in soft]), width, height)


def tight_probability(
    work: list[np.ndarray], soft: np.ndarray, cues: MotionCues, told: np.ndarray, effort: Effort, rim_px: int = 3
) -> np.ndarray:
    """(T, h, w) probability from plain colours, fitted without the rim of the mask, where the labels are least sure.

    Colours count as far as they tell the core from its surroundings in this clip at all; the rest is left to the depth
    inside the coarse outline, which is about as fat as the rim.
    """
    values = np.stack([scaled_lab(image) for image in work])
    depth = np.stack([signed_distance(s > 0.5) for s in soft])
    # Well inside the outline is the object whatever its colour.
    within = 0.3 * np.clip(depth - 2.5 * rim_px, 0, 12)
    found = soft
    for turn in range(2):
        core, off, close = _rim(found > 0.5, max(1, rim_px - turn))
        weight = core + off * np.where(close, 1.0, 0.15)
        colours = PixelColours(values.shape[-1], effort.seed + 10 + turn)
        if not colours.fit(values, core, weight, steps=300, mixed=BLENDED_SHARE):
            return found
        looks = np.full(found.shape, -6.0, np.float32)
        looks[~off] = colours.logit(values[~off])
        beside = off & close
        right = ((looks[core > 0] > 0).mean() + (colours.logit(values[beside]) < 0).mean()) / 2
        told_apart = float(np.clip((right - 0.8) / 0.15, 0, 1))
        looks = np.stack([cv2.GaussianBlur(x, (0, 0), 0.8) for x in looks])
        place = (1.0 - 0.7 * told_apart) * np.clip(0.5 * (depth - rim_px), -3.0, 3.0) + within
        looks = (0.4 + 0.6 * told_apart) * (looks - 0.5 + 1.1 * told_apart)
        logit = looks + place + 0.5 * np.clip(cues.evidence, -1, 3) + told
        found = np.where(off, 0.002, _sigmoid(logit)).astype(np.float32)
        found = np.stack([main_component(f > 0.5, f) * f for f in found])
    return found


def refined_probability(
    images: np.ndarray, soft: np.ndarray, told: np.ndarray, refiner: RefiningNetwork, effort: Effort
) -> np.ndarray:
    """(T, H, W) probability at the images' own size: the coarse one mended, several times over; hints still count."""
    height, width = images.shape[1:3]
    found = resize_maps(soft, width, height)
    hinted = told.any()
    for _ in range(effort.refinements):
        found = refine(images, found, refiner)
        if hinted:
            logit = np.log((found + 0.01) / (1.01 - found))
            found = np.stack([_sigmoid(a + cv2.resize(b, (width, height))) for a, b in zip(logit, told, strict=True)])
    return found


def finish(images: np.ndarray, soft: np.ndarray, carrier: Carrier) -> Segmentation:
    """Masks at full size: flicker voted away along the flow, outline settled on edges, stray pieces dropped."""
    count, height, width = images.shape[:3]
    steady = flow_median(soft, carrier.to_next, carrier.to_previous)
    out = np.zeros((count, height, width), np.uint8)
    agreement = np.zeros(count)
    for t in range(count):
        prior = cv2.resize(steady[t], (width, height), interpolation=cv2.INTER_LINEAR)
        prior = settle_outline(prior, images[t], OUTLINE_REACH_PX * max(1.0, max(width, height) / WORK_SIDE_PX))
        cut = main_component(prior > 0.5, prior)
        union = np.count_nonzero(cut | (prior > 0.25))
        agreement[t] = np.count_nonzero(cut & (prior > 0.75)) / max(int(union), 1)
        held = np.where(cut, np.maximum(prior, 0.51), np.minimum(prior, 0.49))
        out[t] = np.round(255 * held).astype(np.uint8)
    return Segmentation(out, agreement)


# --------------------------------------------------------------------------------------------- pieces


def _motion(work: list[np.ndarray], tick: Tick) -> MotionCues:
    """Motion cues at the working size, found at a smaller one."""
    height, width = work[0].shape[:2]
    found = motion_cues([shrink(image, MOTION_SIDE_PX) for image in work], tick=lambda n: tick(n, len(work), "motion"))
    return MotionCues(resize_maps(found.moving, width, height), resize_maps(found.evidence, width, height))


def hint_evidence(hints: tuple[Hint, ...], full: tuple[int, ...], work: tuple[int, ...], count: int) -> np.ndarray:
    """(T, h, w) log-odds from the user's hints at their own frames, zero elsewhere."""
    out = np.zeros((count, *work), np.float32)
    scale: np.ndarray = np.array([work[1] / full[1], work[0] / full[0]])
    rows, columns = np.mgrid[0 : work[0], 0 : work[1]] + 0.5
    for hint in hints:
        layer = out[hint.frame_idx]
        if hint.box is not None:
            x0, y0, x1, y1 = hint.box * np.tile(scale, 2)
            inside = (columns >= x0 - 1) & (columns <= x1 + 1) & (rows >= y0 - 1) & (rows <= y1 + 1)
            u, v = (2 * columns - x0 - x1) / (x1 - x0), (2 * rows - y0 - y1) / (y1 - y0)
            middle = np.clip(1.0 - np.hypot(u, v), 0, 1)
            layer[:] = np.where(inside, 0.2 + 2.5 * middle, -5.0)
        reach = 0.02 * max(work) + 1.5
        for points, value in ((hint.inside, 6.0), (hint.outside, -6.0)):
            for x, y in points * scale:
                layer[np.hypot(columns - x, rows - y) <= reach] = value
    return out


def choose_prior(priors: dict[str, np.ndarray], cues: MotionCues) -> str:
    """Name of the prior (T, H, W) uint8 that is surest of itself and covers what moves; "" if none does."""
    best, best_score = "", 0.0
    for name, prior in sorted(priors.items()):
        maps = resize_maps(prior, cues.evidence.shape[2], cues.evidence.shape[1]) / 255
        inside = maps > 0.5
        present = float((inside.reshape(len(maps), -1).mean(axis=1) > LEAST_PRIOR_AREA).mean())
        sure = float(maps[inside].sum() / max(np.count_nonzero(maps > 0.2), 1))
        moving = np.clip(cues.evidence / 1.5, 0, 1) * (cues.moving > 0.3)
        wide = np.stack([cv2.dilate(m.astype(np.uint8), np.ones((9, 9), np.uint8)) for m in inside])
        covered = float((moving * wide).sum() / moving.sum()) if moving.sum() > LEAST_PRIOR_AREA * moving.size else 1.0
        score = present * sure * min(covered / 0.5, 1.0)
        if score > max(best_score, LEAST_PRIOR_SCORE):
            best, best_score = name, score
    return best


def prior_evidence(prior: np.ndarray, work: tuple[int, ...]) -> np.ndarray:
    """(T, h, w) log-odds, within +-3, of a prior (T, H, W) uint8."""
    share = resize_maps(prior, work[1], work[0]) / 255
    return np.clip(np.log((share + 0.03) / (1.03 - share)), -3.0, 3.0).astype(np.float32)


def _nearness(maps: np.ndarray, sigma_px: float) -> np.ndarray:
    """Blurred maps, each scaled so that its top per cent is at 1."""
    blurred = np.stack([cv2.GaussianBlur(m.astype(np.float32), (0, 0), sigma_px) for m in maps])
    top = np.quantile(blurred.reshape(len(maps), -1), 0.99, axis=1)
    return blurred / np.maximum(top, 0.1)[:, None, None]


def _rim(masks: np.ndarray, rim_px: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Core (eroded by the rim), outside (beyond the rim) and close surroundings of boolean (T, h, w) masks."""
    rim = disc(rim_px)
    wide = np.ones((41, 41), np.uint8)
    eight = masks.astype(np.uint8)
    core = np.stack([cv2.erode(m, rim) for m in eight])
    off = np.stack([cv2.dilate(m, rim) for m in eight]) == 0
    close = np.stack([cv2.dilate(m, wide) for m in eight]) > 0
    return core.astype(np.float32), off, close


def _sigmoid(logit: np.ndarray) -> np.ndarray:
    return (1.0 / (1.0 + np.exp(-np.clip(logit, -15, 15)))).astype(np.float32)
