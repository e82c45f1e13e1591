"""Files of rendered frames: depth maps with their definition, videos, and the facts that such files state."""
