"""The curve that an optimisation draws of itself."""

from __future__ import annotations

import itertools
import math
import xml.etree.ElementTree as ET

from stages.fitting.curve import loss_curve


def points(text: str) -> list[tuple[float, float]]:
    line = ET.fromstring(text).find("{http://www.w3.org/2000/svg}polyline")
    return [] if line is None else [tuple(map(float, p.split(","))) for p in line.attrib["points"].split()]  # type: ignore[misc]


def test_a_falling_loss_is_a_falling_curve() -> None:
    drawn = points(loss_curve([{"step": s, "total": math.exp(-s / 50)} for s in range(0, 101, 10)]))
    assert len(drawn) == 11
    assert all(b[0] > a[0] and b[1] > a[1] for a, b in itertools.pairwise(drawn)), "down is larger in a picture"
    steps = [b[1] - a[1] for a, b in itertools.pairwise(drawn)]
    assert max(steps) - min(steps) < 0.3, "an exponential is a straight line"


def test_what_is_no_number_is_left_out() -> None:
    assert points(loss_curve([])) == []
    assert len(points(loss_curve([{"step": 1, "total": 1.0}, {"step": 2, "total": math.nan}, {"step": 3}]))) == 1
