"""Blocks: cells that cover the ground once, rays through several fields, and runs that are trained block by block."""

import json
import re
import shlex
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from captures import CAMERAS, ring
from commands import error_of, listing, nerfcli
from PIL import Image

from nerfcli import scene as scenes
from nerfcli.cameras.formats.colmap import write_colmap_binary
from nerfcli.cameras.rigid import Similarity
from nerfcli.errors import BAD_INPUT
from nerfcli.field.blocks_field import BlocksField
from nerfcli.field.hash_field import HashField, HashFieldSettings
from nerfcli.field.kinds import settings_from_json
from nerfcli.field.voxel_field import VoxelField, VoxelFieldSettings
from nerfcli.fit import open_cells
from nerfcli.fit.fitting import Fitting
from nerfcli.kernels import March, Rays
from nerfcli.render.depth import CONVENTIONS, DepthRequest
from nerfcli.render.model import Marching, Model, load_model, save_model
from nerfcli.render.pictures import Quality, render_picture
from nerfcli.render.tracing import deepest, render_rays, uniform_cuts
from nerfcli.runs.blocks import LEAST_FRACTION, MARGIN, PERCENTILES, BlockDivision, Cell, divide, joined
from nerfcli.runs.run import Run
from nerfcli.train import preparation

EXAMPLES = Path(__file__).parent.parent / "examples"
QUICK = ("--steps", "1", "--log2-rows", "8", "--threads", "1", "--model", "default")
GROUND = np.array([[0.6, 0.8, 0.0], [-0.8, 0.6, 0.0]])
CELLS = (
    Cell(high=(0.1, 0.2)),
    Cell(low=(-np.inf, 0.2), high=(0.1, np.inf)),
    Cell(low=(0.1, -np.inf), high=(np.inf, -0.3)),
    Cell(low=(0.1, -0.3)),
)


def cloudy(similarity: Similarity, *, kind: str = "hash", seed: int = 0) -> Model:
    """A field of random density and colours, with a third of its cells empty."""
    torch.manual_seed(seed)
    if kind == "hash":
        field = HashField(HashFieldSettings(contraction="l2", log2_rows=10, finest=64))
    else:
        field = VoxelField(VoxelFieldSettings(contraction="l2", log2_vertices=12))
    with torch.no_grad():
        field.table.normal_(std=1.0)
    return Model(
        field=field,
        occupied=torch.rand(16, 16, 16) < 0.67,
        marching=Marching(near=0.03, far=2.5, shortest_step=1 / 50, growth=1 / 50),
        background=(0.1, 0.2, 0.3),
        training_from_scene=similarity,
        unit="arbitrary",
    )


def division(cells: tuple[Cell, ...] = CELLS) -> BlockDivision:
    return BlockDivision(GROUND, cells, ())


def random_rays(count: int, dtype: torch.dtype) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(1)
    origins = torch.randn(count, 3, generator=generator, dtype=torch.float64)
    directions = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator, dtype=torch.float64), dim=1)
    return origins.to(dtype), directions.to(dtype)


@pytest.mark.parametrize("kind", ["hash", "voxels"])
def test_blocks_of_one_field_render_what_it_renders_in_float64(kind):
    """Colour, opacity and everything behind depths agree to rounding: cutting rays at borders changes nothing."""
    alone = cloudy(Similarity(0.5, np.eye(3), np.array([0.3, -0.2, 0.1])), kind=kind)
    alone = replace(alone, field=alone.field.double())
    together = joined([alone] * 4, division())
    assert together.training_from_scene.scale == pytest.approx(0.5, rel=1e-14)
    origins, directions = random_rays(15, torch.float64)
    background = torch.tensor(alone.background, dtype=torch.float64)
    expected, seen = (
        render_rays(model, origins, directions, background=background, fractions=(0.05, 0.5, 0.9), tolerance=1e-13)
        for model in (alone, together)
    )
    assert 0.5 < expected.ends.opacity.median() < 0.999
    torch.testing.assert_close(seen.rgb, expected.rgb, rtol=0, atol=1e-9)
    for name, values in expected.ends._asdict().items():
        torch.testing.assert_close(getattr(seen.ends, name), values, rtol=1e-9, atol=1e-9, equal_nan=True, msg=name)


@pytest.mark.parametrize("convention", [*CONVENTIONS, "quantile:0.1"])
@pytest.mark.parametrize("axis", ["ray", "z"])
def test_pictures_of_blocks_of_one_field_are_those_of_the_field(spheres, convention, axis):
    """To float32 rounding, with hardly anything left out: the spans of compiled marching join into the whole ray."""
    frame = spheres.test_frames[0]
    frame = replace(frame, camera=frame.camera.resized(8, 6))
    alone = cloudy(Similarity(0.4, np.eye(3), np.zeros(3)))
    depth = DepthRequest(convention, axis, background_distance=9.0)
    expected, seen = (
        render_picture(model, frame, background=model.background, depth=depth, quality=Quality(tolerance=1e-9))
        for model in (alone, joined([alone] * 4, division()))
    )
    for name in ("rgb", "opacity", "depth", "spread", "median"):
        np.testing.assert_allclose(getattr(seen, name), getattr(expected, name), rtol=1e-6, atol=1e-6, err_msg=name)


def test_blocks_of_other_fields_render_what_the_joined_field_gives_sample_by_sample():
    """Each sample is evaluated by the block whose cell contains it, however a ray is split into spans."""
    models = [cloudy(Similarity(1.0 + n / 4, np.eye(3), np.full(3, n / 9)), seed=n) for n in range(4)]
    models = [replace(model, field=model.field.double()) for model in models]
    together = joined(models, division())
    origins, directions = random_rays(15, torch.float64)
    rays = Rays(origins, directions, torch.zeros_like(origins[:, 0]))
    cuts = uniform_cuts(together.marching)
    march = March(torch.cat([cuts, cuts[-1:]]), together.occupied, "l2", deepest(1e-13))
    background = torch.tensor(models[0].background, dtype=torch.float64)
    expected = together.field.backend.trace_rays(rays, march, together.field.medium(), background=background)
    seen = render_rays(together, origins, directions, background=background, tolerance=1e-13)
    torch.testing.assert_close(seen.rgb, expected.rgb, rtol=0, atol=1e-9)
    torch.testing.assert_close(seen.ends.mean, expected.ends.mean, rtol=1e-9, atol=0, equal_nan=True)


@pytest.mark.parametrize("contrast", [1.0, 4.0])
def test_what_spans_leave_out_of_a_colour_is_within_its_bound(contrast):
    """With more contrast there are more negligible samples, and more rays stop, some of them inside a span."""
    models = [cloudy(Similarity(1.0 + n / 4, np.eye(3), np.full(3, n / 9)), seed=n).stretched(0.5) for n in range(4)]
    for model in models:
        assert isinstance(model.field, HashField)
        with torch.no_grad():
            model.field.weights[1][0] *= contrast
    together, rays, tolerance = joined(models, division()), random_rays(60, torch.float32), 0.05
    exact, seen = (render_rays(together, *rays, background=torch.zeros(3), tolerance=t) for t in (1e-12, tolerance))
    apart = (seen.rgb - exact.rgb).abs().amax(1)
    assert (apart <= seen.truncation_error + 2e-6).all()
    assert apart.max() > tolerance / 3
    assert seen.truncation_error.max() <= tolerance


def test_every_bit_of_a_picture_of_blocks_is_the_same_in_tiles_of_any_size(spheres):
    models = [cloudy(Similarity(0.4 + n / 4, np.eye(3), np.full(3, n / 9)), seed=n) for n in range(4)]
    together = joined(models, division())
    frame = spheres.test_frames[0]
    frame = replace(frame, camera=frame.camera.resized(8, 6))
    large, small = (
        render_picture(
            together, frame, background=together.background, depth=DepthRequest("median", "z"), rays_per_tile=rays
        )
        for rays in (2**14, 11)
    )
    for name in ("rgb", "opacity", "depth", "spread", "truncation_error"):
        np.testing.assert_array_equal(getattr(large, name), getattr(small, name), err_msg=name)


def test_light_passes_from_block_to_block_by_the_law_of_absorption():
    """Two fogs with different densities and sizes of frames: T = exp(-(d1 l1 + d2 l2)), and where T is 1/2."""
    fogs = []
    for scale, level in ((0.25, 0.0), (0.8, 0.7)):
        model = cloudy(Similarity(scale, np.eye(3), -scale * np.array([0.5, 0.0, 0.0])))
        assert isinstance(model.field, HashField)
        with torch.no_grad():
            for parameter in model.field.parameters():
                parameter.zero_()
            model.field.table[0, :, 0] = 1.0
            model.field.weights[0][0, 0] = 1.0
            model.field.weights[1][0, 0] = level
        march = Marching(near=0.03, far=40.0, shortest_step=scale / 500, growth=0.0)
        fogs.append(replace(model, occupied=torch.ones(16, 16, 16, dtype=torch.bool), marching=march))
    border = 0.4
    cells = (Cell(high=(border, np.inf)), Cell(low=(border, -np.inf)))
    model = joined(fogs, BlockDivision(np.eye(3)[:2], cells, ()))
    first, second = 0.25, 0.8 * np.exp(0.7)  # densities in 1 / scene unit
    scale = model.training_from_scene.scale
    origin = torch.tensor(model.training_from_scene.apply(np.array([[-1.0, 0.2, 0.1]])), dtype=torch.float32)
    seen = render_rays(model, origin, torch.tensor([[1.0, 0.0, 0.0]]), background=torch.zeros(3), fractions=(0.5,))
    near = 0.03 * min(1 / 0.25, 1 / 0.8)
    before = first * (1.4 - near)
    assert seen.ends.quantiles[0, 0].item() / scale == pytest.approx(1.4 + (np.log(2) - before) / second, abs=0.005)
    behind = seen.ends.mean[0].item() / scale
    # The mean of the two exponential distributions, the first one cut at the border.
    passed = np.exp(-before)
    mean = near + (1 - passed) / first - (1.4 - near) * passed + passed * (1.4 - near + 1 / second)
    assert behind == pytest.approx(mean, abs=0.005)


def test_a_joined_field_is_the_same_when_it_is_read_again(tmp_path):
    models = [
        cloudy(Similarity(1.0 + n, np.eye(3), np.full(3, n / 5)), kind=k, seed=n)
        for n, k in ((0, "hash"), (1, "voxels"))
    ]
    model = joined(models, division((Cell(high=(0.1, np.inf)), Cell(low=(0.1, -np.inf)))))
    save_model(tmp_path / "field.safetensors", model)
    again = load_model(tmp_path / "field.safetensors", "cpu")
    assert isinstance(again.field, BlocksField)
    assert (
        again.field.settings
        == model.field.settings
        == settings_from_json(json.loads(json.dumps(model.field.settings.to_json())))
    )
    rays = random_rays(50, torch.float32)
    first, second = (render_rays(one, *rays, background=torch.zeros(3)).rgb for one in (model, again))
    assert torch.equal(first, second)


@pytest.mark.parametrize("fraction", [0.67, 0.003])
def test_occupied_cells_of_a_joined_field_hold_all_that_its_blocks_have(fraction):
    """A lone cell of a block also extends into joined cells of which it contains no vertex."""
    models = [cloudy(Similarity(1.0 + n, np.eye(3), np.full(3, n / 5)), seed=n) for n in range(4)]
    models = [replace(model, occupied=torch.rand(16, 16, 16) < fraction) for model in models]
    model = joined(models, division())
    points = torch.rand(200000, 3, generator=torch.Generator().manual_seed(0))
    assert isinstance(model.field, BlocksField)
    side = len(model.occupied)
    x, y, z = (points * side).long().clamp_max(side - 1).unbind(-1)
    assert not (model.field.is_occupied(points) & ~model.occupied[z, y, x]).any()
    assert 0.2 * fraction < model.field.is_occupied(points).float().mean() < 1.8 * fraction


@pytest.fixture
def captured(tmp_path):
    """A COLMAP project of 12 photos around 600 points that all of them see."""
    capture = ring(CAMERAS["SIMPLE_PINHOLE"].resized(8, 6), num_frames=12, num_points=600)
    frames = tuple(replace(frame, name=f"{index:02d}.png") for index, frame in enumerate(capture.frames))
    (tmp_path / "town" / "images").mkdir(parents=True)
    for number, frame in enumerate(frames):
        Image.new("RGB", (8, 6), (20 * number, 100, 200)).save(tmp_path / "town" / "images" / frame.name)
    write_colmap_binary(replace(capture, frames=frames), tmp_path / "town" / "sparse/0")
    return tmp_path / "town"


@pytest.fixture
def few_cells(monkeypatch: pytest.MonkeyPatch) -> None:
    """Train with cells four times as long: joining blocks asks for every vertex of them."""
    for module in (open_cells, preparation):
        monkeypatch.setattr(module, "OCCUPANCY_SIDE", 16)


@pytest.mark.parametrize("count", [2, 3, 4, 7])
def test_every_place_is_in_one_cell_and_cells_have_equally_many_points(captured, count):
    scene = scenes.load(captured)
    parts = divide(scene, count)
    borders = [value for cell in parts.cells for value in (*cell.low, *cell.high) if np.isfinite(value)]
    rng = np.random.default_rng(0)
    places = np.concatenate([rng.normal(size=(500, 2)), rng.choice(borders, (100, 2)), [[1e9, -1e9]]])
    assert np.sum([cell.contains(places) for cell in parts.cells], axis=0).tolist() == [1] * len(places)
    sizes = [len(part.points) for part in parts.scenes]
    assert sum(sizes) == 600
    assert max(sizes) - min(sizes) <= 4
    for cell, part in zip(parts.cells, parts.scenes, strict=True):
        assert cell.contains(part.points @ parts.ground.T).all()
    up = np.cross(*parts.ground)
    assert up @ [0, 0, 1] > 0.99


def test_photos_belong_to_the_blocks_whose_points_they_see(captured):
    """Photos keep only their observations of some points; points in a margin also count for the neighbouring block."""
    from nerfcli.cameras.formats.colmap import parse_colmap

    capture = parse_colmap(captured / "sparse/0")
    parts = divide(scenes.load(captured), 2)
    assert [len(part.frames) for part in parts.scenes] == [12, 12]
    places = capture.points @ parts.ground.T
    seen = capture.observations
    assert seen is not None
    axis = int(np.argmax(np.isfinite(parts.cells[0].high)))
    border = parts.cells[0].high[axis]
    order = np.argsort(places[:, axis])
    far = {0: set(order[:200].tolist()), 1: set(order[-200:].tolist())}
    # The first six photos see only the far end of the first block, the others only that of the second.
    side = np.where(seen.frame_index < 6, 0, 1)
    kept = np.array([p in far[s] for p, s in zip(seen.point_index.tolist(), side.tolist(), strict=True)])
    # Photo 5 sees more of the other side than the least fraction, and photo 4 less.
    fraction = np.flatnonzero((seen.frame_index == 5) & np.isin(seen.point_index, list(far[1])))
    kept[fraction[: round(2 * LEAST_FRACTION * 200)]] = True
    fraction = np.flatnonzero((seen.frame_index == 4) & np.isin(seen.point_index, list(far[1])))
    kept[fraction[: round(0.5 * LEAST_FRACTION * 200)]] = True
    # The second block's margin extends beyond its border: photo 3 sees points in it, and photo 2 only outside of it.
    spread = np.ptp(np.percentile(places[places[:, axis] >= border, axis], PERCENTILES))
    beyond = (border - places[seen.point_index, axis]) / (MARGIN * spread)
    for photo, (low, high) in ((3, (0.0, 0.9)), (2, (1.1, 2.0))):
        kept[seen.frame_index == photo] = ((beyond > low) & (beyond < high))[seen.frame_index == photo]
    observations = replace(
        seen, frame_index=seen.frame_index[kept], point_index=seen.point_index[kept], pixels=seen.pixels[kept]
    )
    write_colmap_binary(replace(capture, observations=observations), captured / "sparse/0")
    parts = divide(scenes.load(captured), 2)
    assert parts.cells[0].high[axis] == border
    assert [[int(frame.name[:2]) for frame in part.frames] for part in parts.scenes] == [
        list(range(6)),
        [3, 5, *range(6, 12)],
    ]
    assert parts.scenes[0].test_names == {"00.png"}
    assert parts.scenes[1].test_names == {"08.png"}


@pytest.mark.usefixtures("coarse_steps", "few_cells")
def test_blocks_are_trained_into_the_run_and_joined(captured):
    run = captured.with_name("r")
    command = ("train", captured, *QUICK, "-o", run)
    assert nerfcli(*command, "--blocks", "2/2").stdout.strip() == str(run / "blocks" / "2")
    assert error_of(nerfcli("render", run))[0].endswith("are not complete")
    result = nerfcli(*command, "--blocks", "1/2")
    assert result.exit_code == 0, result.stderr
    assert result.stdout.strip() == str(run)
    assert "2 blocks of 10, 10 training photos, of 10 in all" in result.stderr
    blocks = [Run(run / "blocks" / str(number)) for number in (1, 2)]
    model = Run(run).model()
    assert isinstance(model.field, BlocksField)
    for field, block in zip(model.field.fields, blocks, strict=True):
        assert all(map(torch.equal, field.parameters(), block.model().field.parameters()))
    assert Run(run).log[-1]["step"] == 2
    # Training all blocks at once gives the same field, and changes nothing where they exist.
    before = listing(run)
    again = nerfcli(*command, "--blocks", "2")
    assert again.stderr.count("is kept") == 2
    assert listing(run) == before
    other = captured.with_name("s")
    assert nerfcli("train", captured, *QUICK, "-o", other, "--blocks", "2").exit_code == 0
    assert (other / "field.safetensors").read_bytes() == before["field.safetensors"]
    for arguments in (("info", run), ("evaluate", run, "--threads", "1"), ("report", run), ("render", run)):
        result = nerfcli(*arguments)
        assert result.exit_code == 0, result.stderr
    assert "2, of 10, 10 training photos" in (run / "report.html").read_text(encoding="utf-8")
    assert "page cannot" in error_of(nerfcli("export", run, "--to", "page"))[0]
    facts = json.loads(nerfcli("info", run, "--json").stdout)
    assert [(block["photos"], block["held_out"]) for block in facts["blocks"]] == [(10, 2), (10, 2)]
    # More steps continue the blocks.
    assert nerfcli(*command, "--blocks", "2", "--resume", "--steps", "3").exit_code == 0
    assert Run(run).log[-1]["step"] == 6


@pytest.mark.usefixtures("coarse_steps", "few_cells")
def test_an_interrupted_block_is_resumed_by_the_same_command(captured, monkeypatch):
    run = captured.with_name("r")
    command = ("train", captured, *QUICK, "--steps", "8", "-o", run, "--blocks", "2")
    advance = Fitting.advance

    def interrupted(fitting, *arguments, **options):
        if fitting.settings.block == 2 and fitting.step == 4:
            raise KeyboardInterrupt
        return advance(fitting, *arguments, **options)

    with monkeypatch.context() as patched:
        patched.setattr(Fitting, "advance", interrupted)
        result = nerfcli(*command)
    assert result.exit_code == 130
    assert "the same command continues" in result.stderr
    first = (run / "blocks" / "1" / "field.safetensors").read_bytes()
    again = nerfcli(*command)
    assert again.exit_code == 0
    assert "resumed at step 4" in again.stderr
    assert (run / "blocks" / "1" / "field.safetensors").read_bytes() == first
    assert Run(run).log[-1]["step"] == 16


def test_what_cannot_be_divided_is_refused_in_two_lines(captured, capture, finished):
    def refused(scene, *options: str) -> str:
        result = nerfcli("train", scene, *QUICK, "-o", captured.with_name("r"), *options)
        assert result.exit_code in (2, BAD_INPUT)
        return result.stderr if result.exit_code == 2 and "Usage" in result.stderr else error_of(result)[0]

    assert "has no points with the photos that see them" in refused(capture, "--blocks", "2")
    assert "10 training photos, fewer than 11 blocks" in refused(captured, "--blocks", "11")
    for component in ("antialias", "exposure=learned", "cameras=poses", "background=sphere"):
        assert "does not work with --blocks" in refused(captured, "--blocks", "2", "--with", component)
    assert "--contraction none" in refused(captured, "--blocks", "2", "--contraction", "none")
    for text in ("1", "0/2", "3/2", "a"):
        assert "--blocks" in refused(captured, "--blocks", text)
    assert not captured.with_name("r").exists()


def test_too_few_points_or_photos_of_a_block_are_refused_in_two_lines(captured):
    from nerfcli.cameras.formats.colmap import parse_colmap

    capture = parse_colmap(captured / "sparse/0")
    seen = capture.observations
    assert seen is not None

    def refused(kept: np.ndarray, points: np.ndarray = capture.points) -> str:
        some = replace(
            seen, frame_index=seen.frame_index[kept], point_index=seen.point_index[kept], pixels=seen.pixels[kept]
        )
        write_colmap_binary(replace(capture, points=points, colours=None, observations=some), captured / "sparse/0")
        result = nerfcli("train", captured, *QUICK, "-o", captured.with_name("r"), "--blocks", "2")
        assert result.exit_code == BAD_INPUT
        return error_of(result)[0]

    assert "is seen by 1 training photos" in refused(seen.frame_index < 2)
    assert "has 90 points, fewer than 50 for each block" in refused(seen.point_index < 90, capture.points[:90])
    assert "has no points with the photos that see them" in refused(seen.point_index < 0)


@pytest.mark.usefixtures("coarse_steps", "few_cells")
def test_a_run_of_one_field_is_not_replaced_by_blocks(captured):
    run = captured.with_name("r")
    assert nerfcli("train", captured, *QUICK, "-o", run).exit_code == 0
    before = listing(run)
    result = nerfcli("train", captured, *QUICK, "-o", run, "--blocks", "2")
    assert result.exit_code == BAD_INPUT
    assert "has no blocks" in error_of(result)[0]
    assert listing(run) == before


def test_a_dry_run_names_the_photos_and_memory_of_each_block(captured):
    result = nerfcli("train", captured, *QUICK, "--blocks", "2", "--dry-run", "--json")
    plans = [json.loads(line) for line in result.stdout.splitlines()]
    assert [plan["block"] for plan in plans] == [1, 2]
    assert [plan["train_photos"] for plan in plans] == [10, 10]
    one = nerfcli("train", captured, *QUICK, "--blocks", "2/2", "--dry-run")
    assert one.stdout.startswith(f"{captured}, block 2 of 2: 10 training photos and 2 held out")
    assert not captured.with_name("town-run").exists()


@pytest.mark.usefixtures("coarse_steps", "few_cells")
def test_the_array_job_of_the_examples_trains_and_joins_all_blocks(captured):
    """Run the command line of the example with the variables that Slurm sets, for two tasks and one step."""
    (line,) = re.findall(r"^nerfcli (.+)$", (EXAMPLES / "blocks.sbatch").read_text(encoding="utf-8"), re.MULTILINE)
    run = captured.with_name("r")
    for task in ("2", "1"):
        values = {
            "1": str(captured),
            "2": str(run),
            "SLURM_CPUS_PER_TASK": "1",
            "SLURM_ARRAY_TASK_ID": task,
            "SLURM_ARRAY_TASK_COUNT": "2",
        }
        arguments = [
            re.sub(r"\$(\w+)", lambda name, values=values: values[name[1]], word) for word in shlex.split(line)
        ]
        result = nerfcli(*arguments, "--steps", "1", "--log2-rows", "8", "--model", "default")
        assert result.exit_code == 0, result.stderr
    assert result.stdout.strip() == str(run)
    assert Run(run).is_trained
