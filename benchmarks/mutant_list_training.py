"""The mutants of `mutants.py` in what training decides: refined cameras, and which components are kept."""

from mutant_list import Group, Mutant

TRAINING: tuple[Group, ...] = (
    Group(
        "train/gauge.py",
        ("tests/test_refinement.py",),
        "mean or similarity or place or spot",
        (),
        (
            Mutant("arms = centres - middle", "arms = centres"),
            Mutant(
                "after[:, :3, :3] @ np.swapaxes(before[:, :3, :3], -1, -2)",
                "before[:, :3, :3] @ np.swapaxes(after[:, :3, :3], -1, -2)",
            ),
            Mutant("moves = after[:, :3, 3] - centres", "moves = centres - after[:, :3, 3]"),
            Mutant("= -_cross_matrices(arms)", "= _cross_matrices(arms)"),
            Mutant("rows[:, 3:, 6] = arms", "rows[:, 3:, 6] = -arms"),
            Mutant("float(np.exp(found[6]))", "float(np.exp(-found[6]))"),
            Mutant("middle + found[3:6] - scale * rotation @ middle", "found[3:6]"),
            Mutant(".inverse().apply_pose(after)", ".apply_pose(after)"),
            Mutant("return mean_similarity(before, after).inverse().apply_pose(after)", "return after"),
            Mutant("reach = reach if reach > LEAST_REACH else 1.0", "reach = 1.0"),
            Mutant("[-y, x, zero]", "[y, -x, zero]"),
        ),
    ),
    Group(
        "train/whitening.py",
        ("tests/test_refinement.py",),
        "whitened",
        (),
        (
            Mutant("vectors / np.sqrt(values)", "vectors / values"),
            Mutant("jacobian.T @ jacobian", "jacobian.T @ jacobian / len(jacobian)"),
            Mutant("DAMPING * np.diag(squares)", "DAMPING"),
            Mutant(
                "@ gradient[..., None]",
                "@ gradient[..., None] * 2",
                "Adam's steps do not depend on the gradient's size",
            ),
            Mutant("1 - BETAS[0] ** steps", "1 - BETAS[0]"),
            Mutant("1 - BETAS[1] ** steps", "1 - BETAS[1]"),
            Mutant("return -rate *", "return rate *"),
            Mutant("self.second.lerp_(white.square()", "self.second.lerp_(white.abs()"),
        ),
    ),
    Group(
        "train/refinement.py",
        ("tests/test_refinement.py",),
        "frames_are or picture_moves or mean or gradient or rates or rays or find_back or moved or cameras_of",
        (),
        (
            Mutant("return self._given @ self.motions.numpy()", "return self.motions.numpy() @ self._given"),
            Mutant(
                "turns = now[:, :3, :3] @ np.swapaxes(self._given[:, :3, :3], -1, -2)",
                "turns = self._given[:, :3, :3] @ np.swapaxes(now[:, :3, :3], -1, -2)",
            ),
            Mutant("return origins + shift,", "return origins - shift,"),
            Mutant("torch.linalg.cross(directions, by_direction)", "torch.linalg.cross(by_direction, directions)"),
            Mutant("torch.stack([by_origin, torque]", "torch.stack([-by_origin, torque]"),
            Mutant(
                "without_mean(self._given, self.poses() @ transform_from_twist(twists))",
                "self.poses() @ transform_from_twist(twists)",
            ),
            Mutant("self.poses() @ transform_from_twist(twists)", "transform_from_twist(twists) @ self.poses()"),
            Mutant("[1 / distance] * 3 + [1.0] * 3", "[distance] * 3 + [1.0] * 3"),
            Mutant("np.cross(by_point, points[:, None, :])", "np.cross(points[:, None, :], by_point)"),
            Mutant("turns[photos[rays]].transpose(-1, -2) @ by_direction", "turns[photos[rays]] @ by_direction"),
            Mutant("place // width], dim=-1).double() + 0.5", "place // width], dim=-1).double()"),
            Mutant("motions[:, :3, 3] / scale", "motions[:, :3, 3] * scale"),
            Mutant("pose @ motion for", "motion @ pose for"),
            Mutant("if not FIRST_SHARE < share < LAST_SHARE:", "if not FIRST_SHARE < share:"),
            Mutant(
                "refined(frame, frame.world_from_cam) for frame in held_out",
                "refined(frame, poses[0]) for frame in held_out",
            ),
        ),
    ),
    Group(
        "train/lens_change.py",
        ("tests/test_refinement.py",),
        "lens or bearings or nothing",
        (),
        (
            Mutant("np.exp(change.get(FOCAL, 0.0))", "np.exp(-change.get(FOCAL, 0.0))"),
            Mutant("value + change.get(name, 0.0)", "value - change.get(name, 0.0)"),
            Mutant("by_parameters[..., focal] @ np.array(camera.params)[focal]", "by_parameters[..., focal].sum(-1)"),
            Mutant("return -by_pixel @", "return by_pixel @"),
            Mutant("radial[:_RADIAL_TERMS]", "radial[:0]"),
        ),
    ),
    Group(
        "train/camera_moves.py",
        ("tests/test_refinement.py",),
        "moves_are or cameras_of",
        (),
        (
            Mutant("np.degrees(turns)", "turns"),
            Mutant("100 * moves / radius", "100 * moves"),
            Mutant("np.swapaxes(given[:, :3, :3], 1, 2) @ refined", "given[:, :3, :3] @ refined"),
            Mutant("a.camera.focal_px - 1", "a.camera.focal_px"),
        ),
    ),
    Group(
        "train/judgement.py",
        ("tests/test_selection.py",),
        "",
        (),
        (
            Mutant("LEAST_GAIN_DB = 0.05", "LEAST_GAIN_DB = 0.0"),
            Mutant("STANDARD_ERRORS = 2.0", "STANDARD_ERRORS = 1.0"),
            Mutant("MOST_LOSS_DB = 0.1", "MOST_LOSS_DB = 0.2"),
            Mutant(
                "10.0 * np.log10((errors[0] + floor) / (errors[1] + floor))",
                "10.0 * np.log10((errors[1] + floor) / (errors[0] + floor))",
            ),
            Mutant("floor = FLOOR * errors[0].mean() + 1e-12", "floor = 1e-12"),
            Mutant("gains.mean(0).var(ddof=1)) / photos", "gains.mean(0).var(ddof=1))"),
            Mutant("gains.mean(1).var(ddof=1)) / seeds", "gains.mean(1).var(ddof=1))"),
            Mutant("math.sqrt(between_seeds + between_photos)", "math.sqrt(between_seeds)"),
            Mutant("trend = gain -", "trend = -gain +"),
            Mutant("slope_db * math.log2(1.0 + cost) if by_time", "slope_db * math.log2(1.0 + cost) if not by_time"),
            Mutant(
                "worst = gain + min(0.0, trend) - STANDARD_ERRORS", "worst = gain + min(0.0, trend) + STANDARD_ERRORS"
            ),
            Mutant("worst = gain + min(0.0, trend)", "worst = gain"),
            Mutant("if at_equal_time <= LEAST_GAIN_DB", "if at_equal_time <= -LEAST_GAIN_DB"),
            Mutant("judged = base.counts > 0", "judged = base.counts >= 0"),
        ),
    ),
)
