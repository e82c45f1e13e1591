"""The server of the interactive page: who may look, and what they get, during a training too."""

import errno
import json
import os
import re
import shlex
import signal
import socket
import struct
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from browser import Browser, needs_browser
from commands import error_of, nerfcli, started
from fog import foggy_cells
from present import present
from trainings import FEW

from nerfcli.cameras.camera import Camera
from nerfcli.cameras.frame import Frame
from nerfcli.captures.loading import load_scene
from nerfcli.errors import INTERRUPTED
from nerfcli.field.fourier_field import FourierField, FourierFieldSettings
from nerfcli.machine import Resources
from nerfcli.render.depth import DepthRequest
from nerfcli.render.model import Model, save_model
from nerfcli.render.pictures import RenderedPicture, render_picture
from nerfcli.render.trained_field import Marching
from nerfcli.training import loop
from nerfcli.training.runs.files import FIELD
from nerfcli.training.runs.run import Run
from nerfcli.viewer import painter
from nerfcli.viewer.packing import PackedField, pack_model
from nerfcli.viewer.painter import Painter, Tile, View, render_tile, strides_of, tiles_of, view_from_json
from nerfcli.viewer.pictures import view_of
from nerfcli.viewer.server import PageServer
from nerfcli.workflows.view import RunData, view_run

SHORT = replace(FEW, downscale=8, model="default")


class Served:
    """A run that is served, and a client of it."""

    def __init__(self, run: Path):
        self.show = RunData(run, Resources(2))
        self.server = PageServer(self.show, port=0)
        self.url = self.server.url("127.0.0.1")
        threading.Thread(target=self.server.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True).start()

    def get(self, place: str = "", body: Any = None, *, url: str | None = None) -> bytes:
        data = None if body is None else json.dumps(body).encode()
        with urllib.request.urlopen(urllib.request.Request((url or self.url) + place, data), timeout=60) as answer:
            return answer.read()

    def refusal(self, place: str, body: Any = None, *, url: str | None = None) -> tuple[int, str]:
        with pytest.raises(urllib.error.HTTPError) as caught:
            self.get(place, body, url=url)
        with caught.value as answer:
            return answer.code, answer.read().decode()

    def close(self) -> None:
        self.server.shutdown()
        self.server.server_close()


@pytest.fixture
def served(finished) -> Iterator[Served]:
    with closing(Served(finished)) as opened:
        yield opened


@pytest.fixture
def trained(spheres_run) -> Iterator[Served]:
    with closing(Served(spheres_run)) as opened:
        yield opened


def frame_of(run: Path, *, width: int = 90, height: int = 66) -> Frame:
    frame = Run(run).cameras.test[0]
    camera = frame.camera
    return replace(frame, camera=Camera.pinhole(width, height, camera.focal_px * width / camera.width))


def view_request(frame: Frame) -> dict[str, Any]:
    return {"client": "a", "view": {**view_of(frame), "share": 0.25}}


def records(content: bytes) -> Iterator[tuple[Tile, np.ndarray]]:
    """The tiles of a picture as a page reads them: (height, width, 12)."""
    while content:
        stride, x, y, width, height, _, _, _ = struct.unpack("<8I", content[:32])
        end = 32 + 48 * width * height
        planes = np.frombuffer(content[32:end], "<f4").reshape(3, height, width, 4)
        yield Tile(stride, x, y, width, height), np.moveaxis(planes, 0, 2).reshape(height, width, 12)
        content = content[end:]


def assembled(content: bytes, frame: Frame) -> np.ndarray:
    """The finest picture; every pixel comes once."""
    picture = np.full((frame.camera.height, frame.camera.width, 12), np.nan)
    for tile, values in records(content):
        if tile.stride == 1:
            place = picture[tile.y : tile.y + tile.height, tile.x : tile.x + tile.width]
            assert np.isnan(place).all()
            place[:] = values
    assert not np.isnan(picture).any()
    return picture


# Pictures


def rendered(model: Model, frame: Frame, depth: str) -> RenderedPicture:
    return render_picture(model, frame, background=model.background, depth=DepthRequest(depth, "ray", min_opacity=1e-9))


def test_a_picture_is_that_of_nerfcli_render_bit_for_bit(trained):
    frame, model = frame_of(trained.show._path), Run(trained.show._path).model()
    picture = assembled(trained.get("picture", view_request(frame)), frame)
    columns = {"conditional": 4, "median": 6, "max-weight": 7, "quantile:0.25": 10}
    by_render = {name: rendered(model, frame, name) for name in columns}
    first = by_render["conditional"]
    np.testing.assert_array_equal(picture[..., :3], first.rgb)
    np.testing.assert_array_equal(picture[..., 3], first.opacity)
    assert first.opacity.std() > 0.2
    scale = model.training_from_scene.scale
    for name, column in columns.items():
        expected = present(by_render[name].depth)
        ours = np.where(picture[..., column] < 0, np.nan, picture[..., column] / scale)
        np.testing.assert_allclose(ours, expected, rtol=1e-6)


def test_a_coarse_picture_has_the_rays_of_the_middles_of_its_pixels(spheres_run):
    frame, model = frame_of(spheres_run, width=50, height=33), Run(spheres_run).model()
    view = View(frame, 0.25)
    coarse = render_tile(model, view, Tile(4, 0, 0, 13, 9))
    focal, _, cx, cy = frame.camera.params
    pixel = Camera("PINHOLE", 1, 1, (focal, focal, cx - (4 * 5 + 1.5), cy - (4 * 3 + 1.5)))
    moved = Frame("middle", pixel, frame.world_from_cam)
    one = render_tile(model, View(moved, 0.25), Tile(1, 0, 0, 1, 1))
    np.testing.assert_allclose(coarse[3, 5, :4], one[0, 0, :4], atol=2e-4)


# The second rate would just allow a whole first picture, but for the pixels at its border.
@pytest.mark.parametrize("rate", [1e-8, 0.03 * 64 / (301 * 177), 1e-4, 1e-2])
def test_strides_end_with_every_pixel_and_tiles_cover_each_once_from_the_middle(spheres_run, rate):
    frame = frame_of(spheres_run, width=301, height=177)
    strides = strides_of(301, 177, rate)
    assert strides[-1] == 1
    assert strides == sorted(set(strides), reverse=True)
    assert len(tiles_of(View(frame, 0.5), strides[0], rate)) == 1  # while moving, the picture is one tile
    for stride in strides:
        tiles = tiles_of(View(frame, 0.5), stride, rate)
        width, height = -(-301 // stride), -(-177 // stride)
        seen = np.zeros((height, width), int)
        for tile in tiles:
            seen[tile.y : tile.y + tile.height, tile.x : tile.x + tile.width] += 1
        assert (seen == 1).all()
        off = [np.hypot(t.x + t.width / 2 - width / 2, t.y + t.height / 2 - height / 2) for t in tiles]
        assert off == sorted(off)


def test_a_newer_view_of_a_client_ends_the_one_before_between_two_tiles(monkeypatch, spheres_run):
    """Counted in tiles, so that no assertion depends on the speed of the machine."""
    first, second = (View(frame_of(spheres_run, width=size, height=size), 0.5) for size in (640, 320))
    done: list[int] = []
    going, held = threading.Event(), threading.Event()

    def slow(model: Any, view: View, tile: Tile) -> np.ndarray:
        done.append(view.frame.camera.width)
        if len(done) == 3:
            going.set()
            held.wait(60)
        return np.zeros((tile.height, tile.width, 12), np.float32)

    monkeypatch.setattr(painter, "render_tile", slow)
    works = Painter(lambda: (1, None), threads=1)  # type: ignore[arg-type, return-value]
    works._rates.append(1e-3)
    earlier, later = works.paint("a", first), works.paint("a", second)
    got = [next(earlier)]
    going.wait(60)
    threading.Timer(0.05, held.set).start()
    got_later = list(later)
    got.extend(earlier)
    assert len(got) <= 4
    assert done[3:] == [320] * len(got_later)
    assert len(got_later) > 3


def test_two_clients_get_their_pictures_in_turn(monkeypatch, spheres_run):
    order: list[int] = []

    def quick(model: Any, view: View, tile: Tile) -> np.ndarray:
        order.append(view.frame.camera.width)
        time.sleep(0.001)
        return np.zeros((tile.height, tile.width, 12), np.float32)

    monkeypatch.setattr(painter, "render_tile", quick)
    works = Painter(lambda: (1, None), threads=1)  # type: ignore[arg-type, return-value]
    both_there = threading.Barrier(2)

    def look(name: str, size: int) -> None:
        view = View(frame_of(spheres_run, width=size, height=size), 0.5)
        both_there.wait(60)
        list(works.paint(name, view))

    clients = {name: threading.Thread(target=look, args=(name, size)) for name, size in (("a", 800), ("b", 801))}
    for client in clients.values():
        client.start()
    for client in clients.values():
        client.join(60)
    # From the first tile of the later client to the last of the one that is done first; their number varies.
    begun, done = max(map(order.index, (800, 801))), min(len(order) - order[::-1].index(size) for size in (800, 801))
    both = order[begun:done]
    assert len(both) > 3
    assert all(before != after for before, after in pairwise(both))


@pytest.mark.parametrize(
    "damage",
    [
        {"width": 0},
        {"width": 10**6},
        {"lens": [1, 1, 1]},
        {"lens": [-1, 1, 1, 1]},
        {"place": [0, 0, float("nan")]},
        {"turn": [[2, 0, 0], [0, 1, 0], [0, 0, 1]]},
        {"share": 1},
        {"place": "here"},
    ],
)
def test_what_is_no_view_is_refused(damage, finished):
    sound = view_request(frame_of(finished))["view"]
    view_from_json(sound)
    with pytest.raises(ValueError, match="view"):
        view_from_json(sound | damage)


# Who may look, and what they get


def test_a_wrong_token_is_refused_everywhere(served):
    for token in ("", "x", served.server.token[:-1], served.server.token + "x"):
        wrong = served.url.replace(served.server.token, token)
        for place, body in (("", None), ("version", None), ("field", None), ("picture", {})):
            code, text = served.refusal(place, body, url=wrong)
            assert code == 403
            assert "wrong token" in text


def test_only_this_machine_can_reach_the_server_by_default(served):
    assert served.server.server_address[0] == "127.0.0.1"
    assert len(served.server.token) >= 20


def test_missing_and_meaningless_inputs_are_reported(served):
    assert served.refusal("nothing")[0] == 404
    assert served.refusal("photo?n=1000&px=100")[0] == 404
    assert served.refusal("photo?n=x")[0] == 400
    assert served.refusal("picture", {"view": {}})[0] == 400
    assert served.refusal("picture", [1])[0] == 400
    assert served.refusal("picture", {"client": "x" * 10**5})[0] == 400


def test_the_page_may_fetch_from_its_server_alone(served):
    page = served.get().decode()
    policy = re.findall(r'Content-Security-Policy" content="([^"]*)"', page)[0]
    assert "default-src 'none'" in policy
    assert "connect-src 'self'" in policy
    assert len(page) < 200_000
    assert served.get("photo?n=0&px=40")[:2] == b"\xff\xd8"


def test_the_field_comes_as_the_static_page_has_it(served, monkeypatch):
    packed_models: list[Model] = []

    def counted(model: Model) -> PackedField:
        packed_models.append(model)
        return pack_model(model)

    monkeypatch.setattr("nerfcli.workflows.view.pack_model", counted)
    content = served.get("field")
    length = struct.unpack("<I", content[:4])[0]
    head = json.loads(content[4 : 4 + length])
    served.get()
    assert len(packed_models) == 1  # for the page and its field
    packed = pack_model(Run(served.show._path).model())
    assert head["field"] == packed.field
    assert content[4 + length :] == b"".join(array.tobytes() for array in packed.arrays.values())


def network_without_a_table(model: Model) -> Model:
    field = FourierField(FourierFieldSettings(contraction="none", width=16, octaves=4))
    occupied = torch.ones(8, 8, 8, dtype=torch.bool)
    return Model(
        field, occupied, Marching(0.05, 4.0, 0.1, 0.0), (0.2, 0.4, 0.6), model.training_from_scene, "arbitrary"
    )


def test_what_the_page_cannot_render_is_drawn_by_the_server(finished):
    model = network_without_a_table(Run(finished).model())
    save_model(finished / FIELD, model)
    with closing(Served(finished)) as served:
        assert '"refusal":"the page cannot render a field of type mlp' in served.get().decode()
        assert served.refusal("field")[0] == 503
        frame = frame_of(finished, width=12, height=8)
        picture = assembled(served.get("picture", view_request(frame)), frame)
    np.testing.assert_array_equal(picture[..., :3], rendered(model, frame, "conditional").rgb)


# Addresses


def test_a_port_in_use_is_reported_or_skipped(finished):
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        error, hint = error_of(nerfcli("view", finished, "--port", str(port), "--no-browser"))
        assert error == f"Error: port {port} of 127.0.0.1 is in use"
        assert "--port" in hint
    show = RunData(finished, Resources(1))
    with PageServer(show) as one, PageServer(show) as two:
        assert one.port < two.port


def test_a_port_that_is_not_permitted_is_reported_as_such(finished, monkeypatch):
    def refuse(server: PageServer) -> None:
        raise PermissionError(errno.EACCES, "Permission denied")  # as Linux does below port 1024

    monkeypatch.setattr(PageServer, "server_bind", refuse)
    error, _ = error_of(nerfcli("view", finished, "--port", "80", "--no-browser"))
    assert error == "Error: port 80 of 127.0.0.1 is denied by the system, as ports below 1024 often are"


@pytest.mark.parametrize(
    ("host", "reached"), [("0.0.0.0", "127.0.0.1"), ("localhost", "localhost"), ("::1", "[::1]"), ("::", "[::1]")]
)
def test_the_ssh_command_leads_to_the_printed_address_without_a_user_name_too(finished, monkeypatch, host, reached):
    """As in a container whose user has no entry in /etc/passwd."""
    monkeypatch.setattr("getpass.getuser", lambda: {}["uid 1234"])
    monkeypatch.setattr(PageServer, "server_bind", lambda server: setattr(server, "server_address", (host, 8123)))
    monkeypatch.setattr(PageServer, "server_activate", lambda server: None)  # IPv6 may be missing
    printed: list[str] = []

    def on_ready(url: str, from_elsewhere: str) -> None:
        printed.extend((url, from_elsewhere))
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        view_run(finished, host=host, on_ready=on_ready)
    assert printed[0].startswith(f"http://{reached}:8123/")
    assert shlex.split(printed[1]) == ["ssh", "-L", f"8123:{reached}:8123", socket.gethostname()]


def test_an_address_of_another_machine_is_refused(finished):
    error, _ = error_of(nerfcli("view", finished, "--host", "192.0.2.1", "--no-browser"))
    assert error.startswith("Error: cannot listen on 192.0.2.1")


def test_ctrl_c_ends_the_server(finished):
    process = started("view", finished, "--no-browser")
    url = present(process.stdout).readline().strip()
    with urllib.request.urlopen(url + "version", timeout=60) as answer:
        assert answer.read() == b"1"
    process.send_signal(signal.SIGINT)
    stdout, stderr = process.communicate(timeout=60)
    assert (process.returncode, stdout) == (INTERRUPTED, "")
    assert re.search(r"ssh -L (\d+):127\.0\.0\.1:\1 ", stderr)
    assert stderr.splitlines()[-1].startswith("Interrupted")


# During a training


def fit(run: Path, *, on_step: Any = lambda progress: None) -> None:
    scene = load_scene(run.with_name("spheres"))
    loop.train(scene, run, SHORT, resume=False, notify=lambda text: None, on_progress=on_step)


def test_the_page_waits_for_a_field_in_a_folder_whose_name_is_not_utf_8(tmp_path):
    """Regression: the answer was an error of encoding, after which browsers do not try again."""
    run = tmp_path / os.fsdecode(b"caf\xe9-run")
    with closing(Served(run)) as served:
        status, text = served.refusal("")
        assert (status, text.split(":")[0]) == (503, f"{tmp_path}/caf\\udce9-run has no field yet")
        assert served.refusal("field")[0] == 503


def test_each_checkpoint_is_a_new_version_and_viewers_change_nothing(capture, monkeypatch):
    monkeypatch.setattr(loop, "CHECKPOINT_SECONDS", 0.0)
    alone, run = capture.with_name("alone"), capture.with_name("watched")
    fit(alone)
    with closing(Served(run)) as served:
        seen: list[int] = []

        def on_step(progress: loop.Progress) -> None:
            seen.append(int(served.get("version")))
            if progress.step == 1:
                no_field = f"{run} has no field yet: wait for the first checkpoint of its training\n"
                assert served.refusal("") == (503, no_field)
            else:
                assert served.show.model()[1].sha256 == Run(run).checkpoint_sha256()

        fit(run, on_step=on_step)
        assert seen == list(range(12))
        assert int(served.get("version")) == 12
        assert (run / FIELD).read_bytes() == (alone / FIELD).read_bytes()


# In a browser


@needs_browser
def test_a_browser_without_a_graphics_card_shows_what_the_server_renders(trained, tmp_path):
    with Browser(tmp_path, width=860, height=480) as browser:
        browser.visit(trained.url)
        assert browser.run("document.getElementById('by').value") == "server"
        browser.wait("document.body.dataset.rested > 0")
        assert not browser.errors
        view = browser.run("nerfcliPage.view()")
        drawn_colours = np.array(browser.run("[...nerfcliPage.renderer.layers.at(-1).colour]"))
        found = drawn_colours.reshape(view["height"], view["width"], 4)
        frame = view_from_json(view).frame
        model = Run(trained.show._path).model()
        by_render = rendered(model, frame, "median")
        np.testing.assert_array_equal(found[..., :3].astype(np.float32), by_render.rgb)
        drawn = on_screen(browser)
        np.testing.assert_allclose(drawn, 255 * by_render.rgb, atol=0.6)
        # A motion: the last picture is warped until the new one comes; what was hidden is grey.
        count = browser.run("nerfcliPage.renderer.latencies.length")
        stride = browser.run(
            "(() => { nerfcliPage.walk.move(0.3, 0, 0); nerfcliPage.moved(); "
            "return document.getElementById('field').dataset.stride; })()"
        )
        assert stride == "warped"
        warped = on_screen(browser)
        browser.wait(f"nerfcliPage.done && nerfcliPage.renderer.latencies.length > {count}")
        moved = on_screen(browser)
        seen = (warped != 0x70).any(-1)
        assert seen.mean() > 0.9
        off, still = (np.abs(other - moved)[seen].mean() for other in (warped, drawn))
        assert off < 0.5 * still
        # A request that fails is repeated.
        browser.run(
            "(() => { const real = fetch; globalThis.fetch = async place => { globalThis.fetch = real; "
            "throw new Error('lost'); }; nerfcliPage.walk.move(0.1, 0, 0); nerfcliPage.moved(); })()"
        )
        browser.wait("nerfcliPage.done", seconds=30.0)
        assert not browser.errors


@needs_browser
def test_a_browser_draws_each_new_field_by_itself(finished, tmp_path):
    old = Run(finished).model()
    with closing(Served(finished)) as served, Browser(tmp_path, width=420, height=200) as browser:
        browser.visit(served.url + "?by=page")
        browser.wait("document.body.dataset.rested > 0")
        assert browser.run("nerfcliPage.probe.colour.slice(0, 3)") == {"0": 1, "1": 1, "2": 1}
        half = foggy_cells((-0.5, -0.5, -0.5), (0.5, 0.5, 0.0))
        save_model(finished / FIELD, replace(old, background=(0.0, 0.5, 1.0), occupied=half))
        browser.run("nerfcliPage.check()")  # before the page has asked for a newer field
        found = json.loads(browser.run("document.getElementById('checked').dataset.found"))
        assert found["colour"]["largest"] < 2e-3
        assert found["opacity"]["largest"] < 2e-3
        browser.wait("document.body.dataset.version == 2")
        browser.wait("nerfcliPage.done")
        corner = browser.run("nerfcliPage.probe.colour.slice(0, 4)")
        assert corner["2"] > corner["0"]
        assert not browser.errors


def on_screen(browser: Browser) -> np.ndarray:
    """(H, W, 3) levels of the picture."""
    width, height, *levels = browser.run(
        "(c => [c.width, c.height, ...c.getContext('2d').getImageData(0, 0, c.width, c.height).data])"
        "(document.getElementById('field'))"
    )
    return np.array(levels, float).reshape(height, width, 4)[..., :3]
