"""Files that `render_job` writes: their values, meaning and names in every format, one range over all frames."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import imageio_ffmpeg
import numpy as np
import OpenEXR
import pytest
import tifffile
from fog import CUBE, fog
from PIL import Image
from present import present

from nerfcli.cameras.camera import Camera
from nerfcli.cameras.frame import Frame
from nerfcli.cameras.rigid import Similarity, look_at
from nerfcli.errors import UserError
from nerfcli.notices import Reporter
from nerfcli.output import Output
from nerfcli.photos.colours import linear_light
from nerfcli.photos.images import read_image
from nerfcli.render.depth import effective_floor
from nerfcli.render.files.depth_files import Levels, map_path, read_map, write_levels, write_maps
from nerfcli.render.files.depth_meta import DepthMeta
from nerfcli.render.files.file_facts import depth_meta_of
from nerfcli.render.files.float_maps import read_tiff, write_tiff
from nerfcli.render.frames import render_job
from nerfcli.render.job import MEASURED, RenderJob, RenderSettings, VideoSettings, depth_meta, file_names, floor_of
from nerfcli.render.model import Model
from nerfcli.render.pictures import DepthRequest, RenderedPicture, render_picture
from nerfcli.render.presentation import preview, value_range
from nerfcli.render.tracing import TOLERANCE

CAMERA = Camera.pinhole(10, 8, 8.0)
DEPTH = DepthRequest("conditional", "z", min_opacity=0.1)
LENGTHS = MEASURED[:3]
OUTPUTS = ("rgb", *LENGTHS)


def frame(name: str, distance: float = 2.0) -> Frame:
    """A camera that looks at the middle of the cube from `distance` training units."""
    return Frame(name, CAMERA, look_at(np.array([0.0, 0.0, -distance]), np.zeros(3), np.array([0.0, -1.0, 0.0])))


@pytest.fixture
def model() -> Model:
    """A cube of fog in metres, said to be measured by GPS."""
    foggy = fog(CUBE, Similarity.identity(), background=(0.2, 0.4, 0.6), step=1 / 32, unit="metre")
    return replace(foggy, unit_source="gps")


def export(
    model: Model, frames: list[Frame], folder: Path, *, notes: list[str] | None = None, **settings: Any
) -> list[Path]:
    """Render, and return the paths that are shown; `notes` gets the notes."""
    wanted: dict[str, Any] = {"outputs": ("rgb", "depth", "opacity"), "depth": DEPTH} | settings
    job = RenderJob(tuple(frames), RenderSettings(**wanted), {"run": "a run", "field_sha256": "ab"})
    return render_job(model, job, Output(folder), reporter=Reporter(note=([] if notes is None else notes).append))


def pictured(model: Model, name: str = "a", distance: float = 2.0) -> RenderedPicture:
    return render_picture(model, frame(name, distance), background=model.background, depth=DEPTH)


def listing(folder: Path) -> list[str]:
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file())


def test_files_hold_what_was_rendered(model, tmp_path):
    written = export(model, [frame("a.png")], tmp_path / "views", formats=("tiff", "npy"))
    assert written == [tmp_path / "views" / name for name in ("rgb", "depth", "opacity")]
    files = ["depth/a.json", "depth/a.npy", "depth/a.png", "depth/a.tiff", "opacity/a.png", "render.json", "rgb/a.png"]
    assert listing(tmp_path / "views") == files
    picture = pictured(model)
    path = tmp_path / "views/depth/a.tiff"
    for depth in (read_tiff(path), np.load(path.with_suffix(".npy"))):
        np.testing.assert_array_equal(depth, present(picture.depth))
    np.testing.assert_array_equal(read_image(tmp_path / "views/rgb/a.png"), np.round(picture.rgb * 255))
    grey = np.round(picture.opacity * 255)[..., None]
    np.testing.assert_array_equal(read_image(tmp_path / "views/opacity/a.png"), np.repeat(grey, 3, axis=-1))
    meta = present(depth_meta_of(path))
    assert (meta.convention, meta.axis, meta.unit, meta.opacity_floor) == ("conditional", "z", "metre", 0.1)
    assert json.loads((tmp_path / "views/depth/a.json").read_text())["convention"] == "conditional"


def test_pictures_say_what_they_are(model, tmp_path):
    export(model, [frame("a.png")], tmp_path / "views")
    with Image.open(tmp_path / "views/rgb/a.png") as rgb, Image.open(tmp_path / "views/depth/a.png") as depth:
        assert rgb.info["colour"] == "sRGB"
        assert rgb.info["background"] == "(0.2, 0.4, 0.6)"
        assert (depth.info["convention"], depth.info["axis"], depth.info["unit"]) == ("conditional", "z", "metre")
    with Image.open(tmp_path / "views/opacity/a.png") as opacity:
        assert opacity.info["quantity"].startswith("opacity")
    description = json.loads((tmp_path / "views/render.json").read_text())
    assert description["depth_meaning"]["convention"] == "conditional"
    assert description["settings"]["outputs"] == ["rgb", "depth", "opacity"]
    assert description["run"] == "a run"
    (listed,) = description["frames"]
    assert listed["file"] == "a"
    assert Camera.from_json(listed["camera"]) == CAMERA
    np.testing.assert_array_equal(listed["world_from_cam"], frame("a").world_from_cam)


def test_only_requested_outputs_are_written(model, tmp_path):
    export(model, [frame("a.png")], tmp_path / "views", outputs=("opacity",))
    assert listing(tmp_path / "views") == ["opacity/a.png", "render.json"]
    assert "depth_meaning" not in json.loads((tmp_path / "views/render.json").read_text())


FLOORS = {"conditional": 0.1, "max-weight": 0.1, "quantile:0.05": 0.1, "median": 0.5, "moment": 0.0, "background": 0.0}


@pytest.mark.parametrize(("convention", "floor"), FLOORS.items())
def test_each_convention_states_its_own_floor_and_background(convention, floor, model, tmp_path):
    request = DepthRequest(convention, "ray", min_opacity=0.1, background_distance=9.0)
    assert effective_floor(request) == floor
    export(model, [frame("a")], tmp_path / "views", outputs=("depth",), depth=request)
    meta = present(depth_meta_of(tmp_path / "views/depth/a.tiff"))
    assert (meta.convention, meta.axis, meta.opacity_floor) == (convention, "ray", floor)
    assert meta.background_distance == (9.0 if convention == "background" else None)


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        (
            ["left/a.png", "right/a.png", "b.jpg", "b.png", "c.2.jpg", "Küche 1.JPG", "view_0001"],
            ["left/a", "right/a", "b.jpg", "b.png", "c.2", "Küche 1", "view_0001"],
        ),
        # The whole name of the first is the stem of others.
        (["b", "b.png", "b.jpg", "b.png.jpg"], ["b", "b.png", "b.jpg", "b.png.jpg"]),
        (["../images/a.png", "a.png", "../b.png"], ["up/images/a", "a", "up/b"]),
    ],
    ids=["folders", "stems that are names", "outside"],
)
def test_names_keep_folders_and_stay_apart_and_inside(names, expected):
    assert file_names([frame(name) for name in names]) == expected


def test_frames_in_subfolders_with_equal_names(model, tmp_path):
    frames = [frame(name) for name in ("left/a.png", "right/a.png", "b.jpg", "b.png")]
    export(model, frames, tmp_path / "views", formats=("tiff", "npy"))
    for output, suffix in (("rgb", "png"), ("depth", "tiff"), ("depth", "npy"), ("depth", "png"), ("opacity", "png")):
        found = [name for name in listing(tmp_path / "views" / output) if name.endswith(suffix)]
        assert sorted(f"{name}.{suffix}" for name in ("left/a", "right/a", "b.jpg", "b.png")) == found, output


def test_previews_share_one_range_over_all_frames(model, tmp_path):
    frames = [frame("near", 1.0), frame("far", 3.0)]
    export(model, frames, tmp_path / "views", outputs=("depth",))
    paths = [tmp_path / f"views/depth/{name}.tiff" for name in ("near", "far")]
    colours = value_range(lambda: map(read_tiff, paths), "depth")
    assert colours.high - colours.low > 1.5
    for path in paths:
        expected = preview(read_tiff(path), present(depth_meta_of(path)), colours)
        np.testing.assert_array_equal(read_image(path.with_suffix(".png")), expected)


def test_one_video_per_output_with_every_frame_in_it(model, tmp_path):
    frames = [frame(f"view_{index:04d}", 1.5 + 0.1 * index) for index in range(5)]
    written = export(model, frames, tmp_path / "views", outputs=("rgb", "depth"), video=VideoSettings(fps=12))
    assert written == [tmp_path / "views/rgb.mp4", tmp_path / "views/depth.mp4"]
    for path in written:
        count, seconds = imageio_ffmpeg.count_frames_and_secs(str(path))
        assert count == 5
        assert seconds == pytest.approx(5 / 12, abs=0.05)
    assert len(listing(tmp_path / "views/rgb")) == 5


@pytest.fixture
def views(model, tmp_path):
    """The export of one view on alpha."""
    export(model, [frame("a.png")], tmp_path / "views", outputs=("rgb", "depth"), rgba=True)
    return tmp_path / "views"


def test_alpha_is_straight_and_holds_no_background(views):
    rgba = read_image(views / "rgb/a.png")
    assert rgba.shape == (8, 10, 4)
    there = rgba[..., 3] > 20
    assert 0.2 < there.mean() < 1
    assert np.abs(rgba[there][:, :3].astype(int) - 128).max() <= 1  # the fog's colour is 1/2, its background is not
    assert (rgba[rgba[..., 3] == 0] == 0).all()


def test_every_file_states_the_error_of_its_rendering(views):
    description = json.loads((views / "render.json").read_text())
    facts = description["facts"]["a"]
    assert facts["tolerance"] == TOLERANCE
    assert 0 <= facts["truncation_of_colour_mean"] <= facts["truncation_of_colour_max"] <= TOLERANCE
    assert facts["pixels_measured"] == 80
    assert facts["quadrature_of_depth_p95"] > 0
    assert "not how close the field is to the scene" in description["error_meaning"]
    meta = present(depth_meta_of(views / "depth/a.tiff"))
    assert {name: meta.error_bounds[name] for name in facts} == facts
    assert meta.error_bounds["meaning"] == description["error_meaning"]
    with Image.open(views / "rgb/a.png") as picture:
        assert picture.info["background"] == "none: straight alpha"
        assert float(picture.info["error truncation_of_colour_max"]) == facts["truncation_of_colour_max"]
    assert description["settings"]["step"] == 1.0


def test_every_format_holds_the_maps_of_the_picture(model, tmp_path):
    export(model, [frame("a.png")], tmp_path / "views", outputs=OUTPUTS, formats=("tiff", "exr", "npy"))
    picture = pictured(model)
    with OpenEXR.File(str(tmp_path / "views/exr/a.exr"), separate_channels=True) as file:
        channels = {name: np.array(channel.pixels) for name, channel in file.channels().items()}
    for output, channel in zip(LENGTHS, ("Z", "spread.V", "disagreement.V"), strict=True):
        expected = getattr(picture, output)
        assert np.isfinite(expected).any()
        assert np.isnan(expected).any()
        tiff = tifffile.imread(tmp_path / "views" / output / "a.tiff")
        npy = np.load(tmp_path / "views" / output / "a.npy")
        for found in (channels[channel], tiff, npy):
            np.testing.assert_array_equal(found, expected)
    np.testing.assert_array_equal(channels["opacity.V"], picture.opacity)
    np.testing.assert_array_equal(channels["R"], linear_light(picture.rgb)[..., 0])


@pytest.mark.parametrize("file_format", ["tiff", "exr", "npy", "png16"])
def test_every_file_says_what_it_is_and_who_saw_it(file_format, model, tmp_path):
    export(model, [frame("a.png")], tmp_path / "views", formats=(file_format,))
    meta = present(depth_meta_of(map_path(tmp_path / "views", "depth", "a", file_format)))
    assert (meta.convention, meta.axis, meta.opacity_floor) == ("conditional", "z", 0.1)
    assert (meta.unit, meta.unit_source) == ("metre", "gps")
    assert Camera.from_json(meta.view["camera"]) == CAMERA
    assert meta.view["name"] == "a.png"
    np.testing.assert_array_equal(meta.view["world_from_cam"], frame("a").world_from_cam)
    assert meta.provenance == {"run": "a run", "field_sha256": "ab"}
    assert meta.error_bounds["truncation_of_colour_max"] == float(pictured(model).truncation_error.max())


def test_maps_beside_depth_state_their_own_convention_and_floor(model, tmp_path):
    """The median exists only where half of the light ends; the spread wherever depth is valid."""
    export(model, [frame("a")], tmp_path / "views", outputs=OUTPUTS, formats=("tiff", "exr"))
    stated = [("spread", "standard-deviation", 0.1), ("disagreement", "median-conditional", 0.5)]
    for output, convention, floor in stated:
        meta = present(depth_meta_of(tmp_path / "views" / output / "a.tiff"))
        assert (meta.quantity, meta.convention, meta.opacity_floor) == (output, convention, floor)
        assert floor_of(DEPTH, output) == floor
    whole = present(depth_meta_of(tmp_path / "views/exr/a.exr"))
    assert whole.layers["disagreement"] == {"convention": "median-conditional", "opacity_floor": 0.5}


def test_levels_of_a_clip_in_metres_are_millimetres(model, tmp_path):
    notes: list[str] = []
    export(model, [frame("a"), frame("b", 3.0)], tmp_path / "views", notes=notes, formats=("png16",))
    assert "16-bit files: one level is 1 mm, 0 means no value" in notes
    for name, distance in (("a", 2.0), ("b", 3.0)):
        depth = present(pictured(model, name, distance).depth)
        levels = np.asarray(Image.open(tmp_path / "views/depth16" / f"{name}.png"))
        expected = np.where(np.isnan(depth), 0, np.rint(depth.astype(np.float64) * 1000))
        np.testing.assert_array_equal(levels, expected)
        # The float files that the levels were made from are kept.
        np.testing.assert_array_equal(tifffile.imread(tmp_path / "views/depth" / f"{name}.tiff"), depth)
    description = json.loads((tmp_path / "views/render.json").read_text())
    assert description["depth16"] == {"units_per_level": 1e-3, "pixels_beyond": 0}


def test_a_few_far_pixels_do_not_make_levels_coarse(tmp_path):
    """3 of 5000 pixels at 1000 m among others between 2 and 3 m: millimetres hold 65.535 m."""
    rng = np.random.default_rng(0)
    meaning = DepthMeta("conditional", "z", "metre", opacity_floor=0.5)
    depths = rng.uniform(2, 3, (2, 50, 50)).astype(np.float32)
    depths[0, :3, 0] = 1000.0
    depths[1, 0, 0] = np.nan
    for name, depth in zip("ab", depths, strict=True):
        path = map_path(tmp_path, "depth", name, "tiff")
        path.parent.mkdir(exist_ok=True)
        write_tiff(path, depth, meaning)
    written = write_levels(tmp_path, ["a", "b"], meaning=meaning)
    assert written == Levels(units_per_level=1e-3, pixels_beyond=3)
    for name, depth in zip("ab", depths, strict=True):
        levels = np.asarray(Image.open(tmp_path / "depth16" / f"{name}.png"))
        near = np.where(np.isnan(depth) | (depth > 65.5), 0, depth.astype(np.float64) * 1000)
        np.testing.assert_array_equal(levels, np.rint(near))
    stated = present(depth_meta_of(tmp_path / "depth16" / "a.png"))
    assert stated.error_bounds["pixels_beyond_levels"] == 3
    # If all depths are within twice the range that most of them need, the levels hold all.
    depths[0, :3, 0] = 5.0
    write_tiff(map_path(tmp_path, "depth", "a", "tiff"), depths[0], replace(meaning, unit="arbitrary"))
    written = write_levels(tmp_path, ["a"], meaning=replace(meaning, unit="arbitrary"))
    assert written == Levels(units_per_level=1e-4, pixels_beyond=0)


@pytest.mark.parametrize("file_format", ["tiff", "exr", "npy"])
def test_a_file_of_another_meaning_is_not_read_into_a_clip(file_format, model, tmp_path):
    """Previews, levels and videos are made from the files: one with another meaning is refused by name."""
    settings = RenderSettings(OUTPUTS, DEPTH, (file_format,))
    meaning = depth_meta(model, DEPTH)
    write_maps(pictured(model), tmp_path, "a", settings=settings, meta=meaning)
    for output in LENGTHS:
        expected = meaning.of(output, opacity_floor=floor_of(DEPTH, output))
        np.testing.assert_array_equal(read_map(tmp_path, "a", expected), getattr(pictured(model), output))
    write_maps(pictured(model), tmp_path, "a", settings=settings, meta=replace(meaning, axis="ray"))
    with pytest.raises(UserError, match=r"a\.\w+ and the other frames have different definitions: axis z and ray"):
        read_map(tmp_path, "a", meaning)


def test_depth_without_a_meaning_is_not_read_into_a_clip(model, tmp_path):
    (tmp_path / "depth").mkdir()
    tifffile.imwrite(tmp_path / "depth/a.tiff", np.zeros((8, 10), np.float32))
    with pytest.raises(UserError, match="it does not state what its values mean"):
        read_map(tmp_path, "a", depth_meta(model, DEPTH))


@pytest.mark.parametrize(
    ("other", "stated"),
    [
        (DepthRequest("median", "z", min_opacity=0.1), "convention conditional, not median"),
        (DepthRequest("conditional", "ray", min_opacity=0.1), "axis z, not ray"),
        (DepthRequest("conditional", "z", min_opacity=0.2), "min_opacity 0.1, not 0.2"),
    ],
)
def test_a_folder_of_another_kind_is_named_as_such(other, stated, model, tmp_path):
    notes: list[str] = []
    export(model, [frame("a")], tmp_path / "views", outputs=("depth",))
    with pytest.raises(UserError, match=f"views contains depth with another definition: {stated}"):
        export(model, [frame("a")], tmp_path / "views", outputs=("depth",), depth=other)
    export(model, [frame("a")], tmp_path / "views", notes=notes, outputs=("depth",))
    (note,) = notes
    assert "is kept" in note
