"""Members of a run: what varies, resuming, deviations in closed form, and the mean of their pictures."""

import json

import numpy as np
import pytest
import torch
from commands import error_of, listing, nerfcli
from conftest import write_run
from fog import fog, foggy_cells

from nerfcli import scene as scenes
from nerfcli.errors import BAD_INPUT, OUT_OF_MEMORY
from nerfcli.export.one_frame import deviation
from nerfcli.field.hash_field import RANDOM_LEVELS, HashField, HashFieldSettings
from nerfcli.fit.extent import object_frame
from nerfcli.fit.fitting import Fitting
from nerfcli.media.exr import read_exr
from nerfcli.media.file_facts import depth_meta_of
from nerfcli.media.float_tiff import read_tiff
from nerfcli.media.images import read_image
from nerfcli.runs.members import members_of
from nerfcli.runs.run import Run
from nerfcli.runs.settings import TrainSettings
from nerfcli.workflows.members import PHOTO_FRACTION, VARIED, member_settings

USAGE = 2  # Click's exit code for wrong options
QUICK = ("--steps", "1", "--downscale", "8", "--log2-rows", "10", "--threads", "1", "--model", "default")


@pytest.fixture
def ensemble(capture):
    """A run of `capture` with three members: fogs that begin at different distances, over different backgrounds."""
    loaded = scenes.load(capture)
    similarity, _ = object_frame(loaded)
    run = capture.with_name("spheres-run")
    for number, half_size in enumerate((0.5, 0.25, 0.375, 0.625)):
        cells = foggy_cells((-half_size, -half_size, -half_size), (half_size, half_size, half_size))
        level = 1.0 - 0.25 * number
        path = run if number == 0 else run / "members" / str(number)
        path.parent.mkdir(exist_ok=True)
        write_run(path, loaded, fog(cells, similarity, background=(level, level, level), step=1 / 32), factor=8)
    return run


@pytest.mark.parametrize("vary", VARIED)
def test_members_differ_in_what_varies_and_in_their_seeds(vary):
    first = TrainSettings(budget_seconds=None, steps=7, seed=3)
    members = member_settings(first, 4, vary=vary)
    assert [member.seed for member in members] == [4, 5, 6, 7]
    changes = [
        {name: value for name, value in member.to_json().items() if value != first.to_json()[name] and name != "seed"}
        for member in members
    ]
    assert (
        changes
        == {
            "seeds": [{}] * 4,
            "photos": [{"photo_fraction": PHOTO_FRACTION}] * 4,
            "prior": [{"random_start": 0.1}] * 4,
            "field": [{}, {"field": "voxels"}, {"field": "mlp"}, {}],
        }[vary]
    )


def test_photos_are_drawn_without_replacement_by_the_seed(spheres):
    def used(seed: int) -> list[str]:
        return [frame.name for frame in scenes.with_fraction_of_photos(spheres, 0.8, seed=seed).train_frames]

    names, drawn = [frame.name for frame in spheres.train_frames], [used(seed) for seed in range(40)]
    for one in drawn:
        assert len(one) == len(set(one)) == round(0.8 * 21)
        assert one == [name for name in names if name in one]
    assert drawn[0] == used(0)
    assert scenes.with_fraction_of_photos(spheres, 0.8, seed=0).test_names == spheres.test_names
    # Over 40 draws a photo is used 32 times, with a standard deviation of 2.5.
    uses = [sum(name in one for one in drawn) for name in names]
    assert min(uses) >= 22
    assert max(uses) < 40
    assert scenes.with_fraction_of_photos(spheres, 1.0, seed=0) is spheres
    assert len(scenes.with_fraction_of_photos(spheres, 1e-9, seed=0).train_frames) == 1


def test_a_random_start_fills_the_coarsest_levels_with_numbers_of_its_size():
    torch.manual_seed(0)
    field = HashField(HashFieldSettings(contraction="none", log2_rows=14))
    before = field.table.detach().clone()
    field.start_randomly(0.1)
    after = field.table.detach()
    assert after[:RANDOM_LEVELS].std().item() == pytest.approx(0.1, rel=0.02)
    assert after[:RANDOM_LEVELS].mean().item() == pytest.approx(0.0, abs=0.002)
    assert torch.equal(after[RANDOM_LEVELS:], before[RANDOM_LEVELS:])


def test_training_leaves_random_numbers_where_no_ray_passes(spheres, tmp_path):
    """Rows of the coarsest level that no sample touches still have the values from the seed after training."""
    from nerfcli.train.loop import train

    settings = TrainSettings(budget_seconds=None, steps=3, downscale=8, random_start=0.1, log2_rows=14, seed=5)
    train(spheres, tmp_path, settings, resume=False, notify=lambda text: None, on_progress=lambda progress: None)
    table = Run(tmp_path).model().field.rows()
    torch.manual_seed(5)
    fresh = HashField(HashFieldSettings(contraction="none", log2_rows=14))
    fresh.start_randomly(0.1)
    assert isinstance(table, torch.Tensor)
    same = (table == fresh.table).all(dim=-1)[0]
    assert 0.1 < same.float().mean() < 0.999
    assert not same[: 17**3].all()


def test_members_are_trained_into_the_run_and_kept(capture):
    run = capture.with_name("r")
    command = ("train", capture, *QUICK, "-o", run, "--members", "2", "--vary", "photos")
    result = nerfcli(*command)
    assert result.exit_code == 0, result.stderr
    assert "2 members, varied by photos, 1 steps each" in result.stderr
    assert result.stdout.splitlines() == [str(run)]
    opened = [Run(run), *members_of(Run(run))]
    assert [one.path for one in opened[1:]] == [run / "members" / "1", run / "members" / "2"]
    assert [len(one.cameras.train) for one in opened] == [4, 3, 3]
    assert len({one.checkpoint_sha256() for one in opened}) == 3
    before = listing(run)
    assert nerfcli(*command).stderr.count("is kept") == 3
    assert listing(run) == before
    described = json.loads(nerfcli("info", run, "--json").stdout)["members"]
    assert described == [f"{number}: seed {number}, photo_fraction 0.8, complete" for number in (1, 2)]
    # One member is lost; training it again touches no other.
    (run / "members" / "2" / "field.safetensors").unlink()
    (run / "members" / "2" / "state.safetensors").unlink()
    assert nerfcli(*command).exit_code == 0
    after = listing(run)
    assert {name for name in after if after[name] != before[name]} <= {
        "members/2/log.jsonl",
        "members/2/config.json",
    } | {name for name in after if name.startswith(("members/2/state", "members/2/waypoints"))}
    # More steps continue the run and its members.
    assert nerfcli(*command, "--resume", "--steps", "2").exit_code == 0
    assert [one.log[-1]["step"] for one in [Run(run), *members_of(Run(run))]] == [2, 2, 2]
    for arguments in (("info", run / "members" / "1"), ("evaluate", run / "members" / "1", "--threads", "1")):
        assert nerfcli(*arguments).exit_code == 0
    # Another kind of member replaces them only with --overwrite.
    result = nerfcli(*command[:-1], "seeds", "--steps", "2")
    assert result.exit_code == BAD_INPUT
    assert error_of(result)[0].endswith("members/1 exists")


def test_tasks_of_an_array_job_train_one_member_each(capture):
    """Trained out of order, they have the same fields as from one command; the run itself is never touched."""
    together, apart = capture.with_name("together"), capture.with_name("apart")
    assert nerfcli("train", capture, *QUICK, "-o", together, "--members", "3").exit_code == 0
    task = ("train", capture, *QUICK, "-o", apart, "--members")
    result = nerfcli(*task, "2/3")
    assert result.exit_code == BAD_INPUT
    assert "is not complete, and --members 2/3 trains one of its members" in error_of(result)[0]
    missing = nerfcli("train", capture / "nowhere", *QUICK, "-o", apart, "--members", "2/3")
    assert "is not complete" not in error_of(missing)[0]
    assert nerfcli("train", capture, *QUICK, "-o", apart).exit_code == 0
    before = listing(apart)
    for number in (3, 1, 2):
        result = nerfcli(*task, f"{number}/3", "--overwrite")
        assert result.exit_code == 0, result.stderr
        assert (apart / "members" / str(number) / "field.safetensors").exists()
    assert {name: entry for name, entry in listing(apart).items() if not name.startswith("members")} == before
    digests = [[member.checkpoint_sha256() for member in members_of(Run(run))] for run in (together, apart)]
    assert digests[0] == digests[1]
    assert nerfcli(*task, "4/3").exit_code == USAGE


@pytest.fixture
def interrupted_at_step_4(monkeypatch):
    """Run a command in which Ctrl-C comes at step 4 of the training with a seed."""

    def run(seed, *command):
        advance = Fitting.advance

        def interrupted(fitting, *arguments, **options):
            if fitting.settings.seed == seed and fitting.step == 4:
                raise KeyboardInterrupt
            return advance(fitting, *arguments, **options)

        with monkeypatch.context() as patched:
            patched.setattr(Fitting, "advance", interrupted)
            result = nerfcli(*command)
        assert result.exit_code == 130
        assert "the same command continues" in result.stderr
        assert "--resume" not in result.stderr

    return run


def test_an_interrupted_member_is_resumed_by_the_same_command(capture, interrupted_at_step_4):
    run = capture.with_name("r")
    command = ("train", capture, *QUICK, "--steps", "8", "-o", run, "--members", "2")
    interrupted_at_step_4(2, *command)
    assert error_of(nerfcli("evaluate", run, "--members"))[0].endswith("members/2 was interrupted")
    first = (run / "members" / "1" / "field.safetensors").read_bytes()
    again = nerfcli(*command)
    assert again.exit_code == 0
    assert "resumed at step 4" in again.stderr
    assert (run / "members" / "1" / "field.safetensors").read_bytes() == first
    members = members_of(Run(run))
    assert [member.log[-1]["step"] for member in members] == [8, 8]


def test_a_run_that_was_interrupted_before_its_members_is_resumed_by_the_same_command(capture, interrupted_at_step_4):
    run = capture.with_name("r")
    command = ("train", capture, *QUICK, "--steps", "8", "-o", run, "--members", "2")
    interrupted_at_step_4(0, *command)
    again = nerfcli(*command)
    assert again.exit_code == 0, again.stderr
    assert "resumed at step 4" in again.stderr
    assert [one.log[-1]["step"] for one in [Run(run), *members_of(Run(run))]] == [8, 8, 8]


def test_members_keep_to_the_memory_of_the_run(capture):
    """The run is complete beforehand, so only a member can be refused."""
    run = capture.with_name("r")
    assert nerfcli("train", capture, *QUICK, "-o", run).exit_code == 0
    result = nerfcli("train", capture, *QUICK, "-o", run, "--members", "2", "--memory", "1MB")
    assert result.exit_code == OUT_OF_MEMORY
    assert not (run / "members" / "1" / "field.safetensors").exists()


def test_members_of_another_training_are_refused(ensemble):
    write = ensemble / "config.json"
    config = json.loads(write.read_text())
    config.pop("sha256", None)
    config["settings"]["steps"] = 8
    write.write_text(json.dumps(config))
    result = nerfcli("render", ensemble, "--outputs", "depth_deviation")
    assert result.exit_code == BAD_INPUT
    assert "belongs to another training" in error_of(result)[0]
    assert "steps 7, not 8" in error_of(result)[0]


def test_a_run_without_members_says_how_to_train_them(finished):
    for command in (("render", finished, "--outputs", "colour_deviation"), ("evaluate", finished, "--members")):
        result = nerfcli(*command)
        assert result.exit_code == BAD_INPUT
        message, hint = error_of(result)
        assert "has 0 members; 2 are needed at least" in message
        assert "--members 4" in hint


@pytest.mark.parametrize(
    "arguments",
    [
        ("--members", "2", "--dry-run"),
        ("--members", "2", "--view"),
        ("--members", "1"),
        ("--vary", "moon"),
        ("--members", "2", "--vary", "prior", "--field", "voxels"),
        ("--members", "2", "--vary", "field", "--with", "antialias"),
    ],
)
def test_wrong_options_of_members_are_refused_before_anything_is_trained(capture, arguments):
    assert nerfcli("train", capture, *QUICK, *arguments).exit_code == 2
    assert not capture.with_name("spheres-run").exists()


def test_the_deviation_is_that_of_the_members_that_have_a_value():
    """Against NumPy pixel by pixel, across magnitudes; NaN below two values; 0 for equal ones."""
    rng = np.random.default_rng(0)
    values = (rng.normal(size=(5, 6, 7)) * 10.0 ** rng.integers(-10, 10, (6, 7))).astype(np.float32)
    values[rng.random(values.shape) < 0.4] = np.nan
    found = deviation(values)
    for y in range(6):
        for x in range(7):
            there = values[:, y, x][np.isfinite(values[:, y, x])].astype(np.float64)
            expected = there.std(ddof=1) if len(there) > 1 else np.nan
            np.testing.assert_allclose(found[y, x], expected, rtol=1e-6)
    far = np.full((3, 2, 2), 1e6, np.float32)
    np.testing.assert_array_equal(deviation(far), 0.0)
    assert deviation(far + np.array([0, 1, 2], np.float32)[:, None, None])[0, 0] == pytest.approx(1.0)


def test_deviations_of_fog_are_those_of_its_closed_form(ensemble, tmp_path):
    """For cubes of fog, against NumPy's deviation of the pictures of the members, each rendered by itself."""
    common = (
        "--min-opacity",
        "0",
        "--depth",
        "moment",
        "--threads",
        "1",
        "--samples-per-pixel",
        "1",
        "--tolerance",
        "1e-6",
    )
    outputs = ("--outputs", "rgb,depth,depth_deviation,colour_deviation", "--depth-format", "tiff,exr")
    result = nerfcli("render", ensemble, *common, *outputs, "-o", tmp_path / "all")
    assert result.exit_code == 0, result.stderr
    depths, colours = [], []
    for number in (1, 2, 3):
        folder = tmp_path / str(number)
        of_one = nerfcli("render", ensemble / "members" / str(number), *common, "--outputs", "rgb,depth", "-o", folder)
        assert of_one.exit_code == 0, of_one.stderr
        depths.append(read_tiff(next((folder / "depth").rglob("*.tiff")))[0].astype(np.float64))
        colours.append(read_image(next((folder / "rgb").rglob("*.png"))) / 255.0)
    of_depth, of_colour = (
        next((tmp_path / "all" / name).rglob("*.tiff")) for name in ("depth_deviation", "colour_deviation")
    )
    np.testing.assert_allclose(read_tiff(of_depth)[0], np.std(depths, axis=0, ddof=1), rtol=1e-4, atol=1e-6)
    expected = np.sqrt(np.var(colours, axis=0, ddof=1).mean(axis=-1))
    np.testing.assert_allclose(read_tiff(of_colour)[0], expected, atol=1.5 / 255)
    # Outside of all cubes only the three backgrounds are visible: 3/4, 1/2, 1/4.
    assert read_tiff(of_colour)[0].max() == pytest.approx(0.25, abs=0.05)
    assert "metric scale" not in nerfcli("info", of_colour).stdout  # it is no length
    channels = read_exr(next((tmp_path / "all" / "exr").rglob("*.exr")))
    np.testing.assert_array_equal(channels["depth_deviation.V"], read_tiff(of_depth)[0])
    np.testing.assert_array_equal(channels["colour_deviation.V"], read_tiff(of_colour)[0])
    depth_meta, colour_meta = depth_meta_of(of_depth), depth_meta_of(of_colour)
    assert depth_meta is not None
    assert colour_meta is not None
    assert (depth_meta.quantity, depth_meta.unit) == ("depth_deviation", "arbitrary")
    assert (colour_meta.quantity, colour_meta.unit) == ("colour_deviation", "sRGB from 0 to 1")
    assert len(depth_meta.provenance["members_sha256"]) == 3
    assert "standard deviation of depth between members" in depth_meta.in_words()
    assert "units" in nerfcli("info", of_depth).stdout


def test_the_mean_of_the_pictures_of_members_is_measured_beside_theirs(ensemble, tmp_path):
    """PSNR and SSIM of members against `evaluate` on each; the mean picture is better than the members on average."""
    result = nerfcli("evaluate", ensemble, "--members", "--threads", "1", "--json")
    assert result.exit_code == 0, result.stderr
    found = json.loads(result.stdout.splitlines()[-1])["members"]
    assert json.loads((ensemble / "members" / "metrics.json").read_text())["mean_picture"] == found["mean_picture"]
    for number in (1, 2, 3):
        alone = nerfcli("evaluate", ensemble / "members" / str(number), "--threads", "1", "--json")
        assert json.loads(alone.stdout)["mean"]["psnr"] == pytest.approx(found["members"][number - 1]["psnr"])
        assert json.loads(alone.stdout)["mean"]["ssim"] == pytest.approx(found["members"][number - 1]["ssim"])
    # The error of the mean picture is below the average error of the members, as the squared error is convex.
    errors = [10 ** (-0.1 * member["psnr_float"]) for member in found["members"]]
    assert 10 ** (-0.1 * found["mean_picture"]["psnr_float"]) < np.mean(errors)
    assert "is kept" in nerfcli("evaluate", ensemble, "--members", "--threads", "1").stderr
    assert nerfcli("evaluate", ensemble, ensemble, "--members").exit_code == 2
