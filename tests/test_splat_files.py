"""Splats as .ply and .spz: bytes by hand and of the reference implementation, rounding, foreign and damaged files."""

import base64
import gzip
import struct
import tracemalloc

import numpy as np
import pytest
from examples import examples
from hypothesis import example, given
from hypothesis import strategies as st
from scipy.special import expit
from test_gaussians import some_gaussians

from nerfcli.errors import UserError
from nerfcli.splats import files as ply_file
from nerfcli.splats import spz as spz_file
from nerfcli.splats.files import read_splats, write_splats
from nerfcli.splats.gaussians import Gaussians
from nerfcli.splats.spz import packed, unpacked

NAMES = [
    *("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", *(f"f_rest_{i}" for i in range(9))),
    *("opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
]
ONE = Gaussians(
    np.array([[1.5, -2.0, 3.0]]),
    np.array([[-1.0, -2.0, -3.0]]),
    np.array([[2.0, 0.0, 0.0, 0.0]]),
    np.array([0.5]),
    np.arange(12).reshape(1, 4, 3) / 16,
)
# What @adobe/spz 0.2.2 (the code of nianticlabs/spz as WebAssembly) writes for `waves()`, before gzip.
OFFICIAL_2 = base64.b64decode(
    "TkdTUAIAAAACAAAAAwwAABzxKqbtr8KilcdCdjzZjWloofPxm5GFn6KgcWZaT0ZBykhipzYfmMDg8PDoMFiAUDAg8PDgwJBwwODwECAwoIBQ0P"
    "DwECBAcKDAIBAQ4NCggLDQKEhwmMDgEBAY0KCAsNDw8PDgQHCgQCAQ8ODQYICwMBAQECBQkGBA4PDwIDBg"
)
OFFICIAL_3 = base64.b64decode(
    "TkdTUAMAAAACAAAAAwwAABzxKqbtr8KilcdCdjzZjWloofPxm5GFn6KgcWZaT0ZBp+5M2gR6Bq6YwODw8OgwWIBQMCDw8ODAkHDA4PAQIDCggF"
    "DQ8PAQIEBwoMAgEBDg0KCAsNAoSHCYwOAQEBjQoICw0PDw8OBAcKBAIBDw4NBggLAwEBAQIFCQYEDg8PAgMGA="
)


@pytest.fixture(autouse=True)
def _few_rows_at_a_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ply_file, "_ROWS", 7)
    monkeypatch.setattr(spz_file, "_ROWS", 7)


def waves() -> Gaussians:
    parts = np.split(np.sin(0.37 * np.arange(1, 119)), [6, 12, 20, 22])
    means, scales, quaternions, logits, harmonics = (part.reshape(2, -1) for part in parts)
    return Gaussians(1900 * means, 2 * scales - 4, quaternions, 3 * logits[:, 0], 0.9 * harmonics.reshape(2, 16, 3))


def silent(text: str) -> None:
    raise AssertionError(text)


def ply(*lines: str, body: bytes = b"", form: str = "binary_little_endian") -> bytes:
    return "\n".join(["ply", f"format {form} 1.0", *lines, "end_header", ""]).encode() + body


def floats(names: list[str]) -> list[str]:
    return [f"property float {name}" for name in names]


def test_bytes_of_one_gaussian_as_ply(tmp_path):
    path = tmp_path / "a.ply"
    write_splats(path, ONE, description={"unit": "metre", "frame": "y down"}, notify=silent)
    head, body = path.read_bytes().split(b"end_header\n")
    assert [line for line in head.decode().splitlines() if line.startswith("property")] == floats(NAMES)
    assert b"comment frame y down\n" in head
    rest = [k * 3 / 16 + channel / 16 for channel in range(3) for k in (1, 2, 3)]
    expected = [1.5, -2, 3, 0, 0, 0, 0, 1 / 16, 2 / 16, *rest, 0.5, -1, -2, -3, 1, 0, 0, 0]
    assert struct.unpack("<26f", body) == tuple(expected)


@examples(30)
@given(st.integers(0, 3), st.integers(0, 2**31), st.sampled_from([1e-10, 1e-3, 1.0, 1e4, 1e10]))
@example(3, 0, 1e10)
def test_ply_keeps_all_but_the_norm_of_quaternions(tmp_path_factory, degree, seed, size):
    path = tmp_path_factory.getbasetemp() / "kept.ply"
    drawn = some_gaussians(seed, degree)
    drawn = Gaussians(*(np.float32(size) * values for values in drawn))
    write_splats(path, drawn, description=None, notify=silent)
    back, _ = read_splats(path, silent)
    norms = np.linalg.norm(drawn.quaternions.astype(np.float64), axis=1, keepdims=True)
    np.testing.assert_allclose(back.quaternions, drawn.quaternions / norms, rtol=2e-7)
    for name in ("means", "log_scales", "logits", "harmonics"):
        np.testing.assert_array_equal(getattr(back, name), getattr(drawn, name))


def test_foreign_ply_in_any_order_with_more_in_it(tmp_path):
    """Reversed properties without normals, a float64, a colour in bytes, CRLF, and an element behind the splats."""
    names = [name for name in reversed(NAMES) if name[0] != "n"]
    kinds = {name: "double" if name == "x" else "float" for name in names}
    lines = ["comment by hand", "element vertex 3", "property uchar red", *(f"property {kinds[n]} {n}" for n in names)]
    lines += ["element camera 1", "property list uchar int ids"]
    rows = np.arange(1.0, 1 + 3 * len(names)).reshape(3, -1)
    rows[1, names.index("f_rest_4")] = np.nan
    rows[2, names.index("opacity")] = -np.inf
    codes = "".join("d" if name == "x" else "f" for name in names)
    body = b"".join(struct.pack(f"<B{codes}", 7, *row) for row in rows) + b"\1\0\0\0\0"
    path, told = tmp_path / "b.PLY", []
    path.write_bytes(ply(*lines).replace(b"\n", b"\r\n") + body)
    found, _ = read_splats(path, told.append)
    assert told == [f"{path}: 1 of 3 splats left out, whose numbers are not finite"]
    column = {name: rows[[0, 2], index] for index, name in enumerate(names)}
    np.testing.assert_array_equal(found.means, np.stack([column[name] for name in "xyz"], axis=1))
    np.testing.assert_array_equal(found.logits, [column["opacity"][0], -20])
    np.testing.assert_array_equal(found.harmonics[:, 2, 1], column["f_rest_4"])
    np.testing.assert_array_equal(found.quaternions[:, 3], column["rot_3"])


@pytest.mark.parametrize(("form", "order"), [("ascii", ""), ("binary_big_endian", ">")])
def test_other_encodings_of_ply(tmp_path, form, order):
    row = np.arange(1.0, 24.0)
    body = " ".join(map(str, row)).encode() + b"\n" if form == "ascii" else struct.pack(f"{order}23f", *row)
    (tmp_path / "a.ply").write_bytes(ply(*NEEDED, body=body, form=form))
    found = read_splats(tmp_path / "a.ply", silent)[0]
    column = dict(zip([name for name in NAMES if name[0] != "n"], row, strict=True))
    np.testing.assert_array_equal(found.means, [[column[name] for name in "xyz"]])
    np.testing.assert_array_equal(found.quaternions, [[column[f"rot_{index}"] for index in range(4)]])


def test_spz_of_the_reference_implementation(tmp_path):
    """Version 3 has the same bytes, but for harmonics with 7 bits instead of 5 and 4; version 2 the same Gaussians."""
    ours, kept = packed(waves())[0], len(OFFICIAL_3) - waves().harmonics[:, 1:].size
    assert ours[:kept] == OFFICIAL_3[:kept]
    rest = np.frombuffer(ours[kept:], np.uint8).astype(int) - np.frombuffer(OFFICIAL_3[kept:], np.uint8)
    assert 0 < np.abs(rest).max() <= 8
    (tmp_path / "a.spz").write_bytes(gzip.compress(OFFICIAL_2))
    second, third = read_splats(tmp_path / "a.spz", silent)[0], unpacked(OFFICIAL_3)
    for name in ("means", "log_scales", "logits", "harmonics"):
        np.testing.assert_array_equal(getattr(second, name), getattr(third, name))
    sign = np.sign((second.quaternions * third.quaternions).sum(axis=1, keepdims=True))
    np.testing.assert_allclose(sign * second.quaternions, third.quaternions, rtol=0, atol=2 / 127.5)


@examples(30)
@given(st.integers(0, 3), st.integers(0, 2**31), st.sampled_from([1e-8, 1e-3, 1.0, 1e3, 1e6]))
@example(3, 1, 1e6)
@example(0, 0, 1e-8)
def test_spz_rounds_within_its_steps(degree, seed, size):
    drawn = some_gaussians(seed, degree)
    harmonics = np.clip(drawn.harmonics, -0.95, 0.95)
    drawn = Gaussians(size * drawn.means, drawn.log_scales, drawn.quaternions, drawn.logits, harmonics)
    data, note = packed(drawn)
    assert "clipped" not in note
    back, bits = unpacked(data), data[13]
    fills_24_bits = np.abs(drawn.means).max() * 2.0**bits >= 2**22 - 1
    small = np.exp(np.quantile(np.median(drawn.log_scales, axis=1), 0.01))
    assert fills_24_bits or 16 * 2.0**-bits <= small
    assert ("far away" in note) == (2.0**-bits > small)
    unit = drawn.quaternions / np.linalg.norm(drawn.quaternions, axis=1, keepdims=True)
    sign = np.sign((back.quaternions * unit).sum(axis=1, keepdims=True))
    for found, exact, step in (
        (back.means, drawn.means, 2.0**-bits + 1e-7 * np.abs(drawn.means)),
        (back.log_scales, drawn.log_scales, 1 / 16),
        (expit(back.logits), expit(drawn.logits), 1 / 255),
        (back.harmonics[:, 0], harmonics[:, 0], 1 / 255 / 0.15),
        (back.harmonics[:, 1:], harmonics[:, 1:], 3 / 128),  # rounded twice: to 1 / 128, then to 2 of it
        (sign * back.quaternions, unit, 3 * 0.5**0.5 / 511),  # the largest part is off by up to three times the others
    ):
        assert (np.abs(found - exact) <= step * 0.501).all()


def test_spz_says_what_it_clips(tmp_path):
    drawn, told = some_gaussians(0, 1), []
    means, harmonics = 0 * drawn.means, 0.1 * drawn.harmonics
    means[3], harmonics[:2, 2], harmonics[5, 0] = 1e8, 1.1, -3.4
    drawn = Gaussians(means, np.where(drawn.means > 1, -11, -9), drawn.quaternions, drawn.logits, harmonics)
    write_splats(tmp_path / "a.spz", drawn, description=None, notify=told.append)
    small = (drawn.log_scales < -10).any(axis=1).sum()
    counts = f"positions of 1, harmonics of 2, colours of 1, sizes of {small} of 20 splats; a .ply keeps all"
    assert told == [f"{tmp_path / 'a.spz'}: clipped to the ranges of .spz: {counts}"]


def spz(at: int, *values: int, more: bytes = b"") -> bytes:
    """A file with one Gaussian, with some bytes of its header replaced, and more behind it."""
    data = packed(ONE)[0]
    return gzip.compress(data[:at] + bytes(values) + data[at + len(values) :] + more)


def test_flags_and_extensions_of_spz(tmp_path):
    told = []
    (tmp_path / "a.spz").write_bytes(spz(14, 3, more=struct.pack("<6I", 7, 4, 0, 0xADBE0003, 4, 4)))
    np.testing.assert_array_equal(read_splats(tmp_path / "a.spz", told.append)[0].means, ONE.means)
    assert [text.count("made for antialiased rendering") for text in told] == [1]


NEEDED = ["element vertex 1", *floats([name for name in NAMES if name[0] != "n"])]
CHUNKS = ["element chunk 1", "property float min_x", "element vertex 1", "property uint packed_position"]
FACES = ["element vertex 1", *floats(["x", "y", "z"]), "element face 1", "property list uchar int vertex_indices"]
REFUSED = {
    "points.ply": (
        ply("element vertex 1", *floats(["x", "y", "z"]), body=bytes(12)),
        "holds points, not splats: f_dc_0",
    ),
    "mesh.ply": (ply(*FACES, body=bytes(25)), "holds a mesh, not splats"),
    "compressed.ply": (ply(*CHUNKS), "is a compressed .ply of PlayCanvas"),
    "text.ply": (ply(*NEEDED, form="ascii", body=b"1 2 3\n"), "a vertex has fewer than 23 numbers"),
    "short.ply": (ply(*NEEDED, body=bytes(91)), "is truncated: its header announces 1 vertices, but 91 bytes"),
    "enormous.ply": (ply(f"element vertex {10**15}", *NEEDED[1:], body=bytes(100)), "is truncated"),
    "empty.ply": (ply("element vertex 0", *NEEDED[1:]), "contains no splats"),
    "degree.ply": (ply(*NEEDED, *floats(["f_rest_9"]), body=bytes(96)), "has 10 properties f_rest_"),
    "lists.ply": (ply(*NEEDED, "property list uchar int ids"), "its vertices contain lists"),
    "twice.ply": (ply(*NEEDED, "property float x"), "its header has the line 'property float x'"),
    "zeros.ply": (ply(*NEEDED, body=bytes(92)), "none of its 1 splat"),
    "other.ply": (b"solid cube", "is not a PLY file"),
    "splats.sog": (b"", "is not a supported file of splats"),
    "old.spz": (spz(4, 1), "degree 0 to 3: version 1"),
    "new.spz": (b"NGSP" + struct.pack("<I", 4) + bytes(24), "is a .spz of version 4 or later"),
    "degree.spz": (spz(12, 4), "of degree 4"),
    "empty.spz": (spz(8, 0), "0 splats"),
    "bomb.spz": (gzip.compress(OFFICIAL_3[:8] + b"\xff\xff\xff\xff" + bytes(2**22)), "4294967295 splats cannot be in"),
    "longer.spz": (spz(0, more=bytes(2**21)), "it has a MB more"),
    "short.spz": (spz(8, 2), "2 splats take"),
    "cut.spz": (spz(0)[:-20], "damaged.*: Compressed file ended"),
    "checksum.spz": (spz(0)[:-8] + bytes(8), "damaged.*: CRC check failed"),
    "axes.spz": (spz(14, 2, more=struct.pack("<7I", 7, 8, 0, 0, 0xADBE0003, 4, 6)), "axes are those with the number 6"),
    "text.spz": (b"splats", "damaged.*: Not a gzipped file"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_other_files_are_refused_in_two_lines_without_memory(tmp_path, name):
    data, message = REFUSED[name]
    (tmp_path / name).write_bytes(data)
    tracemalloc.start()
    with pytest.raises(UserError, match=f"{name}.*{message}") as caught:
        read_splats(tmp_path / name, silent)
    assert tracemalloc.get_traced_memory()[1] < 2**23
    tracemalloc.stop()
    assert "\n" not in caught.value.message + caught.value.hint


def test_missing_files_and_other_suffixes(tmp_path):
    with pytest.raises(UserError, match="does not exist"):
        read_splats(tmp_path / "b.ply", silent)
    with pytest.raises(UserError, match="is not a supported file of splats"):
        write_splats(tmp_path / "a.splat", ONE, description=None, notify=silent)
