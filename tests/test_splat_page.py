"""The page of splats: what it holds, and in a browser without a network what is where, in which colour."""

import math

import numpy as np
import pytest
from browser import Browser, needs_browser
from page_arithmetic import array
from PIL import Image

from nerfcli.cameras.rigid import apply, inverse, look_at
from nerfcli.splats.files import read_splats, write_splat_page
from nerfcli.splats.gaussians import Gaussians, basis

WORLD_FROM_CAM = look_at(np.array([1.0, -0.8, -4.0]), np.array([0.3, 0.1, 0.2]), np.array([0.0, -1.0, 0.0]))
FOV_DEG, BACKGROUND = 50.0, (1.0, 0.6, 0.2)


def balls() -> Gaussians:
    """Opaque balls of different colours, which change with the direction, in a frame whose y points down."""
    means = np.array([[-0.6, -0.9, 0.0], [0.7, -0.7, 0.3], [-0.5, 0.8, 0.0], [0.9, 0.6, -0.4], [0.2, 0.0, 0.5]])
    harmonics = np.random.default_rng(3).uniform(-0.45, 0.45, size=(5, 16, 3))
    return Gaussians(means, np.full((5, 3), -2.0), np.tile([1.0, 0, 0, 0], (5, 1)), np.full(5, 12.0), harmonics)


@pytest.fixture
def page(tmp_path):
    notes: list[str] = []
    path = tmp_path / "a <b>.html"
    view = {"world_from_cam": WORLD_FROM_CAM, "fov_deg": FOV_DEG, "background": BACKGROUND}
    write_splat_page(path, balls(), run=tmp_path / "<Balls> & more", **view, notify=notes.append)
    assert notes == []
    return path


def test_page_holds_splats_viewer_and_licence(page, tmp_path):
    text = page.read_text(encoding="utf-8")
    assert "<title>&lt;Balls&gt; &amp; more: nerfcli splats</title>" in text
    assert "SuperSplat Viewer 1.36.2" in text
    assert "Permission is hereby granted, free of charge" in text
    (tmp_path / "a.ply").write_bytes(array(text, "splats", "u1").tobytes())
    means = read_splats(tmp_path / "a.ply", print)[0].means
    np.testing.assert_allclose(means, balls().means, rtol=0, atol=np.exp(-2) / 32)  # of the size of the balls


@needs_browser
@pytest.mark.parametrize("size", [(640, 480), (520, 700)])
def test_first_view_in_a_browser_without_a_network(page, tmp_path, size):
    """The middle of each ball is where the camera has it, in the colour that its harmonics have in that direction."""
    flags = ("--host-resolver-rules=MAP * ~NOTFOUND",)
    with Browser(tmp_path / "profile", width=size[0], height=size[1], flags=flags) as browser:
        browser.open(page)
        assert browser.run("document.body.dataset.state") == "ready"
        assert browser.errors == []
        assert browser.run("performance.getEntriesByType('resource').length") == 0
        browser.run("document.querySelectorAll('.sse-viewer > :not(canvas)').forEach(part => part.remove())")
        browser.run("new Promise(done => setTimeout(done, 500))")  # for the next frame
        browser.screenshot(tmp_path / "a.png")
    picture = np.asarray(Image.open(tmp_path / "a.png").convert("RGB")) / 255
    height, width, _ = picture.shape
    seen = apply(inverse(WORLD_FROM_CAM), balls().means)
    focal = height / 2 / math.tan(math.radians(FOV_DEG) / 2)
    columns, rows = (focal * seen[:, :2] / seen[:, 2:] + [width / 2, height / 2]).astype(int).T
    directions = balls().means - WORLD_FROM_CAM[:3, 3]
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    colours = 0.5 + np.einsum("nk,nkc->nc", basis(directions, 3), balls().harmonics)
    # Steps of harmonics up to 1/16 each, 16 of them with values up to 1: 0.06 where all were off by half.
    np.testing.assert_allclose(picture[rows, columns], np.clip(colours, 0, 1), rtol=0, atol=0.06)
    np.testing.assert_allclose(picture[5, 5], BACKGROUND, rtol=0, atol=1 / 255)


@needs_browser
def test_a_browser_without_webgl_is_told(page, tmp_path):
    with Browser(tmp_path / "profile", flags=("--disable-3d-apis",)) as browser:
        browser.open(page)
        assert "cannot show the splats: Error: WebGL not supported" in browser.run("document.body.innerText")
