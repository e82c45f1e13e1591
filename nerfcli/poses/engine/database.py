"""pycolmap's database: photos under fixed ids, and removal of entries that are out of date.

Features are written photo by photo, and matches by pycolmap block by block, each in a transaction; existing entries are
skipped. So the database is consistent at any moment, and the same calls continue the work. This module only has to
remove entries that depend on something that has changed.

pycolmap has its own SQLite library. Two SQLite libraries must not have a file open in one process: when one closes it,
the locks of the other are dropped. So Python's is used only while pycolmap has the database closed.
"""

import shutil
import sqlite3
from collections.abc import Iterable, Iterator, Set
from contextlib import closing, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import pycolmap

from nerfcli.photos.focal_evidence import usual_focal_px
from nerfcli.poses.input.job import CameraGroup, Job
from nerfcli.poses.model.two_views import count_matches


def register_photos(job: Job) -> None:
    """Make the database hold exactly the job's photos, with the ids and cameras of the job.

    Features are kept. Verified matches are removed if they were verified with intrinsics that have changed, and so is
    everything about photos that the job does not have.
    """
    job.database.parent.mkdir(parents=True, exist_ok=True)
    cameras = {number: camera_of_group(group) for number, group in enumerate(job.groups, start=1)}
    camera_ids = {photo: number for number, group in enumerate(job.groups, start=1) for photo in group.photos}
    wanted = {
        image_id: (file, camera_ids[number], _described(cameras[camera_ids[number]]))
        for number, (image_id, file) in enumerate(zip(job.image_ids, job.files, strict=True))
    }
    with pycolmap.Database.open(job.database) as database:
        before = {camera.camera_id: camera for camera in database.read_all_cameras()}
        there = {
            image.image_id: (image.name, image.camera_id, _described(before[image.camera_id]))
            for image in database.read_all_images()
        }
    if there == wanted:
        return
    forget_features(job, there.keys() - wanted.keys())
    verified_otherwise = [
        image_id
        for image_id in there.keys() & wanted.keys()
        if _verified_with(before[there[image_id][1]]) != _verified_with(cameras[wanted[image_id][1]])
    ]
    _forget(job, verified_otherwise, "two_view_geometries")  # the matches are kept, and are verified again later
    with _edited(job) as database:
        for table in ("frame_data", "frames", "rig_sensors", "rigs", "images", "cameras", "pose_priors"):
            database.execute(f"DELETE FROM {table}")
    with pycolmap.Database.open(job.database) as database, pycolmap.DatabaseTransaction(database):
        for number, camera in cameras.items():
            camera.camera_id = number
            database.write_camera(camera, use_camera_id=True)
            rig = pycolmap.Rig()
            rig.rig_id = number
            rig.add_ref_sensor(camera.sensor_id)
            database.write_rig(rig, use_rig_id=True)
        for image_id, (file, camera_id, _) in sorted(wanted.items()):
            image = pycolmap.Image(name=file, camera_id=camera_id, image_id=image_id)
            database.write_image(image, use_image_id=True)
            frame = pycolmap.Frame()
            frame.frame_id, frame.rig_id = image_id, camera_id
            frame.add_data_id(image.data_id)
            database.write_frame(frame, use_frame_id=True)


def camera_of_group(group: CameraGroup) -> pycolmap.Camera:
    """Return the camera of a group, with the given intrinsics, or with the estimated, EXIF or usual focal length."""
    if group.params is not None:
        camera = pycolmap.Camera.create_from_model_name(1, group.model, 1.0, group.width, group.height)
        camera.params = list(group.params)
        camera.has_prior_focal_length = True
        return camera
    known_px = group.focal_px if group.estimated_focal_px is None else group.estimated_focal_px
    focal_px = usual_focal_px(group.width, group.height) if known_px is None else known_px
    camera = pycolmap.Camera.create_from_model_name(1, group.model, focal_px, group.width, group.height)
    camera.has_prior_focal_length = group.focal_is_prior
    return camera


def forget_features(job: Job, image_ids: Iterable[int]) -> None:
    """Remove the features of some photos and all their matches; pycolmap itself can only remove those of all photos."""
    _forget(job, image_ids, "keypoints", "descriptors", "matches", "two_view_geometries")


def keep_geometries(job: Job, pairs: Iterable[tuple[int, int]]) -> None:
    """Remove the verified matches of all pairs but `pairs` (photo numbers), since the mapper uses all that it finds."""
    ids = job.image_ids
    wanted = {pycolmap.image_pair_to_pair_id(ids[i], ids[j]) for i, j in pairs}
    with _edited(job) as database:
        database.create_function("is_wanted", 1, wanted.__contains__)
        database.execute("DELETE FROM two_view_geometries WHERE NOT is_wanted(pair_id)")


def clear_matches(job: Job, *tables: str) -> None:
    """Empty "two_view_geometries", "matches", or both."""
    with _edited(job) as database:
        for table in tables:
            database.execute(f"DELETE FROM {table}")


def discard_if_damaged(path: Path) -> None:
    """Delete a database that cannot be read from beginning to end; its content is then computed again.

    A killed process leaves an intact one, thanks to SQLite's journal. After a power failure it may be damaged, since
    pycolmap does not wait for the disk.
    """
    if not path.exists():
        return
    try:
        with closing(sqlite3.connect(path)) as database:
            whole = database.execute("PRAGMA quick_check").fetchone() == ("ok",)
    except sqlite3.DatabaseError:
        whole = False
    if not whole:
        remove_database(path)


def remove_database(path: Path) -> None:
    """Remove a database, if it exists, with the logs that SQLite keeps beside it."""
    for log in ("", "-wal", "-shm", "-journal"):
        path.with_name(path.name + log).unlink(missing_ok=True)


@contextmanager
def copied(
    job: Job, name: str, *, without: Set[frozenset[int]] = frozenset(), cameras: pycolmap.Reconstruction | None = None
) -> Iterator[Job]:
    """Give the job of a copy of the database, called `name`, without some pairs and with the cameras of a model.

    The mapper can only extend a model with the same lenses. Of an earlier copy, nothing may be left: SQLite would apply
    its write-ahead log to this one.
    """
    kept = tuple(pair for pair in job.pairs if frozenset(job.image_ids[number] for number in pair) not in without)
    copy = replace(job, variant=name, pairs=kept)
    remove_database(copy.database)
    shutil.copyfile(job.database, copy.database)
    try:
        keep_geometries(copy, kept)
        with pycolmap.Database.open(copy.database) as database:
            for camera in () if cameras is None else cameras.cameras.values():
                database.update_camera(camera)
        yield copy
    finally:
        remove_database(copy.database)


def name_images(job: Job) -> None:
    """Give the images the photos' own names, so that COLMAP finds them in the user's folder."""
    names = zip(job.names, job.image_ids, strict=True)
    with _edited(job) as database:
        # In two steps, since a photo's own name may be the numbered name of another one.
        database.execute("UPDATE images SET name = '/' || image_id")
        database.executemany("UPDATE images SET name = ? WHERE image_id = ?", list(names))


def feature_counts(job: Job) -> list[int]:
    """Return the number of features of each photo."""
    with pycolmap.Database.open(job.database) as database:
        return [database.num_keypoints_for_image(image_id) for image_id in job.image_ids]


def evidence(job: Job) -> dict[str, dict[str, Any]]:
    """Return, by name, each photo's number of features, and the photo with which it has the most verified matches."""
    best: dict[int, tuple[int, str | None]] = dict.fromkeys(job.image_ids, (0, None))
    for first, second, count in count_matches(job.database):
        for one, other in ((first, second), (second, first)):
            if count > best[one][0]:
                best[one] = (count, job.name_of[other])
    return {
        job.name_of[image_id]: {"features": found, "best_matches": matches, "best_partner": partner}
        for found, (image_id, (matches, partner)) in zip(feature_counts(job), best.items(), strict=True)
    }


def _described(camera: pycolmap.Camera) -> tuple[Any, ...]:
    return (camera.model.name, camera.width, camera.height, *camera.params.tolist(), camera.has_prior_focal_length)


def _verified_with(camera: pycolmap.Camera) -> tuple[Any, ...]:
    """Return the camera data used by two-view geometry; without a prior, fundamental matrices need no focal length."""
    if camera.has_prior_focal_length:
        return _described(camera)
    return (camera.model.name, camera.width, camera.height)


def _forget(job: Job, image_ids: Iterable[int], *tables: str) -> None:
    photos = set(image_ids)
    if not photos:
        return
    with _edited(job) as database:
        database.create_function("is_photo", 1, photos.__contains__)
        database.create_function("has_photo", 1, lambda i: not photos.isdisjoint(pycolmap.pair_id_to_image_pair(i)))
        for table in tables:
            condition = "is_photo(image_id)" if table in ("keypoints", "descriptors") else "has_photo(pair_id)"
            database.execute(f"DELETE FROM {table} WHERE {condition}")


@contextmanager
def _edited(job: Job) -> Iterator[sqlite3.Connection]:
    """Open the database in Python's SQLite, for one transaction."""
    with closing(sqlite3.connect(job.database)) as database, database:
        yield database
