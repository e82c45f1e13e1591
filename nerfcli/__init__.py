"""nerfcli: from a folder of photos to a radiance field, its renders, depth maps and videos."""

# Before any module of this package can import pycolmap: its wheel exports zlib's functions, and where Python's zlib is
# loaded after it, the first compression (a PNG, a TIFF, an npz) aborts the process.
import zlib  # noqa: F401

__version__ = "0.1.0"
