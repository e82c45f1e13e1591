"""The installed package apart from its commands: the Python interface, the licence and shell completion."""

import ast
import hashlib
import inspect
import os
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from commands import estimated_poses, in_python

import nerfcli
from nerfcli.poses import structure_from_motion

ROOT = Path(nerfcli.__file__).parent
PROJECT = ROOT.parent


# zlib before pycolmap


def test_compression_works_after_pycolmap():
    # Without nerfcli's import of zlib this ends by SIGABRT (free(): invalid pointer), with pycolmap 4.2.1.
    result = in_python(
        "import nerfcli, pycolmap, zlib; "
        "text = bytes(range(256)) * 400; assert zlib.decompress(zlib.compress(text)) == text; print('the same')"
    )
    assert (result.returncode, result.stdout) == (0, "the same\n"), result.stderr[:200]


def test_zlib_comes_first_for_every_module_that_imports_pycolmap():
    """A package's __init__ runs before any of its modules, so nothing can come before an import there."""
    first = next(node for node in ast.parse((ROOT / "__init__.py").read_text("utf-8")).body[1:])
    assert isinstance(first, ast.Import)
    assert [alias.name for alias in first.names] == ["zlib"]
    users = [path for path in ROOT.rglob("*.py") if "import pycolmap" in path.read_text("utf-8")]
    assert len(users) > 10
    for path in users:  # parts of the package: none of them is a program that could be started without it
        assert all((folder / "__init__.py").exists() for folder in path.parents if folder.is_relative_to(ROOT))


# Licence


def test_the_licence_is_apache_2_and_the_metadata_says_so():
    project = tomllib.loads((PROJECT / "pyproject.toml").read_text("utf-8"))["project"]
    assert (project["license"], project["license-files"]) == ("Apache-2.0", ["LICENSE"])
    words = " ".join((PROJECT / "LICENSE").read_text("utf-8").split())
    # The hash of https://www.apache.org/licenses/LICENSE-2.0.txt with white space normalised.
    assert (
        hashlib.sha256(words.encode()).hexdigest() == "0ffddef9e48f8a09aed5caf2d44f7ba1c1be2d9b8e0a6f693b1635b2d5566645"
    )


# Completion


def completed(words: str, *, shell: str = "bash") -> list[str]:
    """Return the completions that the shell offers at the end of a line."""
    environment = {**os.environ, "_NERFCLI_COMPLETE": f"complete_{shell}", "COMP_WORDS": words}
    environment |= {"COMP_CWORD": str(len(words.split(" ")) - 1), "_TYPER_COMPLETE_ARGS": words}
    command = [sys.executable, "-m", "nerfcli"]
    return subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout.split()


def test_the_shell_completes_commands_and_options():
    assert completed("nerfcli ev") == ["evaluate"]
    assert completed("nerfcli train --field") == ["--field", "--field-memory"]


@pytest.mark.parametrize("option", ["--show-completion", "--install-completion"])
def test_completion_is_shown_and_installed_for_the_shell_that_asks(option, tmp_path):
    # The shell is recognised as the parent process; `; exit $?` keeps bash from replacing itself with the command.
    line = f"{sys.executable} -m nerfcli {option}; exit $?"
    result = subprocess.run(
        ["bash", "-c", line], env={**os.environ, "HOME": str(tmp_path)}, capture_output=True, text=True
    )
    assert result.returncode == 0, result.stderr
    if option == "--show-completion":
        script = result.stdout
        assert not list(tmp_path.iterdir())
    else:
        script = (tmp_path / ".bash_completions" / "nerfcli.sh").read_text()
        assert "nerfcli.sh" in (tmp_path / ".bashrc").read_text()
    assert "_NERFCLI_COMPLETE=complete_bash" in script
    assert script.rstrip().splitlines()[-1].endswith(" nerfcli")  # complete ... nerfcli


# The front door


@pytest.mark.parametrize("name", [name for name in nerfcli.__all__ if name.islower()])
def test_a_public_function_says_how_it_is_called(name):
    function = getattr(nerfcli, name)
    text = inspect.getdoc(function) or ""
    example = "\n".join(line.strip()[4:] for line in text.splitlines() if line.strip().startswith(">>> "))
    calls = [node for node in ast.walk(ast.parse(example)) if isinstance(node, ast.Call)]
    (call,) = [call for call in calls if ast.unparse(call.func) == f"nerfcli.{name}"]
    keywords = {keyword.arg: None for keyword in call.keywords if keyword.arg}
    inspect.signature(function).bind(*call.args, **keywords)
    parameters = inspect.signature(function).parameters
    assert all(re.search(rf"^    .*\b{parameter}\b.*: ", text, re.M) for parameter in parameters)
    assert "Raises:" in text


def test_the_package_has_nothing_else():
    assert set(nerfcli.__all__) <= set(dir(nerfcli))
    with pytest.raises(AttributeError, match="has no attribute 'train_scenes'"):
        _ = nerfcli.train_scenes


def python_blocks(guide: Path) -> list[str]:
    return re.findall(r"^```python\n(.*?)^```", guide.read_text("utf-8"), re.M | re.S)


def test_the_examples_of_the_readme_and_the_guides_run(capture, tmp_path, monkeypatch, capsys):
    """They run with a smaller budget. Structure from motion has its own tests: here it returns the known poses."""

    def known_poses(folder: Path, scene: Path, **settings: Any) -> SimpleNamespace:
        shutil.copytree(capture, scene)
        return estimated_poses()

    monkeypatch.setattr(structure_from_motion, "estimate_poses", known_poses)
    monkeypatch.chdir(tmp_path)
    (code,) = python_blocks(PROJECT / "README.md")
    quick = code.replace("budget_seconds=120", "budget_seconds=None, steps=2, downscale=8")
    assert quick != code
    exec(compile(quick, "README.md", "exec"), {})
    said = capsys.readouterr().out.splitlines()
    assert said[0] == "photos-scene: 5 of 5 photos registered in 1 s, mean reprojection error 0.50 px"
    assert re.fullmatch(r"2 steps, \d+\.\d\d dB on held-out photos", said[1])
    assert "photos-scene-run/renders/test-conditional-z/depth" in said[2]
    assert (tmp_path / "photos-scene-run" / "renders" / "test-conditional-z" / "depth").is_dir()

    # The guides continue with these folders.
    for guide, names in (("python-api.md", 5), ("depth.md", 1)):
        blocks = python_blocks(PROJECT / "docs" / guide)
        assert len(blocks) == names
        exec(compile("\n".join(blocks), guide, "exec"), {})
    said = capsys.readouterr().out
    assert "no-such-run" in said
    assert "conditional z arbitrary" in said
