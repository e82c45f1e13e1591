"""Reports: numbers and pictures are those of the run, warnings are complete, and hostile names stay text."""

import html
import json
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browser import Browser, needs_browser
from fog import CUBE, fog
from markupsafe import escape
from present import present

from nerfcli.cameras.camera import Camera
from nerfcli.cameras.frame import Frame
from nerfcli.cameras.rigid import Similarity, look_at
from nerfcli.captures.formats.run_cameras import RunCameras
from nerfcli.errors import UserError
from nerfcli.evaluate.ledger import Entry
from nerfcli.evaluate.metrics import Metrics
from nerfcli.evaluate.photos import HeldOutPhoto
from nerfcli.evaluate.protocol import Novelty, PhotoMetrics, RunMetrics
from nerfcli.evaluate.report.page import from_above, page_html
from nerfcli.evaluate.report.run_facts import RunFacts, captures_of, labels_of, mismatches_of, read_facts, warnings_of
from nerfcli.evaluate.report.views import (
    ERROR_RANGE,
    HeldOutRenderings,
    common_names,
    depth_range,
    error_map,
    spread_evenly,
)
from nerfcli.evaluate.report.views import look_at as look_through
from nerfcli.pages import figures
from nerfcli.photos.colours import levels_of
from nerfcli.render.coverage import depth_maps
from nerfcli.render.depth import DepthRequest
from nerfcli.render.job import depth_meta
from nerfcli.training.runs.components import Components, Decision, Selection
from nerfcli.training.runs.files import LogEntry, TrainingSummary
from nerfcli.training.runs.run import Run, RunConfig, write_config
from nerfcli.training.runs.settings import TrainSettings

EVIL = "</script><script>alert(1)</script><b>\"'"
DEPTH = DepthRequest("conditional", "z", min_opacity=0.1)


def camera_at(name: str, place: tuple[float, float, float]) -> Frame:
    pose = look_at(np.array(place), np.zeros(3), np.array([0.0, -1.0, 0.0]))
    return Frame(name, Camera.pinhole(10, 8, 8.0), pose)


def logged(step: int, loss: float, *, rollbacks: int = 0) -> LogEntry:
    """A line of a log with ten steps a second."""
    return {
        "step": step,
        "seconds": step / 10,
        "loss": loss,
        "samples": 100_000 * step,
        "rays": 1_000 * step,
        "peak_memory_bytes": 10_000_000 * step,
        "samples_per_second": 1e6,
        "rays_per_second": 1e4,
        "rollbacks": rollbacks,
    }


def facts(label: str = "a run", **changes: Any) -> RunFacts:
    run = RunFacts(
        path=Path(label.replace("/", "_")),
        label=label,
        config=RunConfig(scene=Path("kitchen-scene"), split_sha256="1"),
        log=[logged(10, 0.1), {**logged(20, 0.01), "heldout_psnr": 21.5}],
        metrics=RunMetrics(
            "nerfcli-1",
            Metrics(23.456, 0.75),
            (PhotoMetrics("a.png", Metrics(23.456, 0.75), seconds=0.25),),
            training=TrainingSummary(10.0, 20, 1.5e6, 1e4, 10_000_000),
        ),
        poses=None,
        frames=RunCameras((camera_at("b.png", (0, 0, -2)),), (camera_at("a.png", (0, 0, -2)),)),
        field_bytes=8_000_000,
    )
    return replace(run, **changes)


PHOTO = np.full((8, 10, 3), 128, np.uint8)
MODEL = fog(CUBE, Similarity.identity(), background=(0.2, 0.4, 0.6), step=1 / 32)


@pytest.fixture(scope="module")
def look() -> list[HeldOutRenderings]:
    """Return views of a cube of fog from the poses of held-out grey photos."""
    fractions: list[float] = []
    held_out = [HeldOutPhoto(camera_at(name, (0.0, 0.0, -2.0)), PHOTO, None) for name in ("a.png", EVIL)]
    photos = depth_maps(MODEL, [camera_at("c.png", (0.0, 0.0, -2.0)), camera_at("d.png", (0.0, 0.0, 2.0))])
    look = look_through(MODEL, held_out, depth=DEPTH, photo_depths=photos, on_progress=fractions.append)
    assert fractions == [0.5, 1.0]
    return look


def page_of(*runs: RunFacts, looks: Sequence[list[HeldOutRenderings]]) -> str:
    return page_html(runs, looks, depths=[depth_meta(MODEL, DEPTH)] * len(runs))


def test_views_hold_the_photo_and_what_the_field_shows_of_it(look):
    view = look[0]
    np.testing.assert_array_equal(view.photo, PHOTO)
    assert view.picture.shape == view.error.shape == (8, 10, 3)
    np.testing.assert_array_equal(view.picture[0, 0], np.rint(np.array([0.2, 0.4, 0.6]) * 255))  # beside the cube
    difference = (view.picture.astype(float) - PHOTO) / 255.0
    assert view.metrics.psnr == pytest.approx(-10 * np.log10(np.square(difference).mean()), abs=1e-9)
    assert 0.0 < view.with_depth < 1.0
    assert view.with_depth == np.isfinite(view.depth).mean()
    colours = depth_range(look)
    assert 1.5 <= colours.low < colours.high <= 2.5  # between the cube's front and back
    # The training photo from the same side sees the surface, the one from behind does not.
    np.testing.assert_array_equal(view.coverage[3:5, 4:6], 1.0)
    assert np.isnan(view.coverage[0, 0])


def test_errors_have_the_colours_of_their_size_and_what_does_not_count_is_grey():
    photo = np.zeros((1, 4, 3), np.uint8)
    picture = np.zeros_like(photo)
    picture[0, 1] = round(255 * ERROR_RANGE / 2)
    picture[0, 2] = 255
    drawn = error_map(picture, photo, used=np.array([[True, True, True, False]]))
    colours = levels_of("viridis")
    np.testing.assert_array_equal(drawn[0, 0], colours[0])
    np.testing.assert_allclose(drawn[0, 1].astype(int), colours[128], atol=2)
    np.testing.assert_array_equal(drawn[0, 2], colours[255])
    np.testing.assert_array_equal(drawn[0, 3], 128)


def test_photos_are_chosen_from_the_worst_to_the_best():
    names = [f"{index}.jpg" for index in range(9)]
    quality = {name: float((5 * index) % 9) for index, name in enumerate(names)}
    chosen = spread_evenly(names, 3, quality=quality)
    assert sorted(quality[name] for name in chosen) == [0.0, 4.0, 8.0]
    assert chosen == sorted(chosen)
    assert spread_evenly(names, 20, quality={}) == names
    assert spread_evenly(names, 3, quality={}) == ["0.jpg", "4.jpg", "8.jpg"]
    assert spread_evenly(names, 0, quality=quality) == []


def test_runs_are_shown_by_photos_that_all_of_them_hold_out():
    def holding(*names: str) -> RunFacts:
        return facts(frames=RunCameras((), tuple(camera_at(name, (0, 0, -2)) for name in names)))

    both = [holding("a.png", "b.png", "c.png"), holding("c.png", "a.png", "d.png")]
    assert common_names(both, 8) == ["a.png", "c.png"]
    assert common_names([holding("a.png"), holding("b.png")], 8) == []


def layers_in(page: str) -> list[list[dict[str, Any]]]:
    data = re.search(r'<script type="application/json" id="views">(.*?)</script>', page, re.DOTALL)
    return json.loads(present(data)[1])


def test_the_page_shows_the_numbers_and_embeds_the_pictures(look):
    text = page_of(facts(), looks=[look])
    for number in ("23.46 dB", "0.7500", "1.50 M", "0.25 s", "8.0 MB", "200 MB", ">20<"):
        assert number in text
    assert "conditional depth along the optical" in text
    assert not re.search(r"(src|href)=\"?http", text)
    layers = layers_in(text)
    assert [layer["label"] for layer in layers[0]] == ["photo", "rendered", "error", "depth", "coverage"]
    assert all(layer["uri"].startswith("data:image/jpeg;base64,") for view in layers for layer in view)


def test_a_run_that_shares_photos_with_two_others_joins_their_captures():
    tests = [("a.png",), ("b.png",), ("c.png",), ("b.png", "a.png")]
    runs = [
        facts(str(number), frames=RunCameras((), tuple(camera_at(name, (0, 0, -2)) for name in names)))
        for number, names in enumerate(tests)
    ]
    assert captures_of(runs) == [[0, 1, 3], [2]]


def two_captures(look: list[HeldOutRenderings]) -> str:
    """A page about two runs of one capture and one of another, whose photo has the same name."""

    def holding(label: str, image: str, psnr: float) -> RunFacts:
        frame = replace(camera_at("a.png", (0, 0, -2)), image=Path(image))
        run = facts(label, frames=RunCameras((), (frame,)))
        return replace(run, metrics=replace(present(run.metrics), mean=Metrics(psnr)))

    runs = [holding("one", "x/a.png", 9.5), holding("two", "y/a.png", 30.0), holding("three", "x/a.png", 25.0)]
    assert captures_of(runs) == [[0, 2], [1]]
    return page_of(*runs, looks=[look] * 3)


def test_photos_of_the_same_name_in_two_captures_stay_apart(look):
    text = two_captures(look)
    rendered = [[layer["label"] for layer in view if "rendered" in layer["label"]] for view in layers_in(text)]
    assert rendered == [["one: rendered", "three: rendered"]] * len(look) + [["two: rendered"]] * len(look)
    assert "different held-out photos" not in text
    assert text.count('<img class="thumbnail"') == 3
    assert 'class="thumbnail"' not in page_of(facts(), facts(), looks=[look, look])


@needs_browser
def test_captures_are_sorted_by_a_click(look, tmp_path):
    (tmp_path / "page.html").write_text(two_captures(look), encoding="utf-8")
    with Browser(tmp_path / "profile") as browser:
        browser.send("Page.navigate", url=(tmp_path / "page.html").resolve().as_uri())
        browser.wait("document.readyState == 'complete' && document.querySelectorAll('.sortable').length")
        click = "[...document.querySelectorAll('.sortable button')].find(b => b.textContent == 'PSNR, dB').click()"
        order = "[...document.querySelectorAll('.sortable tbody tr')].map(row => row.cells[1].textContent).join()"
        assert browser.run(order) == "one,two,three"
        browser.run(click)
        assert browser.run(order) == "one,three,two"  # 9.5 before 25: by number, not by text
        browser.run(click)
        assert browser.run(order) == "two,three,one"
        assert not browser.errors


def test_what_comes_from_outside_stays_text(look):
    run = facts(EVIL, config=RunConfig(scene=Path(EVIL), versions={EVIL: EVIL}, missing_photos=(EVIL,), unit=EVIL))
    text = page_of(run, looks=[look])
    assert "<script>alert" not in text
    assert "<b>\"'" not in text
    assert escape(EVIL) in text


def test_runs_stand_side_by_side_and_what_differs_comes_first(look):
    other = facts("another", config=replace(facts().config, settings=TrainSettings(log2_rows=14)))
    text = page_of(facts(), other, looks=[look, look])
    assert "differs: settings.log2_rows" in text
    assert "<th class=number>another</th>" in text
    assert text.index("differs: settings.log2_rows") < text.index(">settings.seed<")
    assert "settings.field_memory_bytes" not in text  # what no run states
    assert "another: rendered" in text
    on_gpu = facts("on a GPU", config=replace(facts().config, settings=TrainSettings(device="cuda")))
    text = page_of(facts(), on_gpu, looks=[look, look])
    assert re.search(r"differs: settings.samples_per_step</t.>\s*<td[^>]*>65536</td>\s*<td[^>]*>262144<", text)
    farther = [replace(view, depth=view.depth + 1) for view in look]
    near, both = depth_range(look), depth_range([*look, *farther])
    assert f"&gt;= {both.high:.3g}" in page_of(facts(), other, looks=[look, farther])  # one range for a scene
    foreign = replace(other, config=RunConfig(scene_fingerprint="x"))
    assert f"&gt;= {near.high:.3g}" in page_of(facts(), foreign, looks=[look, farther])
    assert near.low < near.high < both.high


def test_the_page_shows_cameras_chosen_components_and_how_new_the_views_are(look):
    run = facts()
    view = Novelty("b.png", 1.0, 0.1234, None, 5.67, "extrapolation")
    metrics = replace(
        present(run.metrics),
        images=tuple(PhotoMetrics(name, Metrics(19.5), view=view) for name in ("a.png", "b.png", "c.png")),
        ledger=(Entry("poses", True, "all photos were matched"),),
    )
    decision = Decision("view", 0, 0.5, 0.1, None, -0.02, None, True, "so")
    config = replace(run.config, selection=Selection(Components(), (decision,), 1.0))
    text = page_of(replace(run, metrics=metrics, config=config), looks=[look])
    for cell in ("0.123", "5.7", "extrapolation", "all photos were matched", "19.50 dB (3)"):
        assert cell in text
    for cell in ("view=0", "+0.50 ± 0.10", "-2%"):
        assert cell in text
    assert "view=0" not in page_of(run, looks=[look])


def test_numbers_that_must_not_be_compared_are_named():
    one = facts()
    assert list(mismatches_of([one, facts("b")])) == []
    metrics = replace(present(one.metrics), protocol="x", device="cuda")
    foreign = replace(one, config=RunConfig(split_sha256="2"), metrics=metrics)
    reported = list(mismatches_of([one, foreign]))
    assert len(reported) == 3
    assert "have different held-out photos" in reported[0]


def test_everything_that_was_warned_about_is_listed():
    poses = {
        "images": [{"name": "c.png", "registered": False, "reason": "too few matches"}, {"registered": True}],
        "verdict": {"failures": [{"kind": "implausible", "evidence": "the focal length is 9 times the width"}]},
        "attempts": [{"what": "default thresholds"}, {"what": "full size", "doubt": "two sides may look alike"}],
        "pose_blur_px": {"largest": 3.21, "photo": "d.png"},
    }
    config = RunConfig(missing_photos=("e.png",), warnings=("intrinsics were halved",))
    run = facts(poses=poses, metrics=None, config=config)
    run.log.append(logged(30, 0.01, rollbacks=2))
    reported = [f"{stage}: {text}" for stage, text in warnings_of(run)]
    for part in (
        "poses: two sides may look alike",
        "poses: implausible: the focal length is 9 times the width",
        *("c.png (too few matches)", "2 attempts", "d.png is uncertain by 3.2 px"),
        *("e.png", "intrinsics were halved", "non-finite 2 times", "nerfcli evaluate"),
    ):
        assert sum(part in text for text in reported) == 1, part
    assert len(reported) == 9
    assert list(warnings_of(facts())) == []


def test_a_report_of_poses_that_cannot_be_reached_is_no_missing_one(tmp_path):
    """Regression: warnings about the poses were silently left out."""
    scene, run = tmp_path / "scene", tmp_path / "run"
    for folder in (scene, run):
        folder.mkdir()
    write_config(run, RunConfig(scene=scene))
    (run / "log.jsonl").touch()
    (scene / "poses_report.json").symlink_to("poses_report.json")
    with pytest.raises(UserError, match=r"cannot read .*poses_report\.json"):
        read_facts(Run(run), "a run", checkpoint_sha256="1")


def test_labels_are_the_shortest_ends_that_differ():
    assert labels_of([Path("/a/run")]) == ["run"]
    assert labels_of([Path("/a/x/run"), Path("/a/y/run")]) == ["x/run", "y/run"]
    assert labels_of([Path("/a/run"), Path("/a/run")]) == ["/a/run (1)", "/a/run (2)"]


def test_curves_go_where_their_values_say():
    """On a linear axis, and decades on a logarithmic one; what cannot be drawn is left out."""
    for y, logarithmic in (([0, 5, 10], False), ([1, 10, 100], True)):
        curve = figures.Curve(0, "a", [0, 1, 2], y)
        (axes,) = present(figures.curves([curve], y_title="y", logarithmic=logarithmic)).axes
        assert axes.get_yscale() == ("log" if logarithmic else "linear")
        np.testing.assert_array_equal(axes.lines[0].get_xydata(), np.column_stack([[0, 1, 2], y]))
    assert figures.curves([figures.Curve(0, "a", [0.0], [float("nan")])], y_title="y") is None
    assert figures.curves([figures.Curve(0, "a", [0.0], [0.0])], y_title="y", logarithmic=True) is None


def test_drawings_say_what_they_show_load_nothing_and_are_always_the_same():
    figure = present(figures.curves([figures.Curve(0, EVIL, [0.0, 1.0], [1.0, 2.0], dots=True)], y_title="dB"))
    drawn = figures.svg(figure)
    assert drawn.startswith("<svg")
    assert "<script>" not in drawn
    titles = [html.unescape(title) for title in re.findall("<title>(.*?)</title>", drawn)]
    assert titles == [EVIL, f"{EVIL}: 1 at 0 s", f"{EVIL}: 2 at 1 s"]
    assert "http" not in drawn
    assert "var(--soft)" in drawn
    assert figures.svg(figure) == drawn


def test_a_ring_of_cameras_is_drawn_as_a_ring_whichever_way_it_is_turned():
    angles = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    turn = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]
    frames = [camera_at(f"{i}", tuple(turn @ (5 * np.cos(a), 0.0, 5 * np.sin(a)))) for i, a in enumerate(angles)]
    (axes,) = from_above(frames[:9], frames[9:]).axes
    dots = [line for line in axes.lines if line.get_marker() == "o"]
    radii = np.linalg.norm(np.concatenate([dot.get_xydata() for dot in dots]), axis=1)
    assert radii == pytest.approx(np.full(12, 5.0), rel=1e-9)
    assert [dot.get_color() == figures.LOOK for dot in dots] == [False] * 9 + [True] * 3
