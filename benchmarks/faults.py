"""Effects of damaged files: random corruptions of scene, run and image files.

    python benchmarks/faults.py corruptions --count 500 -o corruptions.csv
    python benchmarks/faults.py corruptions --first 16 --count 1      repeat a single case

Each case damages one file of a small capture or of its run, and runs one command on it in a child process. Verdicts:
`refused` (exit codes 3, 4 or 5, one error), `same` (the result is that of the intact files), `other input` (a file
without a checksum, such as a JPEG or a COLMAP model, reads as another picture or number, and the result is that of this
input); bad ones: `traceback`, `crash`, `hang`, `wrong`, and `lost` if a file of the user has changed. Bad cases are
repeated in a fresh process, and their captures are kept beside the CSV.
"""

import csv
import faulthandler
import hashlib
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from PIL import Image

SPHERES = Path(__file__).parent.parent / "sample_scenes" / "spheres"
TRAIN = ("--steps", "6", "--threads", "1", "--quiet")
RENDER = ("--cameras", "test", "--max-size", "24", "--threads", "1", "--quiet", "--depth-format", "npy")
SECONDS_PER_CASE = 300
BAD = ("traceback", "crash", "hang", "wrong", "lost")
# Files of a run in which damage must be noticed. Any other file, by other programs or without a checksum, may read as
# different but valid input.
OURS = ("field.safetensors", "state.safetensors", "config.json", "cameras.json")

app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)


@dataclass(frozen=True)
class Case:
    """One case of damage and its outcome."""

    number: int
    file: str
    damage: str
    command: str
    exit_code: int
    verdict: str
    again: str
    text: str


def nerfcli(*arguments: object, timeout: float | None = None) -> subprocess.CompletedProcess[str]:
    """Run a nerfcli command in a separate process."""
    command = [sys.executable, "-m", "nerfcli", *map(str, arguments)]
    environment = {**os.environ, "GOMP_SPINCOUNT": "1000"}
    return subprocess.run(command, capture_output=True, text=True, check=False, env=environment, timeout=timeout)


def make_capture(place: Path) -> None:
    """Write `place`/photos with 8 JPEGs, `place`/blender, `place`/scene (scene.json, COLMAP model), and `place`/run."""
    blender, photos = place / "blender", place / "photos"
    photos.mkdir(parents=True)
    listed = json.loads((SPHERES / "transforms_train.json").read_text())
    held = json.loads((SPHERES / "transforms_test.json").read_text())
    for name, content, count in (("train", listed, 6), ("test", held, 2)):
        content["frames"] = content["frames"][:count]
        (blender / name).mkdir(parents=True)
        (blender / f"transforms_{name}.json").write_text(json.dumps(content, indent=1))
        for index in range(count):
            shutil.copy(SPHERES / name / f"r_{index:03d}.png", blender / name)
    frames = []
    for frame in listed["frames"] + held["frames"]:
        source = (SPHERES / frame["file_path"]).with_suffix(".png")
        picture = Image.open(source).convert("RGBA")
        on_white = Image.alpha_composite(Image.new("RGBA", picture.size, "white"), picture).convert("RGB")
        name = f"{frame['file_path'].strip('./').replace('/', '_')}.jpg"
        on_white.save(photos / name, quality=95)
        frames.append({"file_path": f"photos/{name}", "transform_matrix": frame["transform_matrix"]})
    width, height = Image.open(photos / name).size
    focal = width / 2 / np.tan(listed["camera_angle_x"] / 2)
    camera = {"w": width, "h": height, "fl_x": focal, "fl_y": focal, "cx": width / 2, "cy": height / 2}
    (place / "transforms.json").write_text(json.dumps({**camera, "frames": frames}, indent=1))
    for arguments in (
        ("convert", place / "transforms.json", place / "scene", "--to", "nerfcli"),
        ("train", place / "scene", "-o", place / "run", *TRAIN),
        ("evaluate", place / "run", "--threads", "1", "--quiet"),
    ):
        done = nerfcli(*arguments)
        if done.returncode != 0:
            raise SystemExit(f"{arguments}: {done.stderr}")


def damaged(data: bytes, others: list[bytes], draw: random.Random) -> tuple[str, bytes | None]:
    """Return a random kind of damage and the damaged content; None if the file is to be deleted."""
    kind = draw.choice(("bit", "bits", "cut", "zeros", "noise", "empty", "deleted", "swapped"))
    if kind == "deleted":
        return kind, None
    if kind == "empty":
        return kind, b""
    if kind == "swapped":
        return kind, draw.choice(others)
    if kind == "cut":
        return kind, data[: draw.randrange(len(data))]
    content = bytearray(data)
    # Half of the damage is done at the beginning, where most files have their structure.
    at = draw.randrange(min(200, len(content))) if draw.random() < 0.5 else draw.randrange(len(content))
    if kind in ("bit", "bits"):
        for place in [at, *(draw.randrange(len(content)) for _ in range(9))][: 1 if kind == "bit" else 10]:
            content[place] ^= 1 << draw.randrange(8)
        return kind, bytes(content)
    length = min(draw.choice((4, 64, 512)), len(content) - at)
    content[at : at + length] = bytes(length) if kind == "zeros" else draw.randbytes(length)
    return kind, bytes(content)


def digests(folder: Path) -> dict[str, str]:
    """Return the digest of every file below a folder, by relative path."""
    files = (path for path in sorted(folder.rglob("*")) if path.is_file())
    return {str(path.relative_to(folder)): hashlib.blake2b(path.read_bytes()).hexdigest() for path in files}


def commands_for(file: str, draw: random.Random) -> tuple[str, ...]:
    """Return a random command that reads a file of the capture, with arguments relative to the capture's folder."""
    if file.startswith("run/"):
        return draw.choice(
            (
                ("info", "run", "--json"),
                ("render", "run", "-o", "out", *RENDER),
                ("evaluate", "run", "--overwrite", "--threads", "1", "--quiet"),
                ("train", "scene", "-o", "run", "--resume", "--steps", "8", "--threads", "1", "--quiet"),
            )
        )
    if file.startswith("blender/"):
        return draw.choice((("info", "blender", "--json"), ("train", "blender", "-o", "out", *TRAIN)))
    if file.startswith("photos/") and draw.random() < 0.5:
        return draw.choice(
            (
                ("evaluate", "run", "--overwrite", "--threads", "1", "--quiet"),
                ("poses", "photos", "-o", "out", "--quality", "fast", "--threads", "1", "--quiet"),
            )
        )
    return draw.choice((("info", "scene", "--json"), ("train", "scene", "-o", "out", *TRAIN)))


def outcome(folder: Path, command: tuple[str, ...], text: str) -> str:
    """Return a hash of the results of a successful command, without times and paths."""
    from nerfcli.field.checkpoint import load_tensors
    from nerfcli.photos.images import read_image

    name, content = command[0], hashlib.blake2b()
    if name == "info":
        facts = json.loads(text)
        content.update(json.dumps({k: v for k, v in facts.items() if k not in ("path", "seconds")}).encode())
    elif name == "train":
        tensors, _ = load_tensors(folder / command[command.index("-o") + 1] / "field.safetensors", "cpu")
        for key in sorted(tensors):
            content.update(tensors[key].numpy().tobytes())
    elif name == "evaluate":
        metrics = json.loads((folder / "run" / "metrics.json").read_text())
        images = [{"name": image["name"], "psnr": image["psnr"]} for image in metrics["images"]]
        content.update(json.dumps([metrics["mean"]["psnr"], images]).encode())
    elif name == "render":
        for path in sorted((folder / "out").rglob("*")):
            if path.suffix == ".npy":
                content.update(np.load(path).tobytes())
            elif path.suffix == ".png" and "rgb" in path.parts:
                content.update(read_image(path).tobytes())
    else:
        content.update(
            json.dumps(json.loads((folder / "out" / "poses_report.json").read_text())["registered"]).encode()
        )
    return content.hexdigest()


@app.command(hidden=True)
def serve() -> None:
    """Run commands that come as lines of JSON on stdin; answer each with a line."""
    from typer.testing import CliRunner

    from nerfcli.cli import app as program

    faulthandler.enable()
    channel = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    for line in sys.stdin:
        request = json.loads(line)
        os.chdir(request["folder"])
        result = CliRunner().invoke(program, request["command"])
        raised = result.exception is not None and not isinstance(result.exception, SystemExit)
        folder = Path(request["folder"])
        said = ""
        if result.exit_code == 0:
            try:
                said = outcome(folder, tuple(request["command"]), result.stdout)
            except Exception as error:  # a result that cannot be read
                said = f"unreadable: {error!r}"
        text = f"{type(result.exception).__name__}: {result.exception}" if raised else result.stderr.strip()
        answer = {"code": result.exit_code, "raised": raised, "text": text[-400:], "outcome": said}
        channel.write(json.dumps(answer) + "\n")
        channel.flush()


class Child:
    """A child process that runs commands, and is restarted when one of them crashes or hangs."""

    def __init__(self, log: Path) -> None:
        self.log = log
        self.start()

    def start(self) -> None:
        command = [sys.executable, __file__, "serve"]
        environment = {**os.environ, "GOMP_SPINCOUNT": "1000"}
        with self.log.open("w") as log:
            self.process = subprocess.Popen(
                command, text=True, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=log
            )

    def ask(self, folder: Path, command: tuple[str, ...]) -> dict[str, Any]:
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self.process.stdin.write(json.dumps({"folder": str(folder), "command": command}) + "\n")
        self.process.stdin.flush()

        def give_up(signum: int, frame: object) -> None:
            raise TimeoutError

        signal.signal(signal.SIGALRM, give_up)
        signal.alarm(SECONDS_PER_CASE)
        try:
            line = self.process.stdout.readline()
        except TimeoutError:
            return self._again("hang")
        finally:
            signal.alarm(0)
        return json.loads(line) if line else self._again("crash")

    def _again(self, why: str) -> dict[str, Any]:
        if why == "crash":
            with suppress(subprocess.TimeoutExpired):  # let it end by itself, to see its own signal
                self.process.wait(30)
        self.process.kill()
        code = self.process.wait()
        said = self.log.read_text(errors="replace")[-2000:]
        self.start()
        return {"code": code, "raised": False, "text": f"exit status {code}\n{said}", "outcome": "", "verdict": why}

    def end(self) -> None:
        self.process.kill()
        self.process.wait()


def corruption_cases(numbers: range, seed: int, place: Path, keep: Path) -> Iterator[Case]:
    """Damage one file at a time, run one command, and judge the outcome."""
    whole, broken = place / "whole", place / "case"
    make_capture(whole)
    files = [path for path in sorted(digests(whole)) if not path.endswith((".lock", "poses_report.json"))]
    kinds = sorted({kind_of(file) for file in files})
    contents = [(whole / file).read_bytes() for file in files]
    child, expected = Child(place / "stderr"), dict[tuple[str, ...], str]()

    def fresh() -> None:
        shutil.rmtree(broken, ignore_errors=True)
        shutil.copytree(whole, broken)

    def tried(command: tuple[str, ...], file: str, content: bytes | None) -> tuple[str, dict[str, Any]]:
        fresh()
        if content is None:
            (broken / file).unlink()
        else:
            (broken / file).write_bytes(content)
        before = {name: digest for name, digest in digests(broken).items() if is_kept(name, command)}
        answer = child.ask(broken, command)
        after = digests(broken)
        if changed := [name for name, digest in before.items() if after.get(name) != digest]:
            return "lost", {**answer, "text": ", ".join(changed)}
        return verdict_of(answer, expected[command], file), answer

    for number in numbers:
        draw = random.Random(f"{seed} {number}")  # so that each case can be repeated alone
        kind = draw.choice(kinds)
        file = draw.choice([name for name in files if kind_of(name) == kind])
        command = commands_for(file, draw)
        if command not in expected:
            fresh()
            answer = child.ask(broken, command)
            expected[command] = answer["outcome"] or f"exit {answer['code']}"
            if answer["raised"] or expected[command].startswith("unreadable"):
                raise SystemExit(f"{command} on whole files: {answer}")
        damage, content = damaged((whole / file).read_bytes(), contents, draw)
        verdict, answer = tried(command, file, content)
        again = ""
        if verdict in BAD:
            child.end()
            child.start()
            again, _ = tried(command, file, content)
            kept = keep / f"seed-{seed}-case-{number}"
            shutil.rmtree(kept, ignore_errors=True)
            fresh()
            shutil.move(broken, kept)
            if content is None:
                (kept / file).unlink()
            else:
                (kept / file).write_bytes(content)
            (kept / "command.txt").write_text(" ".join(command) + f"\n# damaged: {file}\n")
        yield Case(number, file, damage, " ".join(command[:2]), answer["code"], verdict, again, answer["text"])
    child.end()


def kind_of(file: str) -> str:
    """Return the kind of a file. Each kind is damaged equally often, however many files it has."""
    return file.rsplit("/", 1)[0] + "/*" + Path(file).suffix if file.endswith((".jpg", ".png")) else file


def is_kept(name: str, command: tuple[str, ...]) -> bool:
    """Return whether a command must leave a file unchanged."""
    if name.startswith("run/"):
        return command[0] in ("info", "render") or (command[0] == "evaluate" and "metrics" not in name)
    return True


def verdict_of(answer: dict[str, Any], expected: str, file: str) -> str:
    """Return the verdict on an answer of the child process."""
    if "verdict" in answer:
        return answer["verdict"]
    if answer["raised"] or answer["code"] == 1:
        return "traceback"
    if answer["outcome"].startswith("unreadable"):
        return "wrong"
    if answer["code"] != 0:
        good = answer["code"] in (3, 4, 5) and answer["text"].count("Error:") == 1
        return "refused" if good else "same" if expected == f"exit {answer['code']}" else "wrong"
    if answer["outcome"] == expected:
        return "same"
    return "wrong" if file.startswith("run/") and Path(file).name in OURS else "other input"


@app.command()
def corruptions(
    count: Annotated[int, typer.Option(help="Files to damage.", min=1)] = 500,
    seed: int = 0,
    first: Annotated[int, typer.Option(help="Number of the first case.", min=0)] = 0,
    output: Annotated[Path, typer.Option("-o", help="CSV with a line per case.")] = Path("corruptions.csv"),
) -> None:
    """Damage files and see what the commands say."""
    by_command, by_file = Counter[tuple[str, str]](), Counter[tuple[str, str]]()
    with tempfile.TemporaryDirectory() as place, output.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(Case.__dataclass_fields__))
        writer.writeheader()
        keep = output.with_name(f"{output.stem}-bad")
        for case in corruption_cases(range(first, first + count), seed, Path(place), keep):
            writer.writerow(asdict(case))
            file.flush()
            by_command[case.command, case.verdict] += 1
            by_file[kind_of(case.file), case.verdict] += 1
            if case.verdict in BAD:
                typer.echo(
                    f"{case.number}: {case.file} {case.damage}: {case.command}: {case.verdict}, "
                    f"again: {case.again}: {case.text}"
                )
    show(by_command)
    show(by_file)


def show(table: Counter[tuple[str, str]]) -> None:
    """Print a table of counts, with verdicts in columns."""
    verdicts = sorted({verdict for _, verdict in table})
    typer.echo(f"{'':32s}" + "".join(f"{verdict:>13s}" for verdict in verdicts))
    for row in sorted({row for row, _ in table}):
        typer.echo(f"{row:32s}" + "".join(f"{table[row, verdict]:13d}" for verdict in verdicts))


if __name__ == "__main__":
    app()
