"""Who imports whom, which parts may use heavy libraries, and how long a file may be: read from the source itself."""

import ast
import subprocess
import sys
from collections.abc import Iterator, Sequence
from functools import cache
from pathlib import Path
from typing import NamedTuple

import nerfcli

ROOT = Path(nerfcli.__file__).parent
FILES = sorted(ROOT.rglob("*.py"))
FOLDERS = sorted(path.parent for path in ROOT.glob("*/__init__.py"))

# A part is a folder of nerfcli, a subfolder of `poses`, or a module beside the folders.
# The part on the left may import those on the right, which all stand above it.
ROOTS = {
    *("errors", "atomic", "interrupts", "child", "distributed", "machine", "notices"),
    *("output", "ply", "__init__"),
}
MAY_IMPORT: dict[str, set[str]] = {
    **{root: set() for root in ROOTS},
    "cameras": set(),
    "pages": set(),
    "kernels": set(),
    "photos": {"cameras"},
    "field": {"kernels"},
    "matching": {"photos", "cameras"},
    "render": {"field", "kernels", "photos", "cameras"},
    "captures": {"matching", "photos", "cameras"},
    "export": {"render", "photos", "cameras"},
    "training": {"captures", "matching", "render", "field", "kernels", "photos", "cameras"},
    "evaluate": {"training", "captures", "matching", "render", "field", "photos", "cameras", "pages"},
    "bench": {"evaluate", "training", "captures", "render", "photos", "pages"},
    "splats": {"export", "render", "field", "kernels", "photos", "cameras", "pages"},
    "viewer": {"render", "field", "kernels", "photos", "cameras", "pages"},
    "poses.input": {"captures", "photos"},
    "poses.model": {"poses.input", "captures", "matching", "photos", "cameras"},
    "poses.judge": {"poses.model", "poses.input", "matching"},
    "poses.engine": {"poses.judge", "poses.model", "poses.input", "matching", "photos", "kernels"},
    "poses": {"poses.engine", "poses.judge", "poses.model", "poses.input", "captures", "photos"},
    "doctor": {
        *("poses.engine", "poses.judge", "poses.model", "poses.input", "captures", "matching", "photos", "cameras"),
        "pages",
    },
    "ct": {"captures", "render", "kernels", "photos", "pages"},
    "workflows": {
        *("bench", "viewer", "splats", "evaluate", "training", "export", "render", "field", "poses"),
        *("poses.input", "captures", "photos", "cameras", "pages"),
    },
}
# Libraries that are heavy, or whose use must stay confined, and the parts that may use them.
CONFINED = {
    "torch": {
        *("kernels", "field", "render", "training", "evaluate", "bench", "export", "splats", "viewer", "ct"),
        *("workflows", "cli", "machine", "distributed"),
    },
    # What differs between systems.
    "resource": {"machine"},
    "psutil": {"machine"},
    "filelock": {"atomic"},
    "fcntl": set(),
    "msvcrt": set(),
    "safetensors": {"field"},
    "numba": {"kernels"},
    "triton": {"kernels"},
    "pycolmap": {"poses", "poses.engine", "poses.judge", "poses.model", "cameras", "captures", "export"},
    "typer": {"cli"},
    "rich": {"cli"},
    "matplotlib": {"photos", "pages"},
}
# The command line starts in a fraction of a second because these are imported inside the commands that need them.
NOT_AT_START = (
    "torch",
    "numpy",
    "numba",
    "triton",
    "scipy",
    "h5py",
    "cv2",
    "pycolmap",
    "skimage",
    "PIL",
    "imageio_ffmpeg",
    "rich",
    "matplotlib",
    "psutil",
    "filelock",
)
MOST_LINES = 400
MOST_FOLDERS = 19


def part_named(names: Sequence[str]) -> str:
    """Return the part of the program that contains the module with these components of its dotted name."""
    room = ".".join(names[:2])
    return room if room in MAY_IMPORT else names[0]


def part_of(path: Path) -> str:
    """Return the part of the program that a file belongs to."""
    return part_named(path.relative_to(ROOT).with_suffix("").parts)


class Source(NamedTuple):
    """The contents of a file that the tests look at."""

    imports: list[ast.Import | ast.ImportFrom]
    calls: list[tuple[int, str]]
    constants: set[str]
    docstring: str | None


@cache
def source(path: Path) -> Source:
    """Parse a file once for all tests; its tree is not kept."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    found = Source([], [], set(), ast.get_docstring(tree))
    for node in ast.walk(tree):
        if isinstance(node, ast.Import | ast.ImportFrom):
            found.imports.append(node)
        elif isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
            found.calls.append((node.lineno, node.func.id))
        elif isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
            if isinstance(node.func.value, ast.Name):
                found.calls.append((node.lineno, f"{node.func.value.id}.{node.func.attr}"))
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            found.constants.add(node.value)
    return found


def imported(path: Path) -> Iterator[tuple[int, str]]:
    """Yield line and full dotted name of everything that a file imports, inside functions too."""
    for node in source(path).imports:
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name) for alias in node.names)
        else:
            assert node.level == 0, f"{path}:{node.lineno}: relative imports hide who imports whom"
            yield from ((node.lineno, f"{node.module}.{alias.name}") for alias in node.names)


def imported_parts(path: Path) -> Iterator[tuple[int, str]]:
    """Yield line and part of each import from nerfcli; "from nerfcli import x" means part x, or the version."""
    for line, name in imported(path):
        library, *rest = name.split(".")
        if library == "nerfcli":
            yield line, part_named(rest) if rest and rest[0] in {*MAY_IMPORT, "cli"} else "__init__"


def test_there_is_something_to_check():
    assert len(FILES) > 30
    assert {part_of(path) for path in FILES} >= {"cli", "training", "render", "field", "kernels", "captures", "cameras"}


def test_imports_point_down():
    wrong = []
    for path in FILES:
        if path == ROOT / "__init__.py":
            continue  # the public interface, whose imports are lazy: see test_package.py
        part = part_of(path)
        allowed = {*MAY_IMPORT, "cli"} if part in ("cli", "__main__") else MAY_IMPORT[part] | ROOTS | {part}
        wrong += [
            f"{path}:{line}: {part} imports {other}" for line, other in imported_parts(path) if other not in allowed
        ]
    assert not wrong


def test_the_rules_have_no_circle():
    assert len(FOLDERS) <= MOST_FOLDERS
    seen: set[str] = set()
    while left := set(MAY_IMPORT) - seen:
        ready = {part for part in left if MAY_IMPORT[part] <= seen}
        assert ready, f"{left} import each other"
        seen |= ready


def test_no_files_import_each_other_in_a_circle():
    files = {path.relative_to(ROOT.parent).with_suffix("").parts: path for path in FILES}
    waiting = {}
    for parts, path in files.items():
        names = [tuple(name.split(".")) for _, name in imported(path) if name.startswith("nerfcli.")]
        # "from a import b" means the file a/b.py if there is one, else a.py.
        waiting[parts] = {name if name in files else name[:-1] for name in names} & set(files)
    while ready := {parts for parts, needed in waiting.items() if not needed & set(waiting)}:
        waiting = {parts: needed for parts, needed in waiting.items() if parts not in ready}
    assert not waiting


def test_heavy_libraries_stay_where_they_belong():
    wrong = []
    for path in FILES:
        part = part_of(path)
        libraries = [(line, name.split(".")[0]) for line, name in imported(path)]
        wrong += [f"{path}:{line}: {name}" for line, name in libraries if part not in CONFINED.get(name, {part})]
    assert not wrong


def test_the_command_line_starts_without_heavy_libraries():
    # In a process of its own, which imports what `nerfcli --help` imports.
    code = "import sys; import nerfcli.cli; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert not set(NOT_AT_START) & set(loaded)


def test_only_the_command_line_prints_and_exits():
    calls = [(path, *call) for path in FILES if part_of(path) != "cli" for call in source(path).calls]
    ends = ("print", "exit", "quit", "sys.exit")
    assert not [f"{path}:{line}: {name}" for path, line, name in calls if name in ends]


def test_the_files_of_a_run_have_one_reader_each():
    """Other code reads these files through `training.runs`, and the cameras of a run through their format."""
    files = {"config.json", "log.jsonl", "field.safetensors", "state.safetensors", "metrics.json"}
    readers = {ROOT / "training/runs/files.py", ROOT / "captures/formats/run_cameras.py", ROOT / "ct/result.py"}
    found = {path: files & source(path).constants for path in FILES if path not in readers}
    assert not {path: names for path, names in found.items() if names}


def test_a_folder_holds_several_ideas():
    for folder in FOLDERS:
        assert len([path for path in folder.glob("*.py") if path.name != "__init__.py"]) >= 2, folder


def test_a_file_holds_one_idea_and_says_which():
    for path in FILES:
        text = path.read_text(encoding="utf-8")
        assert len(text.splitlines()) <= MOST_LINES, path
        assert path.stem not in ("utils", "util", "helpers", "misc", "common"), path
        assert not text.strip() or source(path).docstring, f"{path}: a module says in its docstring what it is for"
