"""Files of photos (`images`), depth maps with their definition (`depth_pictures`), videos, meshes and volumes."""
