"""Names of the files in a run folder."""

CONFIG = "config.json"
FIELD = "field.safetensors"
STATE = "state.safetensors"
SPLATS = "splats.safetensors"
LOG = "log.jsonl"
METRICS = "metrics.json"
DEPTH_ERRORS = "depth_errors.json"
PHOTO_DEPTHS = "photo_depths.npz"
REPORT = "report.html"
LOCK = ".train.lock"
# Of a reconstruction from an X-ray scan, which is no run.
RECONSTRUCTION = "reconstruction.json"
