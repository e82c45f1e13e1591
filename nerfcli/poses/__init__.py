"""Where the photos were taken from: structure from motion with pycolmap, in a process of its own.

`structure_from_motion` is the entrance. `photos` judges the folder and `pairs` says which photos to compare.
`supervise` runs the child process `worker` on a `job`, through `features` and `mapping`; `reasons` says why a photo
found no place.
"""

# pycolmap brings a zlib of its own. If that is loaded first, Pillow and OpenCV mix it with theirs, and writing a PNG
# ends the process ("free(): invalid pointer" in deflateEnd). So Python's is loaded before all else.
import zlib as _zlib  # noqa: F401
