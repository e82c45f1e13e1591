"""Pictures embedded in a page as data, each stored once however often it is shown."""

import base64

import cv2
import numpy as np

JPEG_QUALITY = 85


def data_uri(data: bytes, kind: str) -> str:
    """Return an encoded picture as a data URI.

    Args:
        kind: jpeg or png.
    """
    return f"data:image/{kind};base64,{base64.b64encode(data).decode()}"


def jpeg_bytes(picture: np.ndarray, *, longest_px: int | None = None, quality: int = JPEG_QUALITY) -> bytes:
    """Encode a photo or a rendering as JPEG.

    Args:
        picture: (H, W, 3) uint8 sRGB.
        longest_px: limit of its longer side; smaller pictures are not scaled. None for no limit.
    """
    return _encoded(fitted(picture, longest_px), ".jpg", [cv2.IMWRITE_JPEG_QUALITY, quality])


def png_bytes(picture: np.ndarray) -> bytes:
    """Encode a drawing (H, W, 3) uint8 sRGB as PNG, without loss."""
    return _encoded(picture, ".png", [])


def fitted(picture: np.ndarray, longest_px: int | None) -> np.ndarray:
    """Reduce a picture if its longer side exceeds the limit."""
    scale = 1.0 if longest_px is None else longest_px / max(picture.shape[:2])
    if scale >= 1.0:
        return picture
    size = (max(1, round(picture.shape[1] * scale)), max(1, round(picture.shape[0] * scale)))
    return cv2.resize(picture, size, interpolation=cv2.INTER_AREA)


def picture_rule(name: str, uri: str) -> str:
    """Return a CSS rule that shows a picture in all elements of a class, so that it is stored only once."""
    return f".{name}{{background-image:url({uri})}}"


def _encoded(picture: np.ndarray, suffix: str, options: list[int]) -> bytes:
    encoded, data = cv2.imencode(suffix, picture[..., ::-1], options)
    assert encoded
    return data.tobytes()
