"""Mutants of structure from motion, see `mutants.py`."""

from mutant_list import Group, Mutant

POSES: tuple[Group, ...] = (
    Group(
        "poses/model/principal_points.py",
        ("tests/test_principal_points.py",),
        "",
        (),
        (
            Mutant("_GAIN_FRACTION = 0.1", "_GAIN_FRACTION = 0.0"),
            Mutant("gain > _GAIN_DEVIATIONS and after", "after"),
            Mutant("np.minimum(before, most), np.minimum(after, most)", "before, after"),
            Mutant("image.camera_id not in fixed and image.num_points3D", "image.num_points3D"),
            Mutant("image.num_points3D >= LEAST_OBSERVATIONS", "image.num_points3D > 0"),
            Mutant("        if number > 0:\n            _move_lenses", "        if False:\n            _move_lenses"),
            Mutant("_adjust(own, free - held, threads", "_adjust(own, free, threads"),
            Mutant("shifts[far] = 0.0", "pass"),
            Mutant("held |= {photos[anchor], *np.array(photos)[far].tolist()}", "held |= {photos[anchor]}"),
            Mutant("principal_points=bool(free)", "principal_points=False"),
            Mutant("        focal_lengths=False,\n", "        focal_lengths=True,\n"),
            Mutant("+ values[6:] - pixels", "- values[6:] - pixels"),
            Mutant("for _ in range(_ROUNDS):\n        usual", "for _ in range(1):\n        usual"),
            Mutant("float(np.median([camera.principal_point_x for", "float(np.mean([camera.principal_point_x for"),
        ),
    ),
    Group(
        "poses/model/lens_evidence.py",
        ("tests/test_principal_points.py", "tests/test_lens_evidence.py"),
        "",
        (),
        (
            Mutant("moves[:, None, None] * np.eye(2)", "0 * moves[:, None, None] * np.eye(2)"),
            Mutant("[seen.images.index(image_id) for image_id in shifting]", "list(range(len(seen.images)))"),
            Mutant(
                "terms, of = _lens_terms(camera, local), seen.lenses[position]",
                "terms, of = _lens_terms(camera, local), image.camera_id",
            ),
        ),
    ),
    Group(
        "poses/engine/strict.py",
        ("tests/test_principal_points.py", "tests/test_pose_strict.py"),
        "strict or scene_of or held_out or fingerprint",
        (),
        (
            Mutant("camera.principal_point_x += shift[0]", "camera.principal_point_x -= shift[0]"),
            Mutant("        if number in others\n", ""),
        ),
    ),
    Group(
        "poses/engine/worker.py",
        ("tests/test_principal_points.py",),
        "scene_of",
        (),
        (
            Mutant('model, result["principal_points"] = found.model,', '_, result["principal_points"] = found.model,'),
            Mutant(
                "describe_cameras(model, job, uncertainty, lens_of=lens_of)",
                "describe_cameras(model, job, uncertainty, lens_of={i: model.image(i).camera_id for i in lens_of})",
            ),
        ),
    ),
    Group(
        "poses/engine/features.py",
        ("tests/test_faint_photos.py",),
        "",
        (),
        (
            Mutant('_Search("faint", below=1 / 8', '_Search("faint", below=0.0'),
            Mutant("first_octave=0, contrast=_CONTRAST / 4", "first_octave=0, contrast=_CONTRAST"),
            Mutant("if last[n] == index - 1 and counts", "if counts"),
            Mutant("counts[n] < search.below * job.max_features", "True"),
            Mutant("            forget_features(job, [job.image_ids[number] for number in poor])\n", ""),
            Mutant("                last[number] = index\n", "                pass\n"),
            Mutant("kept[i][1] if kept", "0 if kept"),
        ),
    ),
    Group(
        "poses/input/photos.py",
        ("tests/test_pose_subfolders.py",),
        "",
        (),
        (
            Mutant("PurePosixPath(photo.name).parent, ", ""),
            Mutant("if not subfolders:", "if True:"),
            Mutant('any(p.startswith(".") for p in', "any(False for p in"),
            Mutant("return path.relative_to(folder).as_posix()", "return path.name"),
        ),
    ),
    Group(
        "cameras/calibration.py",
        ("tests/test_pose_subfolders.py", "tests/test_pose_intrinsics.py"),
        "",
        (),
        (Mutant("same_folder or set(same_name.values())", "set(same_name.values())"),),
    ),
)
