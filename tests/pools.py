"""Pools of photos that tests make one by one."""

from collections.abc import Sequence

import numpy as np
import torch

from nerfcli.cameras.rigid import Similarity
from nerfcli.photos.loading import LoadedPhoto
from nerfcli.training.pool import Album, PixelPool


def pool_of_photos(
    photos: Sequence[LoadedPhoto],
    training_from_scene: Similarity = Similarity.identity(),
    device: torch.device = torch.device("cpu"),
) -> PixelPool:
    """Return the pool of some photos; if any has alpha, those without are opaque."""
    channels = max(photo.pixels.shape[-1] for photo in photos)
    rows = [photo.pixels.reshape(-1, photo.pixels.shape[-1]) for photo in photos]
    rows = [np.pad(row, ((0, 0), (0, channels - row.shape[1])), constant_values=255) for row in rows]
    return PixelPool(Album(tuple(photos), np.concatenate(rows), fills_frame=True), training_from_scene, device)
