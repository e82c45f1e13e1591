"""The names of the files in a run folder."""

from nerfcli.cameras.formats.run_cameras import CAMERAS

CONFIG = "config.json"
FIELD = "field.safetensors"
STATE = "state.safetensors"
LOG = "log.jsonl"
METRICS = "metrics.json"
REPORT = "report.html"
LOCK = ".train.lock"

__all__ = ["CAMERAS", "CONFIG", "FIELD", "LOCK", "LOG", "METRICS", "REPORT", "STATE"]
