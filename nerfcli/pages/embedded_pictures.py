"""Pictures inside a page: as data, each once however often it is shown."""

import base64

import cv2
import numpy as np

JPEG_QUALITY = 85


def data_uri(data: bytes, kind: str) -> str:
    """Return an encoded picture as the address of itself.

    Args:
        kind: jpeg or png.
    """
    return f"data:image/{kind};base64,{base64.b64encode(data).decode()}"


def jpeg_bytes(picture: np.ndarray, *, longest_px: int | None = None, quality: int = JPEG_QUALITY) -> bytes:
    """Return a photo or a rendering, encoded.

    Args:
        picture: (H, W, 3) uint8 sRGB.
        longest_px: its longer side at most; smaller pictures stay as they are. None for any size.
    """
    return _encoded(fitted(picture, longest_px), ".jpg", [cv2.IMWRITE_JPEG_QUALITY, quality])


def png_bytes(picture: np.ndarray) -> bytes:
    """Return a drawing, encoded without loss: (H, W, 3) uint8 sRGB."""
    return _encoded(picture, ".png", [])


def fitted(picture: np.ndarray, longest_px: int | None) -> np.ndarray:
    """Reduce a picture if its longer side exceeds the limit."""
    scale = 1.0 if longest_px is None else longest_px / max(picture.shape[:2])
    if scale >= 1.0:
        return picture
    size = (max(1, round(picture.shape[1] * scale)), max(1, round(picture.shape[0] * scale)))
    return cv2.resize(picture, size, interpolation=cv2.INTER_AREA)


def picture_rule(name: str, uri: str) -> str:
    """Return a CSS rule that gives elements of a class a picture, so that one that is shown twice is stored once."""
    return f".{name}{{background-image:url({uri})}}"


def _encoded(picture: np.ndarray, suffix: str, options: list[int]) -> bytes:
    encoded, data = cv2.imencode(suffix, picture[..., ::-1], options)
    assert encoded
    return data.tobytes()
