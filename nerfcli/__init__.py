"""nerfcli: from a folder of photos to a radiance field, its renders, depth maps and videos."""

__version__ = "0.1.0"
