"""Scans through the commands: train, evaluate, render on a small phantom, and what they refuse."""

import gzip
import json
import re
import shutil
import signal
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tifffile
import torch
from commands import completed, nerfcli, refusal
from scan_of_phantom import phantom_circle, scan_of_phantom
from test_reconstruct import cone, scan_of, truth

from nerfcli.ct.evaluate import score_projections, score_volume
from nerfcli.ct.export import VolumeFile, export_scan, write_volume
from nerfcli.ct.formats.assemble import axis_column
from nerfcli.ct.geometry import ScanGeometry
from nerfcli.ct.grid import UNSEEN, VoxelGrid, centred_grid, marks
from nerfcli.ct.likelihood import Gaussian, Poisson
from nerfcli.ct.render import residual_of, slice_of
from nerfcli.ct.result import ReconstructionSettings, load_reconstruction, save_reconstruction
from nerfcli.ct.result import scan_of as scan_behind
from nerfcli.ct.scan import described_truth, save_scan
from nerfcli.ct.train import train_scan
from nerfcli.errors import BAD_INPUT, OUT_OF_MEMORY, UserError
from nerfcli.interrupts import Terminated
from nerfcli.notices import Reporter
from nerfcli.output import Output
from nerfcli.photos.images import read_image

# A geometry that is not estimated.
FIXED = ("--centre", "0", "--tilt", "0")


@pytest.fixture(scope="module")
def bean_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A scan of the bean with its truth beside it, and the run that `train` made of it."""
    folder = tmp_path_factory.mktemp("bean")
    grid = centred_grid((18.0, 18.0, 15.0), 0.8)
    true = truth(grid)
    np.save(folder / "truth.npy", true)
    scan = scan_of(cone(rows=18, columns=30, pixel=1.2), held_out=(0, 6, 12, 18, 24))
    described = described_truth(folder / "truth.npy", "zyx", true.shape, size=grid.size, attenuation_per_value=1.0)
    save_scan(folder / "bean", replace(scan, history={"truth": described}))
    trained = completed("ct", "train", folder / "bean", "--passes", "8", *FIXED)
    assert trained.stdout.strip() == str(folder / "bean-run")
    return folder / "bean-run"


def test_train_says_what_it_decided_and_keeps_a_run(bean_run: Path) -> None:
    result = load_reconstruction(bean_run)
    assert result.passes >= 8
    assert any("model error" in sentence for sentence in result.decisions)
    assert result.grid.size == pytest.approx(0.8)
    scan = bean_run.with_name("bean")
    again = ("ct", "train", scan, "--passes", "8", *FIXED)
    assert "is kept" in completed(*again).stderr
    assert "another reconstruction" in refusal("ct", "train", scan, "--passes", "9")[0]


def test_evaluate_compares_with_filtered_back_projection(bean_run: Path) -> None:
    result = completed("ct", "evaluate", bean_run, "--json", "--overwrite")
    methods = json.loads(result.stdout.splitlines()[-1])["methods"]
    assert set(methods) == {"nerfcli", "filtered back-projection"}
    own = methods["nerfcli"]
    assert own["volume"]["psnr"] > methods["filtered back-projection"]["volume"]["psnr"] + 3
    assert own["volume"]["ssim"] > 0.9
    assert 0.8 < own["projections"]["chi_square"] < 6
    assert len(own["projections"]["chi_square_of_view"]) == 5


def test_a_reconstruction_is_compared_with_a_reference_that_is_no_truth(bean_run: Path) -> None:
    result = completed("ct", "evaluate", bean_run, "--reference", bean_run, "--json", "--overwrite")
    assert f"the reference {bean_run} is a reconstruction, not the truth" in result.stderr
    metrics = json.loads(result.stdout.splitlines()[-1])
    assert metrics["reference"]["run"] == str(bean_run)
    assert metrics["methods"]["nerfcli"]["against_reference"]["psnr"] > 200  # itself
    other = metrics["methods"]["filtered back-projection"]
    assert 10 < other["against_reference"]["psnr"] < 60
    assert other["against_reference"]["psnr"] != other["volume"]["psnr"]
    completed("ct", "evaluate", bean_run, "--reference", bean_run)  # kept
    completed("ct", "evaluate", bean_run)
    refusal("ct", "evaluate", bean_run, "--reference", bean_run.parent / "other")
    completed("ct", "evaluate", bean_run, "--overwrite")
    error, _ = refusal("ct", "evaluate", bean_run, "--reference", bean_run)
    assert "was measured without the reference" in error


def test_render_writes_projections_residuals_and_slices(bean_run: Path, tmp_path: Path) -> None:
    views = completed("ct", "render", bean_run, "--outputs", "projection,residual", "-o", tmp_path / "pictures")
    assert len(views.stdout.splitlines()) == 10
    residual = tifffile.imread(tmp_path / "pictures" / "residual" / "0006.tif")
    assert residual.shape == (18, 30)
    assert 0.8 < float(np.sqrt(np.mean(residual**2))) < 2.5
    assert read_image(tmp_path / "pictures" / "projection" / "0000.png").shape == (18, 30, 3)
    slices = completed("ct", "render", bean_run, "--slices", "z=0.3", "-o", tmp_path / "slices")
    picture = tifffile.imread(tmp_path / "slices" / "z=0.3.tif")
    result = load_reconstruction(bean_run)
    np.testing.assert_array_equal(picture[::-1], slice_of(result, "z", 0.3))
    marked = tifffile.imread(tmp_path / "slices" / "z=0.3-marks.tif")
    np.testing.assert_array_equal(marked[::-1], result.marks[int(np.argmin(np.abs(result.grid.axis("z") - 0.3)))])
    assert slices.stdout.splitlines() == [str(tmp_path / "slices" / f"z=0.3{end}.tif") for end in ("", "-marks")]
    assert "outside the volume" in refusal("ct", "render", bean_run, "--slices", "z=400")[0]
    assert nerfcli("ct", "render", bean_run, "--slices", "w=1").exit_code == 2


def test_info_shows_a_reconstruction(bean_run: Path) -> None:
    facts, result = json.loads(completed("ct", "info", bean_run, "--json").stdout), load_reconstruction(bean_run)
    assert (facts["kind"], facts["unit"], facts["decisions"]) == ("reconstruction", "mm", list(result.decisions))
    assert facts["voxels"] == "x".join(str(count) for count in reversed(result.grid.shape))


def test_lists_of_runs_on_standard_input(bean_run: Path, tmp_path: Path) -> None:
    """Runs mixed with other paths: each run is processed, and a path that is no run is reported."""
    lines = f"{bean_run}\n{tmp_path}\n"
    for command, suffix in (("render", ".tif"), ("export", ".nrrd")):
        result = nerfcli("ct", command, "-", "-o", tmp_path / "out", stdin=lines)
        assert result.exit_code == 3, result.stderr
        assert f"Error: {tmp_path} is not a reconstruction" in result.stderr
        assert result.stdout.splitlines()
        assert all(line.endswith(suffix) and Path(line).is_file() for line in result.stdout.splitlines())


def test_sign_of_residuals(bean_run: Path) -> None:
    """More photons than predicted: the measured line integral is smaller, the residual negative; closed form."""
    zero = torch.zeros(1, 1)
    view = torch.tensor([0])
    counts = Poisson(torch.full((1, 1), 110.0), torch.full((1, 1), 100.0), zero)
    assert float(residual_of(counts, zero, view)) == pytest.approx(-1.0)
    integrals = Gaussian(torch.full((1, 1), 0.2), torch.full((1, 1), 100.0))
    assert float(residual_of(integrals, zero, view)) == pytest.approx(2.0)


def test_residuals_are_those_of_the_open_beam_of_each_view(tmp_path: Path) -> None:
    """Regression: views brighter by a tenth, as the fit knew, showed a residual of 15 deviations beside the object."""
    scan = scan_of(cone(rows=10, columns=48, pixel=1.2), held_out=(0, 7, 12, 19, 24))
    brighter = np.where(np.arange(30) % 2, 1.1, 1.0)[:, None, None]
    save_scan(tmp_path / "scan", replace(scan, values=(scan.values * brighter).astype(np.float32)))
    completed("ct", "train", tmp_path / "scan", "--passes", "4", *FIXED, "--air", "measured")
    for views in ("test", "train"):
        rendered = completed("ct", "render", tmp_path / "scan-run", "--cameras", views, "--outputs", "residual")
        beside = np.array([tifffile.imread(path)[:, :3] for path in rendered.stdout.splitlines()])
        assert np.abs(beside.mean(axis=(1, 2))).max() < 1.0


def test_a_scan_without_held_out_views_is_evaluated(tmp_path: Path) -> None:
    """Regression: a traceback where the open beam was corrected."""
    save_scan(tmp_path / "scan", scan_of(cone(9, rows=2, columns=8, pixel=4.0)))
    completed("ct", "train", tmp_path / "scan", "--passes", "1", *FIXED, "--air", "measured")
    assert load_reconstruction(tmp_path / "scan-run").used["air"] is not None
    evaluated = completed("ct", "evaluate", tmp_path / "scan-run", "--json")
    assert json.loads(evaluated.stdout.splitlines()[-1])["methods"]["nerfcli"]["projections"] is None


def test_resume_goes_on_from_the_volume_with_the_settings_that_are_not_given(bean_run: Path, tmp_path: Path) -> None:
    """Regression: it was refused unless all of them were given again."""
    run = tmp_path / "run"
    again = ("ct", "train", bean_run.with_name("bean"), "-o", run, "--passes")
    fixed = ("--voxel-size", "3", "--tv", "0.5", *FIXED)
    completed(*again, "1", *fixed)
    first = load_reconstruction(run)
    assert first.passes == 1
    assert any("model error" in sentence for sentence in first.decisions)
    completed(*again, "2", "--resume")
    result = load_reconstruction(run)
    assert (result.passes, result.settings.strength, result.settings.voxel_size) == (2, 0.5, 3.0)
    assert result.decisions == first.decisions
    before = (run / "reconstruction.json").read_bytes()
    for passes, others, code, words in (
        ("2", fixed, 0, "is kept: it is complete"),
        ("1", (), 0, "is kept: it has 2 passes in "),
        ("9", ("--tv", "2", "--centre", "1"), 3, "another reconstruction; it differs in --tv, --centre"),
    ):
        found = nerfcli(*again, passes, "--resume", *others)
        assert (found.exit_code, words in found.stderr) == (code, True), found.stderr
        assert (run / "reconstruction.json").read_bytes() == before


def test_an_interrupted_fit_is_not_complete_and_resume_goes_on_from_it(bean_run: Path, tmp_path: Path) -> None:
    """Regression: the same command kept it as complete, and SIGTERM ended with the code of Ctrl-C."""
    scan, run, notes = bean_run.with_name("bean"), tmp_path / "run", list[str]()
    settings = ReconstructionSettings(passes=3, strength=1.0, centre=0.0, tilt=0.0, air=False)

    def terminate_in_second_pass(fraction: float, words: str) -> None:
        if fraction > 0.5:
            raise Terminated

    with pytest.raises(Terminated):
        train_scan(scan, Output(run), settings, reporter=Reporter(note=notes.append, progress=terminate_in_second_pass))
    interrupted = load_reconstruction(run)
    assert (interrupted.passes, interrupted.complete) == (1, False)
    saved = f"the volume of pass {interrupted.passes} is saved in {run}"
    assert notes == [f"{saved}; to continue, add --resume to the same command"]

    command = ("ct", "train", scan, "--passes", "3", *FIXED, "--tv", "1", "--air", "stated", "-o", run)
    assert refusal(*command)[0] == f"Error: {run} holds a fit that was interrupted after pass {interrupted.passes}"
    assert completed(*command, "--resume").stdout == f"{run}\n"
    result = load_reconstruction(run)
    assert (result.passes, result.complete) == (3, True)
    assert result.seconds > interrupted.seconds
    assert "is kept: it is complete" in completed(*command).stderr


def test_an_interrupt_between_fit_and_save_waits(
    bean_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(geometry: ScanGeometry, grid: VoxelGrid) -> np.ndarray:
        signal.raise_signal(signal.SIGINT)
        return marks(geometry, grid)

    monkeypatch.setattr("nerfcli.ct.train.marks", interrupted)
    settings = ReconstructionSettings(passes=1, voxel_size=3.0, centre=0.0, tilt=0.0, air=False)
    with pytest.raises(KeyboardInterrupt):
        train_scan(bean_run.with_name("bean"), Output(tmp_path / "run"), settings)
    assert load_reconstruction(tmp_path / "run").complete


def test_a_damaged_run_is_trained_again_as_the_hint_says(bean_run: Path, tmp_path: Path) -> None:
    run = shutil.copytree(bean_run, tmp_path / "run")
    (run / "marks.npy").unlink()
    again = ("ct", "train", bean_run.with_name("bean"), "-o", run, "--passes", "1", "--voxel-size", "3", *FIXED)
    error, hint = refusal(*again)
    assert error.startswith(f"Error: {run} cannot be read as a reconstruction")
    assert hint.startswith("Hint:  train the scan again with --overwrite")
    completed(*again, "--overwrite")


def test_a_save_that_fails_leaves_the_earlier_run(bean_run: Path, tmp_path: Path) -> None:
    run = shutil.copytree(bean_run, tmp_path / "run")
    result = load_reconstruction(run)
    with pytest.raises(ValueError, match="Object arrays"):
        save_reconstruction(run, replace(result, volume=2 * result.volume, marks=np.array([object()])))
    np.testing.assert_array_equal(load_reconstruction(run).volume, load_reconstruction(bean_run).volume)


def test_centre_is_where_doctor_says(tmp_path: Path) -> None:
    """Known truth: the axis is 2.5 columns before the stated one; what is read off the sentence leads to it."""
    circle = phantom_circle(views=48, columns=48)
    scan = scan_of_phantom(replace(circle, column_shift=2.5), stated=circle, photons=3e4)
    save_scan(tmp_path / "scan", scan)
    train = ("ct", "train", tmp_path / "scan", "--passes", "1", "--tilt", "0", "-o")
    estimated = completed(*train, tmp_path / "estimated")
    found = re.search(r"axis at column (\S+) ± \S+; the scan states (\S+)", estimated.stderr)
    assert found is not None
    column, stated = float(found[1]), float(found[2])
    assert (column, stated) == (pytest.approx(21.0, abs=0.1), 23.5)
    completed(*train, tmp_path / "set", "--centre", f"{column - stated:.2f}")
    for run in ("estimated", "set"):
        used = load_reconstruction(tmp_path / run).used
        assert axis_column(scan.geometry.corrected(used["centre"], 0.0)) == pytest.approx(column, abs=0.006)


def test_scores_that_do_not_exist_are_none() -> None:
    """JSON has no NaN: a held-out view without usable pixels, none with any, and volumes too small for SSIM."""
    scan = scan_of(cone(rows=4, columns=8, pixel=4.0), held_out=(0, 6))
    grid = centred_grid((18.0, 18.0, 15.0), 3.0)
    usable = np.ones(scan.values.shape, bool)
    usable[6] = False
    found = score_projections(replace(scan, usable=usable), scan.geometry, torch.zeros(grid.shape), grid)
    assert found is not None
    assert found.chi_square_of_view == (pytest.approx(found.chi_square), None)
    usable[0] = False
    assert score_projections(replace(scan, usable=usable), scan.geometry, torch.zeros(grid.shape), grid) is None
    small = np.ones(grid.shape)
    assert score_volume(small, grid, small, grid).ssim is None


@pytest.mark.parametrize(
    ("first", "more"),
    [
        (("--outputs", "projection"), ("--outputs", "residual,projection")),
        (("--slices", "z=0"), ("--slices", "x=0", "--slices", "z=0")),
    ],
)
def test_pictures_that_are_there_are_kept_and_nothing_is_added(
    bean_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, first: tuple[str, ...], more: tuple[str, ...]
) -> None:
    with monkeypatch.context() as patched:  # residuals alone need the noise of all views, several times their memory
        patched.setattr("nerfcli.ct.render.likelihood_of", lambda *given, **more: pytest.fail("it was judged"))
        completed("ct", "render", bean_run, "-o", tmp_path, *first)
        before = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")}
        error, hint = refusal("ct", "render", bean_run, "-o", tmp_path, *more)
    assert re.fullmatch(r"Error: \S+ exists", error)
    assert hint.startswith("Hint:  add --overwrite to replace it")
    assert {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")} == before
    completed("ct", "render", bean_run, "-o", tmp_path, *more, "--overwrite")


def values_of(path: Path) -> np.ndarray:
    """Return the values (Z, Y, X) in an NRRD."""
    head, _, body = path.read_bytes().partition(b"\n\n")
    fields = dict(line.split(": ", 1) for line in head.decode().splitlines() if ": " in line)
    kind = {"float": "<f4", "uchar": "u1"}[fields["type"]]
    return np.frombuffer(gzip.decompress(body), kind).reshape([int(n) for n in fields["sizes"].split()][::-1])


def test_an_exported_volume_is_nan_where_no_view_sees_and_its_marks_are_beside_it(
    bean_run: Path, tmp_path: Path
) -> None:
    """Hounsfield units, closed form: 0 for water, -1000 for nothing."""
    result, output = load_reconstruction(bean_run), Output(tmp_path / "bean.nrrd")
    volume, marked = export_scan(bean_run, output)
    unseen = (np.asarray(result.marks) & UNSEEN) > 0
    np.testing.assert_array_equal(values_of(volume), np.where(unseen, np.nan, result.volume))
    np.testing.assert_array_equal(values_of(marked), result.marks)
    with pytest.raises(UserError, match=r" exists$"):
        export_scan(bean_run, output)
    export_scan(bean_run, Output(tmp_path / "hu.nrrd"), water=0.12)
    units = values_of(tmp_path / "hu.nrrd")[~unseen]
    np.testing.assert_allclose(units, 1000 * (result.volume[~unseen] / 0.12 - 1), rtol=1e-4, atol=0.02)
    assert b'"quantity": "HU"' in (tmp_path / "hu.nrrd").read_bytes()


@pytest.mark.parametrize("kind", [np.float32, np.uint8])
def test_files_of_volumes_state_their_place_and_unit(kind: type, tmp_path: Path) -> None:
    """As the definitions of the formats have it: x fastest, sizes x, y, z, and the centre of the first voxel."""
    values = np.arange(60, dtype=kind).reshape(3, 4, 5)
    volume = VolumeFile(values, VoxelGrid((3, 4, 5), (1.0, 2.0, 3.0), 0.5), "mm", "1/mm")
    paths = {suffix: tmp_path / f"a.{suffix}" for suffix in ("nrrd", "mha", "nii", "tif")}
    for path in paths.values():
        write_volume(path, volume)
    np.testing.assert_array_equal(values_of(paths["nrrd"]), values)
    head = paths["nrrd"].read_text("latin-1")
    assert "space directions: (0.5,0,0) (0,0.5,0) (0,0,0.5)\nspace origin: (1,2,3)\n" in head
    assert 'space units: "mm" "mm" "mm"' in head
    head, _, body = paths["mha"].read_bytes().partition(b"ElementDataFile = LOCAL\n")
    assert body == values.tobytes()
    fields = dict(line.split(" = ") for line in head.decode().splitlines())
    assert (fields["DimSize"], fields["Offset"], fields["ElementSpacing"]) == ("5 4 3", "1.0 2.0 3.0", "0.5 0.5 0.5")
    assert fields["ElementType"] == ("MET_FLOAT" if kind is np.float32 else "MET_UCHAR")
    content = paths["nii"].read_bytes()
    assert struct.unpack_from("<i", content)[0] == 348
    assert struct.unpack_from("<4h", content, 40) == (3, 5, 4, 3)
    assert struct.unpack_from("<2h", content, 70) == ((16, 32) if kind is np.float32 else (2, 8))
    assert struct.unpack_from("<4f", content, 76) == (1, 0.5, 0.5, 0.5)
    assert struct.unpack_from("<12f", content, 280) == (0.5, 0, 0, 1, 0, 0.5, 0, 2, 0, 0, 0.5, 3)
    assert (content[123], content[344:348]) == (2, b"n+1\0")
    assert content[352:] == values.tobytes()
    with tifffile.TiffFile(paths["tif"]) as tiff:
        np.testing.assert_array_equal(tiff.asarray(), values)
        assert tiff.imagej_metadata is not None
        assert (tiff.imagej_metadata["spacing"], tiff.imagej_metadata["unit"]) == (0.5, "mm")
        assert tiff.pages[0].tags["XResolution"].value == (2, 1)  # type: ignore[union-attr]


def test_the_format_and_the_attenuation_of_water_are_used_and_checked(bean_run: Path, tmp_path: Path) -> None:
    run = tmp_path / "bean-run"
    shutil.copytree(bean_run, run)
    exported = completed("ct", "export", run, "--format", "mha")
    assert Path(exported.stdout.split()[0]) == tmp_path / "bean-run-volume.mha"
    for options in (
        ("--format", "obj"),
        ("--format", "mha", "-o", tmp_path / "a.nii"),
        ("--water", "0"),
        ("--water", "nan"),
    ):
        assert nerfcli("ct", "export", run, "--overwrite", *options).exit_code == 2


def test_export_from_inside_a_run_replaces_the_volume_and_its_marks(
    bean_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = shutil.copytree(bean_run, tmp_path / "bean-run")
    monkeypatch.chdir(run)
    result = load_reconstruction(run)
    paths = [str(tmp_path / f"bean-run-volume{end}.nrrd") for end in ("", "-marks")]
    for value, written in ((4, paths), (0, paths[:1])):
        save_reconstruction(run, replace(result, marks=np.full_like(result.marks, value)))
        assert completed("ct", "export", ".", "--overwrite").stdout.splitlines() == written
        assert sorted(map(str, tmp_path.glob("*.nrrd"))) == sorted(written)


def test_other_suffixes_are_refused(bean_run: Path, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="unknown volume format"):
        export_scan(bean_run, Output(tmp_path / "a.vol"))


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("--tv", "-1"), "invalid weight"),
        (("--voxel-size", "0"), "invalid voxel size 0"),
        (("--voxel-size", "0.001"), "need .* GB of memory"),
        (("--voxel-size", "inf"), "invalid voxel size inf"),
        (("--centre", "inf"), "--centre is not a finite number"),
        (("--tilt", "inf"), "--tilt is not a finite number"),
        (("--centre", "1e9"), "--centre 1e\\+09 is outside the 30 columns"),
    ],
)
def test_train_refuses_in_two_lines(bean_run: Path, tmp_path: Path, arguments: tuple[str, ...], said: str) -> None:
    train = ("ct", "train", bean_run.with_name("bean"), "--passes", "1", "-o", tmp_path / "run", *arguments)
    error, _ = refusal(*train, exit_code=OUT_OF_MEMORY if "memory" in said else BAD_INPUT)
    assert re.search(said, error)


def test_more_voxels_than_64_bits_can_count() -> None:
    """Regression: their number was negative, so that any memory was enough."""
    assert VoxelGrid((2**21, 2**21, 2**21), (0.0, 0.0, 0.0), 1.0).voxels == 2**63


def test_metrics_that_cannot_be_written_are_refused_before_they_are_measured(
    bean_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = shutil.copytree(bean_run, tmp_path / "run")
    (run / "metrics.json").unlink(missing_ok=True)
    monkeypatch.setattr("nerfcli.atomic.os.access", lambda path, mode: False)
    monkeypatch.setattr("nerfcli.ct.evaluate.scan_of", lambda result, run: pytest.fail("it was read"))
    assert refusal("ct", "evaluate", run)[0] == f"Error: cannot write {run / 'metrics.json'}: no write permission"


def test_few_views_and_columns_are_refused_or_checked(tmp_path: Path) -> None:
    """Regression: tracebacks, of a scan whose views are nearly all held out, and of one cropped to a few columns."""
    scan = scan_of(cone(9, rows=2, columns=4), held_out=tuple(range(7)))
    save_scan(tmp_path / "scan", scan)
    error, hint = refusal("ct", "train", tmp_path / "scan", "--passes", "1")
    assert error == f"Error: {tmp_path / 'scan'} has 2 views with usable pixels that are not held out, expected 3"
    assert "with fewer views held out" in hint
    save_scan(tmp_path / "few", scan_of(cone(2, rows=2, columns=4)))
    usable = np.ones((9, 1, 1), bool)
    usable[2:] = False
    save_scan(tmp_path / "empty", replace(scan_of(cone(9, rows=2, columns=4)), usable=usable))
    for name in ("few", "empty"):
        _, hint = refusal("ct", "train", tmp_path / name, "--passes", "1")
        assert hint.startswith("Hint:  a reconstruction needs more views of the object")
    assert not (tmp_path / "scan-run").exists()
    assert completed("ct", "doctor", tmp_path / "scan").stdout == f"{tmp_path / 'scan-doctor.html'}\n"


def test_a_changed_scan_is_not_evaluated_as_the_old_one(bean_run: Path, tmp_path: Path) -> None:
    shutil.copytree(bean_run.parent, tmp_path / "copy")
    run = tmp_path / "copy" / "bean-run"
    result = load_reconstruction(run)
    with pytest.raises(UserError, match="has changed"):
        scan_behind(replace(result, scan_digest="0"), run)
    with pytest.raises(UserError, match="does not exist"):
        scan_behind(replace(result, scan=tmp_path / "nowhere"), run)
