"""nerfcli: from a folder of photos to a radiance field, its renders, depth maps and videos.

Python programs can call the commands as functions: `run_pipeline` is all of them; `estimate_poses`, `train_scene`,
`evaluate_run`, `render_run` and `export_run` are its stages; `load_scene`, `load_run` and `load_splats` read their
results. `Output`, `Resources` and `Reporter` say where results go, what may be used and where messages go. All are
imported on first use: `import nerfcli` is fast.
"""

# Must come before any import of pycolmap: its wheel exports zlib's functions, and if Python's zlib is loaded after it,
# the first compression (a PNG, a TIFF, an npz) aborts the process.
import zlib  # noqa: F401

__version__ = "0.1.0"

TYPE_CHECKING = False
if TYPE_CHECKING:
    from nerfcli.captures.loading import load_scene as load_scene
    from nerfcli.machine import Resources as Resources
    from nerfcli.notices import Reporter as Reporter
    from nerfcli.output import Output as Output
    from nerfcli.training.runs.run import load_run as load_run
    from nerfcli.workflows.evaluate import evaluate_run as evaluate_run
    from nerfcli.workflows.export import export_run as export_run
    from nerfcli.workflows.pipeline import run_pipeline as run_pipeline
    from nerfcli.workflows.poses import estimate_poses as estimate_poses
    from nerfcli.workflows.render import render_run as render_run
    from nerfcli.workflows.splats import load_splats as load_splats
    from nerfcli.workflows.train import train_scene as train_scene

_MODULES = {
    "Output": "nerfcli.output",
    "Reporter": "nerfcli.notices",
    "Resources": "nerfcli.machine",
    "estimate_poses": "nerfcli.workflows.poses",
    "evaluate_run": "nerfcli.workflows.evaluate",
    "export_run": "nerfcli.workflows.export",
    "load_run": "nerfcli.training.runs.run",
    "load_scene": "nerfcli.captures.loading",
    "load_splats": "nerfcli.workflows.splats",
    "render_run": "nerfcli.workflows.render",
    "run_pipeline": "nerfcli.workflows.pipeline",
    "train_scene": "nerfcli.workflows.train",
}
__all__ = [*_MODULES]


def __getattr__(name: str) -> object:
    if name not in _MODULES:
        raise AttributeError(f"module 'nerfcli' has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module(_MODULES[name]), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
