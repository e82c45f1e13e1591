"""The definition of every hot operation, in plain torch: short, any dtype, any device, never optimised.

Letters and packing as in `kernels.interface`. A fast kernel in another folder agrees with these functions in value and
gradient. `kernels.composition` composes them.
"""

from nerfcli.kernels.reference.compositing import (
    composite,
    contracted_distance,
    depth_loss,
    distortion,
    interval_weights,
    optical_depth_before,
    ray_indices,
    scale_gradients,
    sum_along_rays,
)
from nerfcli.kernels.reference.depth import ray_termination
from nerfcli.kernels.reference.encoding import corner_rows, hash_encode
from nerfcli.kernels.reference.marching import (
    distances_to_occupied,
    keep_largest,
    march,
    occupied_samples,
    ray_gradients,
    sample_coordinates,
    visible_samples,
)
from nerfcli.kernels.reference.networks import density, geometry, radiance
from nerfcli.kernels.reference.pixels import pixel_rays
from nerfcli.kernels.reference.row_adam import adam_rows
from nerfcli.kernels.reference.volumes import back_project, denoise_total_variation, project, total_variation
