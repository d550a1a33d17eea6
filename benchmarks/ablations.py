"""The rows of the paper's ablation table, on one object of an evaluation data set with true masks and root poses.

``python -m benchmarks.ablations --data DATA/fox --evaluate evaluate.py [--rows full bones-9 ...] [--scale 0.7]``

Every row is the preset with one thing changed; all see the same frames. Prints a table as rows finish. Phase two is
left out unless features are read, as it has nothing to go by without them.
"""

from __future__ import annotations

import logging
import tempfile
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
import tyro

from benchmarks.trials import judge, observe, presets, reconstruct, shaken, write_meshes

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Row:
    """What one row changes."""

    fit: dict[str, Any] = field(default_factory=dict)
    every: dict[str, Any] = field(default_factory=dict)
    """Settings of all phases."""
    clips: int = 5
    noise_deg: float = 0.0
    given_roots: bool = True
    no_roots: bool = False


ROWS: dict[str, Row] = {
    "full": Row(),
    **{f"bones-{n}": Row(fit={"bones": n}) for n in (4, 9, 16, 64)},
    "no-in-surface": Row(every={"weight_bone_location": 0.0}),
    **{f"noise-{d}": Row(noise_deg=d, given_roots=False) for d in (20, 50, 90)},
    **{f"clips-{n}": Row(clips=n) for n in (2, 4)},
    "active-25": Row(every={"active_share": 0.25}),
    "active-50": Row(every={"active_share": 0.5}),
    "edge-50": Row(every={"edge_share": 0.5}),
    "se3": Row(fit={"deformation": "se3"}),
    "translation": Row(fit={"deformation": "translation"}),
    "dual-quaternions": Row(fit={"blending": "dual_quaternion"}),
    "no-registration": Row(every={"weight_feature": 0.0, "weight_cycle_2d": 0.0, "weight_cycle_3d": 0.0}),
    "no-flow": Row(every={"weight_flow": 0.0}),
    "no-root-init": Row(no_roots=True, given_roots=False),
    "no-colour": Row(every={"weight_rgb": 0.0}),
    "no-delta": Row(every={"delta_from": 2.0}),
    "no-rest": Row(every={"weight_rest": 0.0}),
    "no-cover": Row(fit={"weight_cover": 0.0}),
    "no-spill": Row(fit={"weight_spill": 0.0}),
    "no-splines": Row(fit={"motion_spacing_s": 0.0}),
    "first-bones": Row(fit={"renew_at": 2.0}),
    "not-mended": Row(every={"mend": False}),
    "firm-joints": Row(every={"weight_joints": 0.5}),
    "one-cycle": Row(every={"rate": "one_cycle"}),
    "flow-first": Row(fit={"flow_only_every": 2}),
    "sphere-start": Row(fit={"start": "sphere"}),
}


def main(
    data: Path,
    evaluate: Path,
    rows: tuple[str, ...] = ("full", "bones-9", "no-flow", "no-in-surface", "se3", "translation", "clips-2"),
    preset: str = "preview",
    scale: float = 1.0,
    seed: int = 0,
    threads: int = 2,
) -> None:
    """Reconstruct once a row and print the paper's table.

    Args:
        data: Folder of one object of the evaluation data set.
        evaluate: Path of the evaluation script.
        rows: Which rows, in this order (see ROWS in this file).
        preset: Whose settings are changed.
        scale: Multiplies every phase's number of steps.
        seed: Of every fit.
        threads: Of the processor.
    """
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    torch.set_num_threads(threads)
    unknown = [r for r in rows if r not in ROWS]
    if unknown:
        raise SystemExit(f"no row {unknown[0]!r}; there are {', '.join(ROWS)}")
    log.info("| %s | CD cm | pred>gt | gt>pred | F@1 | F@2 | F@5 | CPU s |", data.name)
    log.info("| --- | --- | --- | --- | --- | --- | --- | --- |")
    whole = observe(data)
    for name in rows:
        row = ROWS[name]
        seen = whole if row.clips >= 5 else observe(data, clips=row.clips)
        if row.noise_deg:
            seen = replace(seen, poses=shaken(seen.poses, row.noise_deg, seed))
        if row.no_roots:
            seen = replace(seen, poses=seen.poses[:1].expand(len(seen.poses), 4, 4).clone())
        fit, correct, refine = presets(preset, scale, seed)
        fit, refine = replace(fit, **row.every, **row.fit), replace(refine, **row.every)
        model, seconds = reconstruct(seen, fit, replace(correct, iterations=0), refine, hold_roots=row.given_roots)
        with tempfile.TemporaryDirectory(prefix="ablation-") as folder:
            write_meshes(model, Path(folder))
            s = judge(evaluate, data, Path(folder), clips=row.clips)
        log.info(
            "| %s | %.2f | %.2f | %.2f | %.1f | %.1f | %.1f | %.0f |",
            *(name, s.chamfer, s.to_truth, s.from_truth, s.f1, s.f2, s.f5, seconds),
        )


if __name__ == "__main__":
    tyro.cli(main)
