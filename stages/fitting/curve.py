"""The loss over the steps as a small SVG picture, to look at while an optimisation runs."""

from __future__ import annotations

import math
from collections.abc import Sequence

_WIDTH, _HEIGHT, _LEFT, _FOOT = 640, 260, 64, 32


def loss_curve(history: Sequence[dict[str, float]], term: str = "total") -> str:
    """One term of the objective, logarithmic, over the steps of `history` (rows with ``step`` and terms)."""
    points = [(r["step"], r[term]) for r in history if r.get(term, 0.0) > 0 and math.isfinite(r[term])]
    head = f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {_WIDTH} {_HEIGHT}" font-family="sans-serif">'
    parts = [head, f'<rect width="{_WIDTH}" height="{_HEIGHT}" fill="#fff"/>']
    if points:
        first, last = points[0][0], max(points[-1][0], points[0][0] + 1)
        logs = [math.log10(v) for _, v in points]
        low, high = min(logs), max(max(logs), min(logs) + 1e-3)

        def x(step: float) -> float:
            return _LEFT + (step - first) / (last - first) * (_WIDTH - _LEFT - 16)

        def y(value: float) -> float:
            return 16 + (high - value) / (high - low) * (_HEIGHT - 16 - _FOOT)

        for share in (0.0, 0.5, 1.0):
            value = low + share * (high - low)
            parts.append(f'<path d="M{_LEFT} {y(value):.1f}H{_WIDTH - 16}" stroke="#ddd"/>')
            text = f'<text x="{_LEFT - 8}" y="{y(value) + 4:.1f}" text-anchor="end" font-size="12" fill="#666">'
            parts.append(f"{text}{10**value:.3g}</text>")
        line = " ".join(f"{x(s):.1f},{y(v):.1f}" for (s, _), v in zip(points, logs, strict=True))
        parts.append(f'<polyline points="{line}" fill="none" stroke="#2f6f5e" stroke-width="2"/>')
        said = f"{term} {points[-1][1]:.4g} at step {points[-1][0]:.0f}"
        parts.append(f'<text x="{_LEFT}" y="{_HEIGHT - 10}" font-size="13" fill="#333">{said}</text>')
    return "".join([*parts, "</svg>\n"])
