"""Initial focal lengths for mapping, where EXIF has no reliable one."""

from collections.abc import Sequence
from dataclasses import replace

from nerfcli.poses.engine.database import register_photos
from nerfcli.poses.input.job import CameraGroup, Job, Tell
from nerfcli.poses.model.focal_length import focal_length
from nerfcli.poses.model.reasons import FEW_MATCHES
from nerfcli.poses.model.two_views import VerifiedPair, read_verified_pairs

# Pairs determine the focal length if its spread is small and the cost rises beside it; photos of an object from all
# sides and one distance do not.
_LARGEST_SPREAD = 0.05
_LEAST_RISE = 0.1


def with_focal_lengths(job: Job, tell: Tell) -> Job:
    """Return the job, and update its database, with focal lengths estimated from pairs of photos that determine them.

    Only cameras without a reliable focal length from EXIF or the user are estimated. By default the mapper starts
    from 1.2 times the longer side; if that is a third off, it takes up to three times as long.
    """
    unknown = [
        group
        for group in job.groups
        if group.params is None and not group.focal_is_prior and "FISHEYE" not in group.model
    ]
    if not unknown:
        return job
    pairs = read_verified_pairs(job.database, min_matches=FEW_MATCHES)
    groups = tuple(_estimated(group, job, pairs, tell) if group in unknown else group for group in job.groups)
    if groups == job.groups:
        return job
    estimated = replace(job, groups=groups)
    register_photos(estimated)
    return estimated


def _estimated(group: CameraGroup, job: Job, pairs: Sequence[VerifiedPair], tell: Tell) -> CameraGroup:
    photos = {job.image_ids[number] for number in group.photos}
    of_group = [pair for pair in pairs if pair.one in photos and pair.other in photos]
    found = focal_length(of_group, (group.width, group.height), seed=job.seed)
    if found is None or found.spread > _LARGEST_SPREAD or found.rise < _LEAST_RISE:
        return group
    tell(
        f"starting from a focal length of {found.px:.0f} px, estimated from {found.pairs} pairs of photos "
        f"(spread {100 * found.spread:.1f} %)"
    )
    return replace(group, estimated_focal_px=found.px)
