"""The report stage: one offline page, text that stays text, advice that follows from figures; seen in a browser."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest

from pipeline import Folder, Run
from stages import export as export_module
from stages import formats
from stages.export import export
from stages.report import ReportSettings, _check, report
from stages.reporting import page, views
from stages.reporting.clips import encoded, shrink_video
from stages.video_io import read_pictures
from tests.stages.articulated_chain import Chain, write_inputs
from tests.stages.headless import Page, find_browser
from tests.stages.test_export import SETTINGS

HOSTILE = "<img src=x onerror=alert(1)>"
NAMES = [HOSTILE, "plain & <b>bold"]
DEFAULT = ReportSettings()


def report_of(root: Path, names: list[str], settings: ReportSettings = DEFAULT) -> Path:
    """The page of an exported stand-in with these clips."""
    model = Chain(names, bones=5)
    folders = write_inputs(model, root / "again", 6)
    inputs = {kind: {n: Folder(p) for n, p in folders[kind].items()} for kind in ("frames", "masks", "features")}
    again = root / "again"
    patch = pytest.MonkeyPatch()
    patch.setattr(formats, "read_model", lambda folder: ({}, {}))
    patch.setattr(export_module.Banmo, "restore", staticmethod(lambda tensors, description: model))
    exported = root / "export"
    exported.mkdir()
    poses = Folder(again / "poses")
    try:
        export(
            Folder(again / "refine"),
            inputs["frames"],
            inputs["masks"],
            inputs["features"],
            poses,
            SETTINGS,
            exported,
            Run(),
        )
    finally:
        patch.undo()
    flow, features = {}, {}
    for k, name in enumerate(names):
        clip = formats.read_clip(inputs["frames"][name].path)
        for kind, held in (("flow", flow), ("feature-maps", features)):
            folder = root / kind / str(k)
            folder.mkdir(parents=True)
            held[name] = Folder(folder)
        (flow[name] / "fw-01").mkdir()
        for i in clip.source_idx[:-1]:
            field = np.full((clip.height, clip.width, 2), 1.5, np.float32)
            formats.write_flow(
                formats.flow_path(flow[name].path, 1, int(i)), field, np.ones(field.shape[:2], np.float32)
            )
        maps = np.random.default_rng(0).normal(size=(len(clip), 112, 112, 16)).astype(np.float16)
        np.save(features[name] / "features.npy", maps)
        rows = [{"name": n, "crop": [0, 0, 96, 96]} for n in clip.names]
        formats.write_json(features[name] / "features.json", {"network": "none", "frames": rows})
        track = formats.read_poses(again / "refine" / "poses" / f"{name}.json")
        formats.write_poses(again / "poses" / f"{name}.json", track, clip)
    rows = {n: {"provider": "given", "trust": 1.0, "score": 1.0, "fixed": True} for n in names}
    formats.write_json(again / "poses" / "poses.json", {"videos": rows, "trust": 1.0})
    phases = []
    for name in ("fit", "correct", "refine"):
        (root / name).mkdir()
        lines = "".join(json.dumps({"step": s, "total": 1 / s, "rgb": 0.5 / s}) + "\n" for s in range(1, 30))
        (root / name / "metrics.jsonl").write_text(lines)
        phases.append(Folder(root / name))
    out = root / "out"
    out.mkdir()
    fit, correct, refine = phases
    report(
        Folder(exported),
        fit,
        correct,
        refine,
        inputs["frames"],
        inputs["masks"],
        flow,
        features,
        poses,
        settings,
        out,
        Run(),
    )
    _check(out)
    return out / "report.html"


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return report_of(tmp_path_factory.mktemp("report"), NAMES)


def test_nothing_on_the_page_comes_from_elsewhere(written: Path) -> None:
    text = written.read_text(encoding="utf-8")
    assert not re.findall(r"""(?:src|href)\s*=\s*["'](?!data:|#)[a-z]+:""", text), "no address in any attribute"
    assert not re.findall(r"@import|url\(\s*['\"]?http", text)
    assert "default-src 'none'" in text
    assert text.count("data:video/mp4;base64,") == len(NAMES)
    assert text.count("data:image/jpeg;base64,") == 4 * len(NAMES)
    assert text.count("data:model/gltf-binary;base64,") == 1


def test_names_never_become_markup(written: Path) -> None:
    text = written.read_text(encoding="utf-8")
    assert HOSTILE not in text and "<b>bold" not in text
    data = json.loads(text.partition('id="data">')[2].partition("</script>")[0])
    assert [c["name"] for c in data["clips"]] == NAMES, "as data they are whole"
    assert data["clips"][0]["frames"] == 6 and len(data["clips"][0]["agreement"]) == 5
    assert data["curves"][0]["name"] == "All terms together" and data["steps"] == 87


def test_the_same_inputs_give_the_same_page(written: Path, tmp_path: Path) -> None:
    assert report_of(tmp_path, NAMES).read_bytes() == written.read_bytes()


def test_without_clips_in_it_the_page_is_small(tmp_path: Path) -> None:
    text = report_of(tmp_path, ["a"], ReportSettings(clips=0)).read_text(encoding="utf-8")
    assert "data:video" not in text and '"name":"a"' in text


def test_json_in_a_page_cannot_end_its_element() -> None:
    value = {"</script><script>": "<!--&"}
    text = page.json_text(value)
    assert not set("<>&") & set(text) and json.loads(text) == value


def test_videos_are_made_smaller_until_they_fit(written: Path) -> None:
    video = next((written.parent.parent / "export").glob("overlay-*.mp4"))
    whole = video.stat().st_size
    assert shrink_video(video, whole).data == video.read_bytes()
    half = encoded(video, 0.5, 30)
    small = written.parent / "half.mp4"
    small.write_bytes(half)
    before, after = read_pictures(video, 100), read_pictures(small, 100)
    assert len(before) == len(after) and after[0].shape[1] <= before[0].shape[1] // 2 + 2
    assert shrink_video(video, 10).data == b"" and len(shrink_video(video, whole - 1).data) < whole


# --------------------------------------------------------------------------------------------- views


def test_camera_directions_are_those_of_the_camera_seen_from_the_object() -> None:
    upright = np.diag([1.0, -1.0, -1.0])
    poses = np.repeat(np.eye(4)[None], 3, axis=0)
    for i, azimuth in enumerate(np.radians([0.0, 90.0, 180.0])):
        c, s = np.cos(azimuth), np.sin(azimuth)
        poses[i, :3, :3] = upright @ np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]])
        poses[i, :3, 3] = [0, 0, 3]
    np.testing.assert_allclose(views.camera_directions(poses), [[0, 0], [90, 0], [180, 0]], atol=1e-9)


def test_the_widest_gap_goes_across_north() -> None:
    assert views.widest_gap(np.array([100.0, 200.0, 260.0])) == (200.0, 0.0)
    assert views.widest_gap(np.array([])) == (360.0, 0.0)
    assert views.side_name(271.0) == "right" and views.side_name(359.0) == "front"


def test_advice_names_the_side_nobody_filmed() -> None:
    half = np.linspace(0, 180, 40)
    assert any("from the right" in s for s in views.view_advice(half, {}))
    assert views.view_advice(np.linspace(0, 359, 40), {"left": 0.1}) == []
    assert "from below" in views.view_advice(np.linspace(0, 359, 40), {"underside": 0.9})[0]


def test_advice_about_a_clip_follows_from_its_frames() -> None:
    flags = [["missing"]] * 3 + [["border"]] * 4 + [[]] * 3
    found = views.clip_advice("c", [0.5] * 10, [0.2] * 4 + [0.9] * 6, flags)
    assert [w for w in ("30 %", "40 %", "100 %") if not any(w in s for s in found)] == []
    assert views.clip_advice("c", [0.9] * 10, [1.0] * 10, [[]] * 10) == []


def test_unseen_area_is_told_by_side() -> None:
    normals = np.array([[1.0, 0, 0], [1, 0.1, 0], [0, -1, 0]])
    found = views.unseen_by_side(normals, np.array([3.0, 1.0, 2.0]), np.array([True, False, False]))
    assert found == {"left": 0.25, "underside": 1.0}


# --------------------------------------------------------------------------------------------- in a browser


@pytest.fixture(scope="module")
def filled(written: Path) -> Path:
    """The page as it lies in exports/, with a file name that would like to be markup."""
    ran = [
        {"stage": "fit", "video": None, "seconds": 61.0, "when": "2026-01-02T03:04:05Z", "reason": f"never {HOSTILE}"}
    ]
    value = page.json_text(
        {"ran": ran, "videos": {HOSTILE: {"file": f"{HOSTILE}.mp4"}}, "settings": {"fit": {"a": HOSTILE}}}
    )
    text = written.read_text(encoding="utf-8").replace(
        page.PROVENANCE_MARK, page.PROVENANCE_MARK.replace("null", value)
    )
    path = written.with_name(f"{HOSTILE}.html")
    path.write_text(text, encoding="utf-8")
    return path


@pytest.mark.skipif(find_browser() is None, reason="no Chromium on this machine (Debian: apt install chromium)")
def test_in_a_browser(filled: Path, tmp_path: Path) -> None:
    """From disk, offline: no complaint, the canvas shows the model, playing changes it, clips can be chosen."""
    pixels = """(() => {
        banmoViewer.draw(); const v = document.getElementById('view'), c = document.createElement('canvas');
        c.width = 64; c.height = 64; const g = c.getContext('2d'); g.drawImage(v, 0, 0, 64, 64);
        return Array.from(g.getImageData(0, 0, 64, 64).data); })()"""

    def shown(browser: Page) -> np.ndarray:
        return np.array(browser.run(pixels), np.float64).reshape(64, 64, 4)

    with Page(tmp_path / "home") as browser:
        browser.open(filled)
        browser.wait("window.banmoViewer && (banmoViewer.ready || banmoViewer.error)")
        assert browser.run("banmoViewer.error || ''") == ""
        assert [u for u in browser.requests if not u.startswith(("data:", "blob:", "file:"))] == []
        browser.run("document.getElementById('play').click()")
        browser.run("banmoViewer.seek(0)")
        first = shown(browser)
        assert 0.02 < (first[..., 3] > 200).mean() < 0.7, "the model covers a part of the canvas"
        assert first[first[..., 3] > 200][:, :3].mean() > 40, "and is lit"
        browser.run("banmoViewer.seek(0.31)")
        later = shown(browser)
        assert np.abs(later - first).mean() > 0.3, "another moment, another picture"
        before = browser.run("banmoViewer.time")
        browser.run("document.getElementById('play').click()")
        browser.wait(f"banmoViewer.time !== {before}")
        browser.run("document.getElementById('play').click()")
        assert browser.run("Array.from(document.getElementById('clip').options).map((o) => o.value)") == NAMES
        browser.run(
            "(() => { const c = document.getElementById('clip'); c.value = c.options[1].value; c.onchange(); })()"
        )
        assert browser.run("banmoViewer.clip") == NAMES[1]
        looks = {}
        for look in ("colour", "skin", "seen", "normals"):
            browser.run(f"document.querySelector('[data-look=\"{look}\"]').click()")
            assert browser.run("banmoViewer.look") == look
            looks[look] = shown(browser)
        for look in ("skin", "seen", "normals"):
            assert np.abs(looks[look] - looks["colour"]).mean() > 1, f"{look} looks different"
        for box in ("bones", "wire", "filmed"):
            plain = shown(browser)
            browser.run(f"document.getElementById('{box}').click()")
            assert np.abs(shown(browser) - plain).mean() > 0.05, f"{box} changes the picture"
            browser.run(f"document.getElementById('{box}').click()")
        assert browser.run("document.querySelectorAll('img[src=x]').length") == 0, "no name became an element"
        assert browser.run("document.querySelector('.clip-card h3').textContent") == HOSTILE
        assert HOSTILE in browser.run("document.querySelector('.clip-head').textContent")
        assert HOSTILE in browser.run("document.getElementById('plan').textContent")
        browser.wait("Array.from(document.querySelectorAll('video')).every((v) => v.readyState >= 2)")
        browser.run("(() => { const v = document.querySelector('video'); v.currentTime = 0.3; })()")
        browser.wait("document.querySelector('.clip-card input[type=range]').value > 0.25")
        assert browser.errors() == []
