"""Damaged files of every format: refused in two lines that name the file, or what is read is sound; nothing else.

Each format of captures, runs, splats and scans has a small sound sample here, the files of it that are damaged, and how
it is read. Damage is random, from a seed.
"""

import json
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scan_files
import torch
from captures import CAMERAS, ring
from corruption import assert_refused_or_sound, assert_sound, corrupted_binary, corrupted_json, corrupted_text
from every_format import WITH_PHOTOS
from test_every_format import VIEWS, WITHOUT_PHOTOS
from test_format_ply import by_hand
from test_splat_files import waves

from nerfcli.atomic import read_json, write_json
from nerfcli.cameras.camera import Camera
from nerfcli.captures.capture import Capture
from nerfcli.captures.formats.format import UserInputs
from nerfcli.captures.formats.ply import read_points
from nerfcli.captures.formats.registry import format_named, recognise
from nerfcli.ct.convert import read_scan
from nerfcli.ct.scan import Scan
from nerfcli.errors import UserError
from nerfcli.field.checkpoint import load_tensors, save_tensors
from nerfcli.splats.files import read_splats, write_splats

PICTURES = (".jpg", ".png", ".tif", ".raw")


@dataclass(frozen=True)
class Sample:
    """A small sound sample of a format.

    Args:
        write: writes it into a folder.
        read: reads what is in the folder, and asserts that it is sound.
        least: smallest fraction of damaged files that must be refused; the damage to the others does no harm.
        files: names of the files that are damaged; "" for all but pictures and archives of other libraries.
    """

    write: Callable[[Path], Any]
    read: Callable[[Path], None]
    least: float = 0.5
    files: str = ""


def read_capture(camera: Camera | None, folder: Path) -> None:
    """Read a capture as every command does."""
    places = [folder, *sorted(folder.glob("cameras.json")), *sorted(folder.glob("*.txt"))]
    form, found = recognise(places[0] if camera is None else places[-1])
    capture = form.parse(found, UserInputs(camera=camera))
    assert_sound(capture)
    if any("frames left out" in note for note in capture.notes):  # damage to one frame, which is named
        raise UserError(" ".join([str(folder), *capture.notes]), "")


def rich(name: str, place: str, folder: Path) -> None:
    """Write points, their colours and observations, several lenses and masks, as far as the format has them."""
    capture = ring(CAMERAS["PINHOLE"], CAMERAS["OPENCV"], CAMERAS["OPENCV_FISHEYE"], num_frames=4, num_points=12)
    split = replace(capture.frames[0], split="test", mask=folder / "mask.png")
    write = format_named(name).write
    assert write is not None
    write(replace(capture, frames=(split, *capture.frames[1:])), folder / place)


def poses_alone(name: str, folder: Path) -> None:
    file, content = WITHOUT_PHOTOS[name]
    if name == "camera-path":
        listed = json.loads(content)
        content = json.dumps(listed | {"camera_path": 2 * listed["camera_path"], "fps": 24, "seconds": 1.0})
    later = "".join(f"{time} 1 2 3 0 0 0 1\n" for time in range(1, 8)) if name == "tum" else 7 * content
    (folder / file).write_text(content if name == "camera-path" else content + later)


def read_named(name: str, file: str, folder: Path) -> None:
    """Read a file of poses without a camera."""
    assert_sound(format_named(name).parse(folder / file, UserInputs(camera=CAMERAS["PINHOLE"])))


def read_cloud(folder: Path) -> None:
    points, colours = read_points(folder / "a.ply")
    assert_sound(Capture(ring(CAMERAS["PINHOLE"], num_frames=1).frames, points, (), None, "ply", colours=colours))


def read_own_splats(file: str, folder: Path) -> None:
    assert all(np.isfinite(values).all() for values in read_splats(folder / file, lambda text: None)[0])


def write_checkpoint(folder: Path) -> None:
    tensors = {"a": torch.arange(40.0), "flags": torch.tensor([True, False])}
    save_tensors(folder / "field.safetensors", tensors, {"step": 3, "name": "küche"})


def read_checkpoint(folder: Path) -> None:
    """Damage that goes unnoticed loses nothing: it is in the spaces that pad the header."""
    tensors, description = load_tensors(folder / "field.safetensors", "cpu")
    assert description == {"step": 3, "name": "küche"}
    assert {name: tensor.tolist() for name, tensor in tensors.items()} == {
        "a": torch.arange(40.0).tolist(), "flags": [True, False],
    }  # fmt: skip


def write_metrics(folder: Path) -> None:
    write_json(folder / "metrics.json", {"mean": {"psnr": 20.0}, "images": [{"name": "a", "psnr": 20.0}]})


def read_metrics(folder: Path) -> None:
    read_json(folder / "metrics.json", needed=("mean", "images"), hint="measure again")


def read_sound_scan(folder: Path) -> None:
    path = next(iter(sorted((*folder.glob("*.h5"), *folder.glob("*.nxs"), *folder.glob("*.mat")))), folder)
    scan: Scan = read_scan(path)
    assert np.isfinite(scan.geometry.vectors()).all()
    assert np.isfinite(scan.line_integrals(np.arange(scan.geometry.views))).all()


# Half of the damage to these changes a digit, which gives another sound number. How much does so depends on the last
# digits of the sample, and these on the processor: 74 and 77 of 150 are refused on a Xeon.
MOSTLY_DIGITS = ("colmap-text", "kapture")
SAMPLES: dict[str, Sample] = {
    **{
        name: Sample(partial(write, VIEWS), partial(read_capture, None), 0.4 if name in MOSTLY_DIGITS else 0.5)
        for name, write in WITH_PHOTOS.items()
    },
    "colmap with points": Sample(partial(rich, "colmap", "sparse/0"), partial(read_capture, None)),
    "colmap-text with points": Sample(partial(rich, "colmap-text", "sparse/0"), partial(read_capture, None)),
    "transforms with points": Sample(partial(rich, "transforms", "transforms.json"), partial(read_capture, None)),
    **{
        name: Sample(partial(poses_alone, name), partial(read_named, name, WITHOUT_PHOTOS[name][0]))
        for name in WITHOUT_PHOTOS
    },
    **{
        f"points, {encoding}": Sample(
            lambda folder, encoding=encoding: (folder / "a.ply").write_bytes(by_hand(encoding)), read_cloud, 0.4
        )
        for encoding in ("ascii", "binary_little_endian", "binary_big_endian")
    },
    **{
        file: Sample(
            lambda folder, file=file: write_splats(folder / file, waves(), description=None, notify=lambda text: None),
            partial(read_own_splats, file),
            0.25,
        )
        for file in ("a.ply", "a.spz")
    },
    "checkpoint of a run": Sample(write_checkpoint, read_checkpoint),
    "metrics of a run": Sample(write_metrics, read_metrics, 0.25),
    "run": Sample(partial(WITH_PHOTOS["run"], VIEWS), partial(read_capture, None), files="cameras.json"),
    **{
        f"scan, {name}": Sample(write, read_sound_scan, 0.25)
        for name, write in scan_files.WRITERS.items()
        if name not in ("data-exchange", "nxtomo", "heltomo")  # h5py and SciPy read these: see `test_ct_damage`
    },
}


def corrupted_archive(data: bytes, rng: np.random.Generator) -> bytes:
    """Return an archive of arrays with damage behind its checksums, or to its own bytes."""
    if rng.random() < 0.5:
        return corrupted_binary(data, rng)
    with zipfile.ZipFile(BytesIO(data)) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    name = str(rng.choice(list(members)))
    members[name] = corrupted_binary(members[name], rng)
    written = BytesIO()
    with zipfile.ZipFile(written, "w") as archive:
        for member, content in members.items():
            archive.writestr(member, content)
    return written.getvalue()


DAMAGE: dict[str, Callable[[bytes, np.random.Generator], bytes]] = {
    **dict.fromkeys((".json", ".sfm"), corrupted_json),
    **dict.fromkeys((".txt", ".out", ".csv", ".xml", ".xmp", ".yaml", ".xtekct", ".log", ".ang"), corrupted_text),
    ".npz": corrupted_archive,
}


def damaged_files(sample: Sample, folder: Path) -> Iterator[Path]:
    for path in sorted(folder.rglob(sample.files or "*")):
        if path.is_file() and path.suffix not in PICTURES and path.stat().st_size:
            yield path


@pytest.mark.parametrize("name", SAMPLES)
def test_damaged_files_are_refused_or_sound(name, tmp_path):
    sample, rng, refused, times = SAMPLES[name], np.random.default_rng(7), 0, 150
    sample.write(tmp_path)
    sample.read(tmp_path)
    files = list(damaged_files(sample, tmp_path))
    for _ in range(times):
        path = files[int(rng.integers(len(files)))]
        whole = path.read_bytes()
        damage = corrupted_text if name == "points, ascii" else DAMAGE.get(path.suffix, corrupted_binary)
        path.write_bytes(damage(whole, rng))
        refused += assert_refused_or_sound(lambda: sample.read(tmp_path), tmp_path)
        path.write_bytes(whole)
    assert refused >= sample.least * times, f"{refused} of {times}"
