"""The rows of the paper's ablation table, on one object of an evaluation data set with true masks and root poses.

``python -m benchmarks.ablations --workspace W --data DATA/fox --evaluate evaluate.py [--rows full bones-9 ...]``

W holds what the product's stages make of that object: ``python -m benchmarks.tier_a --data DATA/fox --out IN``, then
``banmo run IN --workspace W --stage poses``. Every row is the preset with one thing changed; all see the same frames.
Prints each row as soon as it is done.
"""

from __future__ import annotations

import logging
import sys
import tempfile
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
import tyro

from benchmarks.trials import Phases, judge, observe, presets, reconstruct, shaken, steadied, write_meshes
from pipeline import BadInput
from stages.fitting.trainer import Diverged

log = logging.getLogger(__name__)
PAPER = ("full", "bones-9", "no-features", "no-cycle-3d", "no-flow", "no-in-surface", "se3", "translation", "clips-2")
NO_FEATURES = {"weight_feature": 0.0, "weight_match": 0.0, "weight_cycle_2d": 0.0}


@dataclass(frozen=True)
class Row:
    """What one row changes."""

    fit: dict[str, Any] = field(default_factory=dict)
    correct: dict[str, Any] = field(default_factory=dict)
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
    **{f"noise-{d}": Row(noise_deg=d, given_roots=False, fit={"settle_root": False}) for d in (20, 50, 90)},
    **{f"clips-{n}": Row(clips=n) for n in (2, 4)},
    "active-25": Row(every={"active_share": 0.25}),
    "active-50": Row(every={"active_share": 0.5}),
    "edge-50": Row(every={"edge_share": 0.5}),
    "se3": Row(fit={"deformation": "se3"}),
    "translation": Row(fit={"deformation": "translation"}),
    "dual-quaternions": Row(fit={"blending": "dual_quaternion"}),
    "no-features": Row(every=NO_FEATURES),
    "features-register": Row(every={"feature_pull": 1.0, "weight_cycle_2d": 0.02}, correct={"weight_cycle_2d": 0.1}),
    "no-cycle-3d": Row(every={"weight_cycle_3d": 0.0}),
    "no-registration": Row(every={**NO_FEATURES, "weight_cycle_3d": 0.0}),
    "no-flow": Row(every={"weight_flow": 0.0}),
    "no-root-init": Row(no_roots=True, given_roots=False),
    "no-colour": Row(every={"weight_rgb": 0.0}),
    "no-delta": Row(every={"delta_from": 2.0}),
    "no-rest": Row(every={"weight_rest": 0.0}),
    "cover": Row(fit={"weight_cover": 0.02}),
    "no-spill": Row(fit={"weight_spill": 0.0}),
    "no-splines": Row(fit={"motion_spacing_s": 0.0}),
    "no-shared-motion": Row(fit={"recur_at": ()}),
    "no-second-thoughts": Row(fit={"rethink_at": ()}),
    "first-bones": Row(fit={"renew_at": 2.0}),
    "not-mended": Row(every={"mend": False}),
    "firm-joints": Row(every={"weight_joints": 0.5}),
    "one-cycle": Row(every={"rate": "one_cycle"}),
    "flow-first": Row(fit={"flow_only_every": 2}),
    "sphere-start": Row(fit={"start": "sphere"}),
}


def changed(row: Row, phases: Phases) -> Phases:
    """The settings of a row, from those of the full one."""
    fit, correct, refine = phases
    return (
        replace(fit, **{**row.every, **row.fit}),
        replace(correct, **{**row.every, **row.correct}),
        replace(refine, **row.every),
    )


def main(
    workspace: Path,
    data: Path,
    evaluate: Path,
    rows: tuple[str, ...] = PAPER,
    preset: str = "preview",
    scale: float = 1.0,
    seed: int = 0,
    threads: int = 2,
    base: tuple[str, ...] = (),
) -> None:
    """Reconstruct once a row and print the paper's table.

    Args:
        workspace: Where the stages up to `poses` have run, with true masks and root poses given.
        data: Folder of the same object of the evaluation data set.
        evaluate: Path of the evaluation script.
        rows: Which rows, in this order (see ROWS in this file).
        preset: Whose settings are changed.
        scale: Multiplies every phase's number of steps.
        seed: Of every fit.
        threads: Of the processor.
        base: Rows whose changes hold for all others, too: what a few steps leave no room for.
    """
    # a handler flushes after every line: a run that is killed keeps its rows
    logging.basicConfig(level=logging.INFO, format="%(message)s", stream=sys.stdout)
    torch.set_num_threads(threads)
    unknown = [r for r in (*rows, *base) if r not in ROWS]
    if unknown:
        raise SystemExit(f"no row {unknown[0]!r}; there are {', '.join(ROWS)}")
    phases = presets(preset, scale, seed)
    for name in base:
        phases = changed(ROWS[name], phases)
    try:
        whole = observe(workspace, steps=phases[0].flow_steps)
    except BadInput as error:
        raise SystemExit(str(error)) from error
    log.info("| %s | CD cm | pred>gt | gt>pred | F@1 | F@2 | F@5 | CPU s |", data.name)
    log.info("| --- | --- | --- | --- | --- | --- | --- | --- |")
    for name in rows:
        row = ROWS[name]
        seen = whole if row.clips >= 5 else observe(workspace, row.clips, phases[0].flow_steps)
        if row.noise_deg:
            seen = steadied(replace(seen, poses=shaken(seen.poses, row.noise_deg, seed)))
        if row.no_roots:
            seen = replace(seen, poses=seen.poses[:1].expand(len(seen.poses), 4, 4).clone())
        try:
            model, seconds = reconstruct(seen, *changed(row, phases), hold_roots=row.given_roots)
        except (Diverged, BadInput) as error:  # the rows after it are worth having
            log.info("| %s | %s |", name, error)
            continue
        with tempfile.TemporaryDirectory(prefix="ablation-") as folder:
            write_meshes(model, Path(folder))
            # Fewer clips are scored on themselves, so the full row says what it makes of the same ones.
            fewer = sorted({ROWS[r].clips for r in rows} - {5}) if name == "full" else []
            for clips in (row.clips, *fewer):
                s = judge(evaluate, data, Path(folder), clips=clips)
                log.info(
                    "| %s | %.2f | %.2f | %.2f | %.1f | %.1f | %.1f | %.0f |",
                    name if clips == row.clips else f"{name}, scored on the first {clips} clips",
                    *(s.chamfer, s.to_truth, s.from_truth, s.f1, s.f2, s.f5, seconds),
                )


if __name__ == "__main__":
    tyro.cli(main)
