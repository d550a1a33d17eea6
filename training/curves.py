"""Draw a training's log as an SVG picture: how the figures fell or rose with the pictures seen.

``python -m training.curves OUT.svg LOG.jsonl [LOG.jsonl ...]``: several logs are one training that was gone on with.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import tyro

PANELS = (
    ("azimuth_median_deg", "median azimuth error, degrees", 90.0),
    ("reversed", "azimuth off by more than 90 degrees, share", 0.5),
    ("iou", "mask IoU", 1.0),
    ("place", "place on the canonical surface, cross-entropy", 8.5),
)
COLOURS = {"quadruped": "#b4550a", "human": "#1f5fa8"}
WIDTH, HEIGHT, GAP = 380, 190, 56


def read_logs(paths: list[Path]) -> list[dict[str, float]]:
    """Lines of logs, one after the other; `pictures` counts on over all of them."""
    rows: list[dict[str, float]] = []
    before = 0.0
    for path in paths:
        lines = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
        rows += [{**row, "pictures": row["pictures"] + before} for row in lines]
        before = rows[-1]["pictures"] if rows else 0.0
    return rows


def draw(rows: list[dict[str, float]]) -> str:
    """The picture's text."""
    most = max(row["pictures"] for row in rows)
    parts = []
    for k, (key, title, top) in enumerate(PANELS):
        x0, y0 = GAP + (k % 2) * (WIDTH + GAP), 40 + (k // 2) * (HEIGHT + GAP + 14)
        parts.append(f'<rect x="{x0}" y="{y0}" width="{WIDTH}" height="{HEIGHT}" fill="none" stroke="#999"/>')
        parts.append(f'<text x="{x0}" y="{y0 - 8}">{title}</text>')
        for share in (0.0, 0.5, 1.0):
            y = y0 + HEIGHT * (1 - share)
            parts.append(f'<text x="{x0 - 6}" y="{y + 4}" text-anchor="end">{top * share:g}</text>')
            label = f"{most * share / 1000:.0f} k"
            parts.append(f'<text x="{x0 + WIDTH * share}" y="{y0 + HEIGHT + 16}" text-anchor="middle">{label}</text>')
        for name, colour in COLOURS.items():
            heights = [HEIGHT * (1 - min(row[f"{name}/{key}"] / top, 1.0)) for row in rows]
            across = [WIDTH * row["pictures"] / most for row in rows]
            points = " ".join(f"{x0 + x:.1f},{y0 + y:.1f}" for x, y in zip(across, heights, strict=True))
            parts.append(f'<polyline points="{points}" fill="none" stroke="{colour}" stroke-width="1.5"/>')
    for k, (name, colour) in enumerate(COLOURS.items()):
        parts.append(f'<text x="{GAP + 110 * k}" y="16" fill="{colour}" font-weight="bold">{name}</text>')
    width, height = 2 * (WIDTH + GAP) + 20, 40 + 2 * (HEIGHT + GAP + 14)
    head = f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" width="{width}" height="{height}"'
    style = 'font-family="sans-serif" font-size="12" fill="#222"'
    return "\n".join([f"{head} {style}>", '<rect width="100%" height="100%" fill="white"/>', *parts, "</svg>", ""])


def main(out: Annotated[Path, tyro.conf.Positional], logs: Annotated[list[Path], tyro.conf.Positional]) -> None:
    """Draw a training's log.

    Args:
        out: The SVG file to write.
        logs: `log.jsonl` of one run, or of several that went on from one another.
    """
    part = out.with_suffix(".part")
    part.write_text(draw(read_logs(logs)), encoding="utf-8")
    part.replace(out)


if __name__ == "__main__":
    tyro.cli(main)
