"""Names of the files in a run folder."""

from nerfcli.cameras.formats.run_cameras import CAMERAS

CONFIG = "config.json"
FIELD = "field.safetensors"
STATE = "state.safetensors"
LOG = "log.jsonl"
METRICS = "metrics.json"
MEMBERS = "members"
BLOCKS = "blocks"
DEPTH_ERRORS = "depth_errors.json"
PHOTO_DEPTHS = "photo_depths.npz"
REPORT = "report.html"
LOCK = ".train.lock"
LIVE = ".live"
# Written and read by tomography, for a reconstruction from an X-ray scan.
RECONSTRUCTION = "reconstruction.json"

__all__ = [
    "BLOCKS",
    "CAMERAS",
    "CONFIG",
    "DEPTH_ERRORS",
    "FIELD",
    "LIVE",
    "LOCK",
    "LOG",
    "MEMBERS",
    "METRICS",
    "PHOTO_DEPTHS",
    "RECONSTRUCTION",
    "REPORT",
    "STATE",
]
