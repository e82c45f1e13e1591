"""`nerfcli poses` as a user meets it: its options, the plan, and what is refused."""

import json
from pathlib import Path

import pytest
import typer
from commands import error_of, nerfcli
from test_cli import USAGE, write_photos

from nerfcli.cli.options import bytes_from_text
from nerfcli.errors import BAD_INPUT, UserError
from nerfcli.poses import structure_from_motion
from nerfcli.poses.input.settings import QUALITIES, PoseSettings


@pytest.mark.parametrize(
    ("text", "size"),
    [("4GB", 4_000_000_000), ("500 MB", 500_000_000), ("1.5GiB", 3 * 2**29), ("2g", 2_000_000_000), ("1024", 1024)],
)
def test_amounts_of_memory(text: str, size: int):
    assert bytes_from_text(text) == size


@pytest.mark.parametrize("text", ["", "much", "-4GB", "0", "4", "4 GB RAM", "0.2", "4xb"])
def test_what_is_no_amount_of_memory(text: str):
    with pytest.raises(typer.BadParameter, match="is not an amount of memory; write 4GB or 500MB"):
        bytes_from_text(text)


@pytest.mark.parametrize(
    ("options", "size", "features"),
    [((), 1600, 8192), (("--quality", "fast"), 1000, 2048), (("--quality", "best", "--max-size", "2000"), 2000, 8192)],
)
def test_a_dry_run_prints_its_plan_and_no_file(tmp_path: Path, options: tuple[str, ...], size: int, features: int):
    photos = write_photos(tmp_path / "photos", 5)
    result = nerfcli("poses", photos, "--dry-run", "--json", *options)
    plan = json.loads(result.stdout)
    assert plan["path"] == str(photos)
    assert (plan["photos"], plan["rule"], plan["pairs"]) == (5, "retrieval", 10)
    assert (plan["max_image_size"], plan["max_features"]) == (size, features)
    assert set(plan["seconds"]) == {"extract", "pair", "match", "map", "check", "stabilise"}
    assert [path.name for path in tmp_path.iterdir()] == ["photos"]


def test_the_plan_can_be_read_and_names_the_files_that_are_skipped(tmp_path: Path):
    photos = write_photos(tmp_path / "photos", 5)
    (photos / "IMG_1.cr3").write_bytes(b"raw")
    result = nerfcli("poses", photos, "--dry-run")
    assert "IMG_1.cr3 is skipped: a raw file" in result.stderr
    assert result.stdout.startswith(f"{photos}: 5 photos, 10 pairs to match (retrieval), about ")
    assert result.stdout.endswith("; 0.5 GB of memory\n")


@pytest.mark.parametrize("command", ["poses", "run"])
def test_options_go_to_the_settings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: str):
    given: list[PoseSettings] = []

    def estimate(folder: Path, scene: Path, *, settings: PoseSettings, **more: object) -> None:
        given.append(settings)
        raise UserError("enough", "that was all")

    monkeypatch.setattr(structure_from_motion, "estimate_poses", estimate)
    photos = write_photos(tmp_path / "photos", 5)
    for quality in ("fast", "best"):
        assert nerfcli(command, photos, "--quality", quality).exit_code == BAD_INPUT
    assert [(each.max_image_size, each.max_features) for each in given] == [QUALITIES["fast"], QUALITIES["best"]]
    if command == "poses":
        assert nerfcli(command, photos, "--masks", "masks").exit_code == BAD_INPUT
        assert given[-1].masks == str(Path("masks").resolve())
    assert nerfcli(command, photos, "--quality", "superb").exit_code == USAGE


def test_pairs_of_unknown_photos_are_bad_input(tmp_path: Path):
    photos = write_photos(tmp_path / "photos", 5)
    (tmp_path / "pairs.txt").write_text("photo 0.jpg photo 1.jpg\nphoto 0.jpg photo 9.jpg\n")
    result = nerfcli("poses", photos, "--pairs", tmp_path / "pairs.txt")
    assert result.exit_code == BAD_INPUT
    error, hint = error_of(result)
    assert "pairs.txt, line 2: there is no photo 'photo 9.jpg'" in error
    assert str(photos) in hint
    assert not (tmp_path / "photos-scene").exists()
