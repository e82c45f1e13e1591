"""Depth and other maps in files of every format: the values of the picture, the meaning of the map, and the view."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import pytest
import tifffile
from fog import fog, foggy_cells
from PIL import Image

from nerfcli.cameras.camera import Camera
from nerfcli.cameras.frame import Frame
from nerfcli.cameras.rigid import Similarity, look_at
from nerfcli.errors import UserError
from nerfcli.notices import Reporter
from nerfcli.output import Output
from nerfcli.photos.colours import linear_light
from nerfcli.render.files.depth_files import Levels, map_path, read_map, write_levels, write_maps
from nerfcli.render.files.depth_pictures import DepthMeta
from nerfcli.render.files.file_facts import depth_meta_of
from nerfcli.render.files.float_maps import write_tiff
from nerfcli.render.frames import render_job
from nerfcli.render.job import MEASURED, ExportSettings, RenderJob, depth_meta, floor_of
from nerfcli.render.model import Model
from nerfcli.render.pictures import DepthRequest, RenderedPicture, render_picture

CAMERA = Camera.pinhole(10, 8, 8.0)
DEPTH = DepthRequest("conditional", "z", min_opacity=0.1)
LENGTHS = MEASURED[:3]
OUTPUTS = ("rgb", *LENGTHS)


@pytest.fixture
def model() -> Model:
    """A cube of fog in metres, said to be measured by GPS."""
    cells = foggy_cells((-0.5, -0.5, -0.5), (0.5, 0.5, 0.5))
    foggy = fog(cells, Similarity.identity(), background=(0.2, 0.4, 0.6), step=1 / 32, unit="metre")
    return replace(foggy, unit_source="gps")


def frame(name: str, distance: float = 2.0) -> Frame:
    return Frame(name, CAMERA, look_at(np.array([0.0, 0.0, -distance]), np.zeros(3), np.array([0.0, -1.0, 0.0])))


def ordered(frames: list[Frame], **settings: Any) -> RenderJob:
    wanted: dict[str, Any] = {"outputs": OUTPUTS, "depth": DEPTH} | settings
    return RenderJob(tuple(frames), ExportSettings(**wanted), {"run": "a run", "field_sha256": "ab"})


def export(model: Model, order: RenderJob, folder: Path) -> list[str]:
    """Export and return the notes."""
    notes: list[str] = []
    render_job(model, order, Output(folder), reporter=Reporter(note=notes.append))
    return notes


def pictured(model: Model, name: str = "a", distance: float = 2.0) -> RenderedPicture:
    return render_picture(model, frame(name, distance), background=model.background, depth=DEPTH)


def test_every_format_holds_the_maps_of_the_picture(model, tmp_path):
    export(model, ordered([frame("a.png")], formats=("tiff", "exr", "npy")), tmp_path / "views")
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
    export(model, ordered([frame("a.png")], formats=(file_format,)), tmp_path / "views")
    meta = depth_meta_of(map_path(tmp_path / "views", "depth", "a", file_format))
    assert meta is not None
    assert (meta.convention, meta.axis, meta.opacity_floor) == ("conditional", "z", 0.1)
    assert (meta.unit, meta.unit_source) == ("metre", "gps")
    assert Camera.from_json(meta.view["camera"]) == CAMERA
    assert meta.view["name"] == "a.png"
    np.testing.assert_array_equal(meta.view["world_from_cam"], frame("a").world_from_cam)
    assert meta.provenance == {"run": "a run", "field_sha256": "ab"}
    assert meta.error_bounds["truncation_of_colour_max"] == float(pictured(model).truncation_error.max())


def test_maps_beside_depth_state_their_own_convention_and_floor(model, tmp_path):
    """The median exists only where half of the light ends; the spread wherever depth is valid."""
    export(model, ordered([frame("a")], formats=("tiff", "exr")), tmp_path / "views")
    for output, convention, floor in (
        ("spread", "standard-deviation", 0.1),
        ("disagreement", "median-conditional", 0.5),
    ):
        meta = depth_meta_of(tmp_path / "views" / output / "a.tiff")
        assert meta is not None
        assert (meta.quantity, meta.convention, meta.opacity_floor) == (output, convention, floor)
        assert floor_of(DEPTH, output) == floor
    whole = depth_meta_of(tmp_path / "views/exr/a.exr")
    assert whole is not None
    assert whole.layers["disagreement"] == {"convention": "median-conditional", "opacity_floor": 0.5}


def test_levels_of_a_clip_in_metres_are_millimetres(model, tmp_path):
    notes = export(model, ordered([frame("a"), frame("b", 3.0)], formats=("png16",)), tmp_path / "views")
    assert "16-bit files: one level is 1 mm, 0 means no value" in notes
    for name, distance in (("a", 2.0), ("b", 3.0)):
        depth = pictured(model, name, distance).depth
        assert depth is not None
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
    stated = depth_meta_of(tmp_path / "depth16" / "a.png")
    assert stated is not None
    assert stated.error_bounds["pixels_beyond_levels"] == 3
    # If all depths are within twice the range that most of them need, the levels hold all.
    depths[0, :3, 0] = 5.0
    write_tiff(map_path(tmp_path, "depth", "a", "tiff"), depths[0], replace(meaning, unit="arbitrary"))
    written = write_levels(tmp_path, ["a"], meaning=replace(meaning, unit="arbitrary"))
    assert written == Levels(units_per_level=1e-4, pixels_beyond=0)


@pytest.mark.parametrize("file_format", ["tiff", "exr", "npy"])
def test_a_file_of_another_meaning_is_not_read_into_a_clip(file_format, model, tmp_path):
    """Previews, levels and videos are made from the files: one with another meaning is refused by name."""
    settings = ordered([], formats=(file_format,)).settings
    meaning = depth_meta(model, DEPTH)
    write_maps(pictured(model), tmp_path, "a", settings=settings, meta=meaning)
    for output in LENGTHS:
        expected = meaning.of(output, opacity_floor=floor_of(DEPTH, output))
        np.testing.assert_array_equal(read_map(tmp_path, "a", expected), getattr(pictured(model), output))
    write_maps(pictured(model), tmp_path, "a", settings=settings, meta=replace(meaning, axis="ray"))
    with pytest.raises(UserError, match=r"a\.\w+ and the other frames have different definitions: axis z and ray"):
        read_map(tmp_path, "a", meaning)


def test_depth_without_a_meaning_is_not_read_into_a_clip(model, tmp_path):
    tifffile.imwrite(tmp_path / "a.tiff", np.zeros((8, 10), np.float32))
    (tmp_path / "depth").mkdir()
    (tmp_path / "a.tiff").rename(tmp_path / "depth/a.tiff")
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
    export(model, ordered([frame("a")], outputs=("depth",)), tmp_path / "views")
    with pytest.raises(UserError, match=f"views contains depth with another definition: {stated}"):
        export(model, ordered([frame("a")], outputs=("depth",), depth=other), tmp_path / "views")
    (note,) = export(model, ordered([frame("a")], outputs=("depth",)), tmp_path / "views")
    assert "is kept" in note
