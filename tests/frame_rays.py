"""Rays of all pixels of a frame, for tests that check every pixel."""

import numpy as np
import torch

from nerfcli.cameras.frame import Frame
from nerfcli.cameras.rigid import Similarity
from nerfcli.render.tracing import PictureRays, pixel_rays


def frame_rays(frame: Frame, training_from_scene: Similarity, device: torch.device) -> PictureRays:
    """Return the rays of all pixel centres of a frame, row by row."""
    pixels = np.arange(frame.camera.width * frame.camera.height)
    return pixel_rays(frame, training_from_scene, pixels=pixels, device=device)
