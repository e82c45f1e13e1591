"""The record of a capture: frames, points, split, unit and its source, provenance."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from nerfcli.cameras.frame import Frame, Size


@dataclass(frozen=True)
class Observations:
    """Observations of points: one row per 2D feature of a frame.

    Args:
        frame_index: (M,) int64, of the frame.
        point_index: (M,) int64, of the point; -1 for a feature without one.
        pixels: (M, 2) float64 positions in the frame's picture, pixel centres at 0.5.
    """

    frame_index: np.ndarray
    point_index: np.ndarray
    pixels: np.ndarray


@dataclass(frozen=True)
class Capture:
    """A capture: as a file describes it, or loaded, with the photos that are on disk and their split.

    Args:
        frames: the views, in the order of the file; of a loaded capture, those whose photo is on disk.
        points: (N, 3) points of the surface in the world, float64; N is 0 where the format has none.
        missing: names of images that the file lists and that are not on disk.
        depth_bounds: (frames, 2) nearest and farthest z of each view in scene units, or None.
        kind: the format, see `formats.registry`.
        colours: (N, 3) uint8 sRGB of the points, or None.
        observations: where the points were seen, or None; None once loaded.
        unit: of length: "arbitrary" or "metre".
        unit_source: how the metric scale was found, as text for people; None if unknown.
        pixels: which pixels of a photo with an EXIF orientation its camera refers to: "stored", as nearly all programs
            read them, or "upright", as the photo is displayed.
        rescaled: number of photos whose intrinsics were given for another size, by (that size, the photo's size),
            each (width, height).
        provenance: origin of cameras and points: what a scene folder says, or {"from": the format} once loaded.
        root: the folder that was loaded, or that the loaded file is in.
        test_names: names of the held-out frames of a loaded capture.
        holdout: the rule that chose them; None for the split of the capture, or the default split.
        notes: what was left out or assumed while the files were read, each a line for people.
    """

    frames: tuple[Frame, ...]
    points: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    missing: tuple[str, ...] = ()
    depth_bounds: np.ndarray | None = None
    kind: str = ""
    colours: np.ndarray | None = None
    observations: Observations | None = None
    unit: str = "arbitrary"
    unit_source: str | None = None
    pixels: str = "stored"
    rescaled: Mapping[tuple[Size, Size], int] = field(default_factory=dict)
    provenance: Mapping[str, Any] = field(default_factory=dict)
    root: Path = Path()
    test_names: frozenset[str] = frozenset()
    holdout: str | None = None
    notes: tuple[str, ...] = ()

    @property
    def train_frames(self) -> tuple[Frame, ...]:
        """The training frames, in order."""
        return tuple(frame for frame in self.frames if frame.name not in self.test_names)

    @property
    def test_frames(self) -> tuple[Frame, ...]:
        """The held-out frames, in order."""
        return tuple(frame for frame in self.frames if frame.name in self.test_names)
