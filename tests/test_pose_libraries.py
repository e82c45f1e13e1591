"""Libraries of the worker that bring parts of each other must not mix them."""

import subprocess
import sys


def test_pictures_can_be_written_beside_pycolmap() -> None:
    """Pillow crashed the process when it used pycolmap's zlib: see nerfcli/__init__.py."""
    program = (
        "import nerfcli.poses, pycolmap, io, numpy as np; from PIL import Image; import cv2\n"
        "for seed in range(30):\n"
        "    pixels = np.random.default_rng(seed).random((360, 480)) > 0.5\n"
        "    file = io.BytesIO(); Image.fromarray(pixels).save(file, 'PNG')\n"
        "    assert (np.asarray(Image.open(io.BytesIO(file.getvalue()))) == pixels).all()\n"
        "    assert cv2.imencode('.png', pixels.astype(np.uint8))[0]\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-500:]
