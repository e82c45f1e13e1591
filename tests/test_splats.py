"""Splats of a run: refined, saved, resumed, interrupted, written, read, rendered and evaluated."""

import os
import re
import shutil
import signal
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from commands import nerfcli as command
from present import present

import nerfcli
from nerfcli import Output, Reporter
from nerfcli.cameras.camera import Camera
from nerfcli.cameras.frame import Frame
from nerfcli.cameras.rigid import Similarity, look_at
from nerfcli.captures.formats.run_cameras import write_cameras
from nerfcli.errors import UserError, duration, in_shell
from nerfcli.field.exposure import exposed
from nerfcli.kernels.numba_cpu.splats import render_splats
from nerfcli.photos.images import read_image, write_png
from nerfcli.photos.loading import LoadedPhoto
from nerfcli.render.depth import DepthRequest
from nerfcli.render.job import RenderSettings
from nerfcli.splats import refine as refinement
from nerfcli.splats.gaussians import Gaussians, gaussians_of, rows_of
from nerfcli.splats.refine import Refinement, load_splat_state, refine, splat_photos
from nerfcli.splats.render import SplatScene
from nerfcli.training.runs.files import SPLATS, left_out_mask
from nerfcli.workflows.evaluate import evaluate_splats
from nerfcli.workflows.render import render_splats as render_file
from nerfcli.workflows.splats import SplatSettings
from nerfcli.workflows.views import Views

CAMERA = Camera("PINHOLE", 64, 48, (60.0, 60.0, 32.0, 24.0))
IDENTITY = Similarity.identity()
SMALL = SplatSettings(count=800, budget_seconds=1.0, degree=1)


def frames(count: int = 6) -> list[Frame]:
    """Return cameras on an arc around the origin."""
    angles = np.linspace(-0.6, 0.6, count)
    centres = 3.0 * np.stack([np.sin(angles), 0 * angles, -np.cos(angles)], axis=-1)
    up = np.array([0.0, -1.0, 0.0])
    return [Frame(f"{k}.png", CAMERA, look_at(centre, np.zeros(3), up)) for k, centre in enumerate(centres)]


def wall() -> Gaussians:
    """Return Gaussians of many colours on a wall."""
    rng = np.random.default_rng(0)
    x, y = np.meshgrid(np.linspace(-1.5, 1.5, 24), np.linspace(-1.1, 1.1, 18))
    count = x.size
    means = np.stack([x.ravel(), y.ravel(), 0.2 * np.sin(3 * x.ravel())], axis=-1)
    scales = np.full((count, 3), np.log(0.06))
    quaternions = np.tile([1.0, 0, 0, 0], (count, 1))
    return Gaussians(means, scales, quaternions, np.full(count, 2.0), rng.uniform(-1.5, 1.5, (count, 1, 3)))


def photographed(gaussians: Gaussians) -> list[LoadedPhoto]:
    scene = SplatScene(gaussians)
    pictures = [(frame, scene.render(frame).rgb) for frame in frames()]
    return [LoadedPhoto(frame, np.rint(255 * rgb).astype(np.uint8), None) for frame, rgb in pictures]


def photos_of(gaussians: Gaussians) -> list[refinement.SplatPhoto]:
    return splat_photos(photographed(gaussians), np.zeros((6, 3)), splats_from_scene=IDENTITY, near=0.0)


def error_of(state: Refinement, photos: list[refinement.SplatPhoto]) -> float:
    black = np.zeros(3, np.float32)
    return float(np.mean([np.abs(render_splats(state.rows, p.view, black).image - p.target(black)) for p in photos]))


def perturbed() -> Refinement:
    rng, true = np.random.default_rng(1), wall()
    means = true.means + rng.normal(size=true.means.shape) * 0.02
    return Refinement.of(rows_of(replace(true, means=means, harmonics=0.5 * true.harmonics)))


def test_refinement_recovers_what_was_photographed() -> None:
    """Gaussians that were moved by a third of their size and faded give the photos again, to 2 of 255 levels."""
    photos, state = photos_of(wall()), perturbed()
    assert error_of(state, photos) > 0.05
    refine(state, photos, background=(0, 0, 0), steps=300)
    assert error_of(state, photos) < 0.008


def test_refinement_by_steps_has_the_same_bits_with_any_threads() -> None:
    photos, one, other = photos_of(wall()), perturbed(), perturbed()
    for threads, state in ((1, one), (2, other)):
        torch.set_num_threads(threads)
        refine(state, photos, background=(0, 0, 0), steps=12)
    np.testing.assert_array_equal(one.rows, other.rows)


def test_gains_of_photos_are_divided_out() -> None:
    """Photos taken with half and twice the exposure ask for the same splats; levels that saturate excepted."""
    photos = photographed(wall())
    gains = np.log(np.array([[0.5] * 3, [1.2, 1.0, 0.9]] * 3))
    taken = []
    for photo, gain in zip(photos, gains, strict=True):
        seen = exposed(torch.tensor(photo.pixels / 255.0), torch.tensor(gain)).numpy().clip(0, 1)
        taken.append(replace(photo, pixels=np.rint(255 * seen).astype(np.uint8)))
    black = np.zeros(3, np.float32)
    same = splat_photos(photos, np.zeros((6, 3)), splats_from_scene=IDENTITY, near=0.0)
    found = splat_photos(taken, gains, splats_from_scene=IDENTITY, near=0.0)
    for photo, wanted, raw in zip(found, same, taken, strict=True):
        clear = (raw.pixels > 20) & (raw.pixels < 255)
        np.testing.assert_allclose(photo.target(black)[clear], wanted.target(black)[clear], atol=0.012)


def test_masked_pixels_have_no_say() -> None:
    """Under a mask the photos are white, and the splats stay as they are there."""
    photos, used = photographed(wall()), np.ones((48, 64), bool)
    used[:, 32:] = False
    hidden = [replace(p, pixels=np.where(used[..., None], p.pixels, 255).astype(np.uint8), used=used) for p in photos]
    state = Refinement.of(rows_of(wall()))
    targets = splat_photos(hidden, np.zeros((6, 3)), splats_from_scene=IDENTITY, near=0.0)
    refine(state, targets, background=(0,) * 3, steps=30)
    shown = SplatScene(gaussians_of(state.rows)).render(frames()[2]).rgb
    assert np.abs(shown - photos[2].pixels / 255).mean() < 0.01


def test_frames_and_depth_of_a_scene() -> None:
    """Depth along the optical axis is that along the ray times the cosine; the wall is where it was put."""
    scene, frame = SplatScene(wall(), unit="metre"), frames()[2]
    along = scene.render(frame, depth=DepthRequest("conditional", "ray"))
    z = scene.render(frame, depth=DepthRequest("conditional", "z"))
    cosines = frame.camera.pixel_bearings()[0][:, 2].reshape(48, 64)
    np.testing.assert_allclose(present(z.depth), present(along.depth) * cosines, rtol=1e-5)
    median = present(scene.render(frame, depth=DepthRequest("median", "z")).depth)
    assert 2.7 < np.nanmin(median) < np.nanmax(median) < 3.4
    moved = Similarity(2.0, np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]]), np.array([1.0, 2, 3]))
    elsewhere = replace(frame, world_from_cam=moved.apply_pose(frame.world_from_cam))
    there = SplatScene(wall().moved(moved)).render(elsewhere)
    np.testing.assert_allclose(there.rgb, along.rgb, atol=2e-3)


@pytest.fixture(scope="module")
def run(spheres_run: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of a trained run, in which splats may be kept."""
    return shutil.copytree(spheres_run, tmp_path_factory.mktemp("splats") / "spheres-run")


def test_export_refines_once_and_writes_every_format(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The .ply and .spz hold the same scene, whichever frame they are in; the second export uses the first's splats."""
    monkeypatch.setattr("nerfcli.workflows.splats.BELOW_DB", -100.0)
    notes: list[str] = []
    details: list[str] = []
    reporter = Reporter(note=notes.append, progress=lambda fraction, detail: details.append(detail))
    ply = nerfcli.export_run(run, to="splats", splats=SMALL, reporter=reporter)
    # The budget counts down; what comes before it says nothing about its speed.
    budget = duration(SMALL.budget_seconds)
    assert f"depths of the training photos, {budget} of refinement left" in details
    assert f"pictures of the field, {budget} of refinement left" in details
    assert re.fullmatch(r"refining \d+ splats, 0 s left", details[-1])
    assert ply == run.with_name("spheres-run-splats.ply")
    (compared,) = (line for line in notes if "training photos: field" in line)
    # Regression: it named options that `nerfcli run` does not have, and not that the file is to be replaced.
    assert f"to go on: nerfcli export {in_shell(run)} --to splats --resume --overwrite --budget" in compared
    state = (run / SPLATS).read_bytes()
    for name, frame in (("a.spz", "viewer"), ("b.ply", "scene")):
        nerfcli.export_run(run, Output(run.with_name(name)), to="splats", splats=replace(SMALL, frame=frame))
    nerfcli.export_run(run, Output(run.with_name("c.html")), to="splats", splats=SMALL)
    assert (run / SPLATS).read_bytes() == state
    held_out = nerfcli.load_run(run).cameras.test[0]
    pictures = [nerfcli.load_splats(run.with_name(n)).render(held_out).rgb for n in (ply.name, "b.ply", "a.spz")]
    np.testing.assert_allclose(pictures[0], pictures[1], atol=2e-3)
    assert np.abs(pictures[0] - pictures[2]).mean() < 0.01
    assert len(nerfcli.load_splats(ply).gaussians) <= 800


def test_what_splats_cannot_do_is_refused(run: Path) -> None:
    """A page in the scene's frame; cameras of a file of splats; splats that are not there."""
    with pytest.raises(UserError, match="the page needs y to point down"):
        nerfcli.export_run(run, Output(run.with_name("d.html")), to="splats", splats=replace(SMALL, frame="scene"))
    ply = run.with_name("spheres-run-splats.ply")
    for arguments, words in (
        (["render", ply, "--cameras", run / "cameras.json", "--cameras-only"], "--cameras-only works with a run"),
        (["render", ply, "--cameras", run / "cameras.json", "--splats", ply], "--splats works with a run"),
        (["evaluate", run, "--splats", run / "none.ply"], "there is no"),
    ):
        refused = command(*arguments)
        assert refused.exit_code == 2
        assert words in " ".join(refused.stderr.split())


def test_a_refused_path_does_not_end_a_batch(run: Path, tmp_path: Path) -> None:
    ply = run.with_name("spheres-run-splats.ply")
    done = command("render", "-", "--cameras-only", "-o", tmp_path, stdin=f"{ply}\n{run}\n")
    assert done.exit_code == 2
    assert "--cameras-only works with a run" in " ".join(done.stderr.split())
    assert [Path(line).is_dir() for line in done.stdout.splitlines()] == [True]


def test_resume_goes_on_and_other_settings_begin_again(run: Path) -> None:
    before = load_splat_state(run / SPLATS)
    longer = replace(SMALL, budget_seconds=1.5, resume=True)
    again = Output(overwrite=True)
    nerfcli.export_run(run, again, to="splats", splats=longer)
    after = load_splat_state(run / SPLATS)
    assert after.refinement.steps > before.refinement.steps
    assert len(after.refinement.rows) == len(before.refinement.rows)
    with pytest.raises(UserError, match="are missing, or were made from another field"):
        nerfcli.export_run(run, again, to="splats", splats=replace(longer, degree=2))
    nerfcli.export_run(run, again, to="splats", splats=replace(SMALL, degree=0, budget_seconds=0.2))
    assert load_splat_state(run / SPLATS).degree == 0


def test_an_interrupt_saves_the_splats_and_writes_no_file(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    steps: list[int] = []
    step = refinement.step_splats

    def interrupted(*given: object, **named: object) -> None:
        step(*given, **named)  # type: ignore[arg-type]
        steps.append(1)
        if len(steps) == 3:
            os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setattr(refinement, "step_splats", interrupted)
    target, notes = run.with_name("interrupted.ply"), []
    long, reporter = replace(SMALL, budget_seconds=60), Reporter(note=notes.append)
    with pytest.raises(KeyboardInterrupt):
        nerfcli.export_run(run, Output(target), to="splats", splats=long, reporter=reporter)
    assert not target.exists()
    assert load_splat_state(run / SPLATS).refinement.steps == 3
    assert notes[-1] == "the splats are saved; to continue, add --resume to the same command"


def test_pixels_that_the_training_left_out_have_no_say(
    spheres_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Regression: what the training left out as occluders, or beyond the domain of the lens, came back as splats."""
    run = shutil.copytree(spheres_run, tmp_path / "run")
    cameras = nerfcli.load_run(run).cameras
    first, second, *others = cameras.train
    width, height = first.camera.size
    mask = np.tile(np.arange(width) >= width // 2, (height, 1))
    write_png(left_out_mask(run, first.name), np.where(mask, 255, 0).astype(np.uint8))
    # The distortion of this lens turns back within the picture.
    lens = Camera("SIMPLE_RADIAL", width, height, (first.camera.focal_px, width / 2, height / 2, -3.0))
    has_ray = lens.pixel_bearings()[1].reshape(height, width)
    assert 0.1 < has_ray.mean() < 0.9
    write_cameras(run, [first, replace(second, camera=lens), *others], cameras.test)
    refined: list[refinement.SplatPhoto] = []

    def enough(state: object, photos: list[refinement.SplatPhoto], **more: object) -> None:
        refined.extend(photos)
        raise UserError("enough", "of this test")

    monkeypatch.setattr("nerfcli.workflows.splats.refine", enough)
    with pytest.raises(UserError, match="enough"):
        nerfcli.export_run(run, to="splats", splats=SMALL)
    np.testing.assert_array_equal(refined[0].used, mask)
    np.testing.assert_array_equal(refined[1].used, has_ray)
    assert [photo.used for photo in refined[2:]] == [None] * len(others)


def test_splats_of_panoramas_are_refused_before_any_work(
    spheres_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Regression: the field was rendered first, and the hint was for `nerfcli render`."""
    run = shutil.copytree(spheres_run, tmp_path / "run")
    first, *others = nerfcli.load_run(run).cameras.train
    sphere = Camera("EQUIRECTANGULAR", 96, 48, (96.0, 48.0))
    write_cameras(run, [replace(first, camera=sphere), *others], [])
    monkeypatch.setattr("nerfcli.training.runs.run.load_photos", lambda *given, **more: pytest.fail("work was done"))
    with pytest.raises(UserError, match="360-degree photos, which splats cannot be fitted to") as refused:
        nerfcli.export_run(run, to="splats", splats=SMALL)
    assert refused.value.hint == "export it as a page, a mesh or points: --to page, mesh or points"


def test_splats_of_a_run_in_a_read_only_folder_are_exported(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Regression: they were refined, and then lost, because they could not be kept in the run."""

    def refuse(path: Path, splats: object) -> None:
        raise UserError(f"cannot write {path}: Read-only file system", "free it")

    monkeypatch.setattr("nerfcli.workflows.splats.save_splats", refuse)
    notes: list[str] = []
    other = replace(SMALL, count=700, budget_seconds=0.2)
    reporter = Reporter(note=notes.append)
    nerfcli.export_run(run, Output(run.with_name("r.ply")), to="splats", splats=other, reporter=reporter)
    assert f"the splats could not be saved in the run: cannot write {run / SPLATS}: Read-only file system" in notes
    assert len(nerfcli.load_splats(run.with_name("r.ply")).gaussians) <= 700


def test_splats_are_measured_by_the_protocol_of_fields(run: Path) -> None:
    """The number in the file is that of the picture that `render` writes."""
    ply = run.with_name("spheres-run-splats.ply")
    found = evaluate_splats(run, ply)
    name = found.metrics.images[0].name
    settings = RenderSettings(("rgb",), DepthRequest("median", "z"), rgba=False)
    folder = nerfcli.render_run(run, splats=ply, settings=settings)
    assert folder[0].parent.name == "test-splats"
    shown = read_image(next(folder[0].rglob(f"{Path(name).stem}.png")))
    assert shown.shape[:2] == (72, 96)
    assert found.metrics.protocol.startswith("nerfcli-2")
    assert present(found.metrics.splats)["count"] == len(nerfcli.load_splats(ply).gaussians)
    assert evaluate_splats(run, ply).is_kept


def test_foreign_splats_are_rendered_with_the_cameras_of_a_file(run: Path, tmp_path: Path) -> None:
    """The pictures are those of `SplatScene`; cameras of a run and photos are refused in two lines."""
    ply = shutil.copy(run.with_name("b.ply"), tmp_path / "b.ply")
    settings = RenderSettings(("rgb", "depth"), DepthRequest("median", "z"))
    rgb, _ = render_file(ply, views=Views(str(run / "cameras.json")), settings=settings)
    assert rgb == tmp_path / "b-renders" / "cameras-median-z" / "rgb"
    frame = nerfcli.load_run(run).cameras.test[0]
    picture = nerfcli.load_splats(ply).render(frame).rgb
    shown = read_image(next(rgb.rglob(f"{Path(frame.name).stem}.png")))
    assert np.abs(shown / 255 - picture).max() < 0.003
    with pytest.raises(UserError, match=r"c\.ply does not exist"):
        render_file(tmp_path / "c.ply", views=Views("orbit"), settings=settings)
    with pytest.raises(UserError, match="has no cameras"):
        render_file(ply, views=Views("orbit"), settings=settings)
    with pytest.raises(UserError, match="need training photos"):
        render_file(ply, views=Views(str(run / "cameras.json")), settings=replace(settings, outputs=("coverage",)))
