"""The mutants of `mutants.py`: what is broken where, and which tests are asked."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Mutant:
    """One text, which stands once in the file, replaced by another; `equivalent` says why no test can tell."""

    old: str
    new: str
    equivalent: str = ""


@dataclass(frozen=True)
class Group:
    """Mutants of one file.

    Args:
        file: below nerfcli/.
        tests: the files that run, until the first failure.
        selected: pytest's -k; "" for all.
        compiled_into: files whose compiled functions hold those of this file.
        mutants: what is broken.
    """

    file: str
    tests: tuple[str, ...]
    selected: str
    compiled_into: tuple[str, ...]
    mutants: tuple[Mutant, ...]


GROUPS: tuple[Group, ...] = (
    Group(
        "kernels/reference/encoding.py",
        ("tests/test_reference_kernels.py",),
        "",
        (),
        (
            Mutant("side = resolution + 1\n", "side = resolution\n"),
            Mutant("if side**3 <= rows:", "if side**3 < rows:"),
            Mutant("2654435761, 805459861)", "2654435761, 805459863)"),
            Mutant("mixed & (rows - 1)", "mixed & rows"),
            Mutant("points.clamp(0.0, 1.0) * resolution", "points * resolution"),
            Mutant(".clamp_max(resolution - 1)", ".clamp_max(resolution)"),
            Mutant("torch.where(corners == 1, inside,", "torch.where(corners == 0, inside,"),
        ),
    ),
    Group(
        "kernels/reference/marching.py",
        ("tests/test_reference_kernels.py", "tests/test_field_kinds.py"),
        "",
        (),
        (
            Mutant("* ((starts + ends) / 2)[..., None]", "* starts[..., None]"),
            Mutant("edges[:-1] + rays.jitter[:, None] *", "edges[:-1] - rays.jitter[:, None] *"),
            Mutant("((coordinates >= 0) & (coordinates <= 1))", "((coordinates >= 0) & (coordinates <= 2))"),
            Mutant("return starts, ends, coordinates, offsets", "return ends, starts, coordinates, offsets"),
        ),
    ),
    Group(
        "kernels/reference/compositing.py",
        (
            "tests/test_reference_kernels.py",
            "tests/test_worked_examples.py",
            "tests/test_priors.py",
            "tests/test_components.py",
        ),
        "",
        (),
        (
            Mutant("(rays, place + 1)", "(rays, place)"),
            Mutant("weights = torch.exp(-before) * opacity(depth)", "weights = torch.exp(-before) * depth"),
            Mutant("weights = torch.exp(-before) *", "weights = torch.exp(before) *"),
            Mutant("return weights, torch.exp(-sum", "return weights, 1.0 - torch.exp(-sum"),
            Mutant("transmittance[:, None] * background", "background"),
            Mutant("2 * gaps * before", "gaps * before"),
            Mutant("(weights + behind)", "behind"),
            Mutant("(ends - starts) / 3", "(ends - starts) / 2"),
            Mutant("of_targets) + transmittance[first:]", "of_targets)"),
            Mutant("first = len(transmittance) - len(distances)", "first = 0"),
            Mutant("(MOST_DEVIATION * distance)).clamp_max(1.0)", "(MOST_DEVIATION * distance))"),
            Mutant("(distance / near).square().clamp_max(1.0)", "distance.square().clamp_max(1.0)"),
        ),
    ),
    Group(
        "kernels/composition.py",
        ("tests/test_backends.py",),
        "",
        (),
        (
            Mutant("transmittance <= math.exp(-march.max", "transmittance >= math.exp(-march.max"),
            Mutant("if targets.near is not None and", "if targets.near is None and"),
            Mutant("contracted_distance(starts), contracted_distance(ends)", "starts, ends"),
            Mutant("middles = (starts + ends) / 2", "middles = starts"),
            Mutant("if medium.antialias and", "if not medium.antialias and"),
            Mutant("UNSEEN * self._sum_along_rays", "self._sum_along_rays"),
            Mutant("unseen = weights <=", "unseen = weights >="),
            Mutant(
                "rgb[seen] = self._networks(samples.encoded[seen]", "rgb[seen] = self._networks(samples.encoded[:1]"
            ),
            Mutant("< march.max_optical_depth\n", "< 2 * march.max_optical_depth\n"),
            Mutant("(1, 0))[offsets]", "(0, 1))[offsets]"),
            Mutant(
                "self._encoded(samples, grid, widths=widths, sink=sink)",
                "self._encoded(samples, grid, widths=None, sink=sink)",
            ),
            Mutant(
                "self._encoded(samples, grid, widths=widths, sink=sink)",
                "self._encoded(samples, grid, widths=widths, sink=None)",
            ),
            Mutant(
                "self._networks(encoded, directions, index, grid)",
                "self._networks(encoded, -directions, index, grid)",
            ),
            Mutant(
                "self._networks(encoded, directions, index, grid)",
                "self._networks(encoded.flip(0), directions, index, grid)",
            ),
            Mutant(
                "density, rgb = medium.radiance(samples.coordinates,",
                "density, rgb = medium.radiance(samples.coordinates.flip(0),",
            ),
            Mutant(
                "ends - starts, offsets=offsets, background=background",
                "ends - starts, offsets=offsets, background=0.0 * background",
            ),
            Mutant(
                "ends - starts, offsets=offsets, background=background",
                "(ends - starts).flip(0), offsets=offsets, background=background",
            ),
            Mutant("rgb, distance=starts", "rgb, distance=ends"),
            Mutant("rgb, distance=starts", "rgb, distance=2 * starts"),
            Mutant("rays.origins.requires_grad or rays.directions", "rays.origins.requires_grad and rays.directions"),
            Mutant("torch.tensor(len(starts))", "torch.tensor(len(offsets))"),
            Mutant(
                "background=background.expand(len(rays.origins), 3)",
                "background=0.0 * background.expand(len(rays.origins), 3)",
            ),
            Mutant("rays.directions, index[seen], medium)[1]", "rays.directions, index[: len(seen)], medium)[1]"),
            Mutant("rays.directions, index[seen])[1]", "rays.directions, index[: len(seen)])[1]"),
            Mutant("index=index, contraction=march", "index=0 * index, contraction=march"),
            Mutant("transmittance * behind, 0.0)", "transmittance, 0.0)"),
        ),
    ),
    Group(
        "kernels/numba_cpu/backend.py",
        ("tests/test_backends.py",),
        "",
        (),
        (
            Mutant("computed=samples.encoded, widths=widths", "computed=samples.encoded, widths=None"),
            Mutant("spherical_harmonics(directions, grid.view_degree)", "spherical_harmonics(directions, 0)"),
            Mutant("resolutions, sink, computed, widths)", "resolutions, None, computed, widths)"),
            Mutant("computed=None, widths=None, sink=sink", "computed=None, widths=None, sink=None"),
        ),
    ),
    Group(
        "kernels/reference/backend.py",
        ("tests/test_backends.py",),
        "",
        (),
        (
            Mutant("sink.add_(given.grad)", "sink.copy_(given.grad)"),
            Mutant(
                "samples.coordinates, grid.table, grid.resolutions, widths=widths",
                "samples.coordinates, grid.table, grid.resolutions, widths=None",
            ),
            Mutant("spherical_harmonics(directions, grid.view_degree)", "spherical_harmonics(directions, 0)"),
            Mutant('self.deterministic = device.type == "cpu"', "self.deterministic = True"),
        ),
    ),
    Group(
        "kernels/reference/marching.py",
        ("tests/test_numba_kernels.py",),
        "visible and not misses",
        (),
        (
            Mutant("occupied[z, y, x]", "occupied[x, y, z]"),
            Mutant("* ((starts + ends) / 2)[:, None]", "* ends[:, None]"),
            Mutant("before < along.max_optical_depth", "before < 2 * along.max_optical_depth"),
            Mutant("faint &= ~faint.all()", "pass"),
        ),
    ),
    Group(
        "kernels/reference/networks.py",
        ("tests/test_numba_kernels.py",),
        "radiance",
        (),
        (
            Mutant("torch.relu(encoded @ weights[0].t())", "(encoded @ weights[0].t())"),
            Mutant("torch.sigmoid(hidden", "torch.tanh(hidden"),
        ),
    ),
    Group(
        "kernels/reference/pixels.py",
        ("tests/test_numba_kernels.py", "tests/test_selftest.py"),
        "pixel_rays or bound",
        (),
        (
            Mutant("right=True) - 1", "right=False) - 1"),
            Mutant("/ 255.0", "/ 256.0"),
            Mutant("place // width * grid_width", "place // width * width"),
            Mutant("weights[:, 0] == 1", "weights[:, 0] == 2"),
        ),
    ),
    Group(
        "kernels/reference/row_adam.py",
        ("tests/test_numba_kernels.py", "tests/test_selftest.py"),
        "adam or bound",
        (),
        (
            Mutant("(1 - betas[1]) * g * g", "(1 - betas[1]) * g"),
            Mutant("(1 - betas[0] ** number)", "(1 - betas[0])"),
            Mutant("/ (spread + eps)", "/ spread"),
            Mutant("gradient.zero_()", "gradient.abs()"),
            Mutant(".any(-1)", ".all(-1)"),
            Mutant("+ decay * table[touched]", "- decay * table[touched]"),
        ),
    ),
    Group(
        "kernels/activations.py",
        ("tests/test_reference_kernels.py", "tests/test_field.py", "tests/test_selftest.py"),
        "",
        (),
        (
            Mutant("LOG_DENSITY_LIMIT = 15.0", "LOG_DENSITY_LIMIT = 16.0"),
            Mutant("gradients[0] * density", "gradients[0]"),
            Mutant("-torch.expm1(-optical_depth)", "1 - torch.exp(-optical_depth)"),
            Mutant("gradients[0] * torch.exp(-optical_depth)", "gradients[0] * (1 + torch.expm1(-optical_depth))"),
        ),
    ),
    Group(
        "kernels/reference/depth.py",
        ("tests/test_depth_functionals.py", "tests/test_selftest.py"),
        "",
        (),
        (
            Mutant("(1 / 720 - x2 * tail)", "(1 / 702 - x2 * tail)"),
            Mutant("1.0 / y + torch.exp(-y) /", "1.0 / y - torch.exp(-y) /"),
            Mutant("1 / 12, -1 / 240,", "1 / 12, 1 / 240,"),
            Mutant("torch.expm1(-y).square()", "torch.expm1(-y).abs()"),
            Mutant("return starts + lengths * mean_fraction", "return ends - lengths * mean_fraction"),
            Mutant(
                "moment(weights, means, offsets) / torch.where(defined, total, 1.0)", "moment(weights, means, offsets)"
            ),
            Mutant("places = (starts - first) + (inside - further)", "places = starts + inside"),
            Mutant("(inside - further)", "inside"),
            Mutant("+ (middle - middle.detach())", "+ (middle.detach() - middle)"),
            Mutant("interval_variances(density, lengths) + (places", "(places"),
            Mutant("torch.where(wide, variance, 1.0).sqrt()", "torch.where(wide, variance, 1.0)"),
            Mutant("(weights == largest) & (weights > 0)", "weights == largest"),
            Mutant("-math.log1p(-fraction)", "-math.log(fraction)"),
            Mutant("inside = (target - before[crossed]) /", "inside = target /"),
            Mutant("torch.minimum(inside, lengths[crossed])", "inside"),
            Mutant("rays[1:] == rays[:-1]", "rays[1:] >= 0"),
            Mutant("+ inside + (bounded - inside).detach()", "+ bounded.detach()"),
            Mutant("*(77683 / 671480954256752640000,", "*(0.0,"),
            Mutant("(passed(high) <= 1.0 - fraction) & (high > 0)", "high > 0"),
            Mutant("rays_per_pixel).mean(-1)", "rays_per_pixel).sum(-1)"),
            Mutant(
                "torch.where(enough, low, middle), torch.where(enough, middle, high)",
                "torch.where(enough, middle, low), torch.where(enough, high, middle)",
            ),
            Mutant("BISECTIONS = 40", "BISECTIONS = 12"),
            Mutant("total = opacity(sum_along_rays(density * lengths, offsets))", "total = 1.0 - transmittance"),
            Mutant('distances, "amin")', 'distances, "amax")'),
        ),
    ),
    Group(
        "kernels/numba_cpu/compositing.py",
        ("tests/test_numba_kernels.py",),
        "composite or distortion",
        (),
        (
            Mutant("            out[i] = depth\n", "            out[i] = depth + density[i] * lengths[i]\n"),
            Mutant(
                "            weight = np.exp(-depth) * -np.expm1(-own)", "            weight = np.exp(-depth) * own"
            ),
            Mutant("left * background[ray, 1]", "left * background[ray, 0]"),
            Mutant("            depth += own\n        left =", "            depth -= own\n        left ="),
            Mutant("density_gradient[i] * value - behind", "density_gradient[i] * value + behind"),
            Mutant("range(last - 1, first - 1, -1)", "range(last - 1, first, -1)"),
            Mutant(" + transmittance_gradient[ray]", ""),
            Mutant(" + weights_gradient[i]", ""),
            Mutant("rgb_gradient[i, 2] = weight * gb", "rgb_gradient[i, 2] = weight * gg"),
            Mutant("behind += weight * value", "behind += value"),
            Mutant(
                "            weights[i] = np.exp(-depth) * -np.expm1(-own)", "            weights[i] = -np.expm1(-own)"
            ),
            Mutant("2.0 * weight * (middle * mass - moment)", "weight * (middle * mass - moment)"),
            Mutant("weight * weight * length / 3.0", "weight * weight * length / 2.0"),
            Mutant("moment_behind - middle * behind", "moment_behind + middle * behind"),
            Mutant("            behind -= weight\n", "            behind -= 0.0\n"),
        ),
    ),
    Group(
        "kernels/numba_cpu/depth.py",
        ("tests/test_depth_functionals.py",),
        "",
        (),
        (
            Mutant("return 1.0 / x - (1.0 - alpha) / alpha\n", "return 1.0 / x + (1.0 - alpha) / alpha\n"),
            Mutant("(1.0 - alpha) / (alpha * alpha)", "(1.0 - alpha) / alpha"),
            Mutant("step * (weight / sums[ray, MASS])", "step * weight"),
            Mutant("weight = (1.0 - sums[ray, MASS]) * alpha", "weight = alpha"),
            Mutant("step * (place - sums[ray, MEAN])", "step * step"),
            Mutant("if weight > sums[ray, LARGEST]:", "if weight >= sums[ray, LARGEST]:"),
            Mutant("depth + own >= targets[passed]", "depth >= targets[passed]"),
            Mutant("(targets[passed] - depth) / density", "targets[passed] / density"),
            Mutant("sums[ray, DEPTH] = depth + own", "sums[ray, DEPTH] = own"),
            Mutant("opacity=-torch.expm1(-depth).float()", "opacity=1.0 - torch.exp(-depth).float()"),
            Mutant("torch.from_numpy(quantiles[:, back])", "torch.from_numpy(quantiles)"),
            Mutant("min(t, np.float64(ends[i])) - start", "np.float64(ends[i]) - start"),
            Mutant("return total / count", "return total"),
        ),
    ),
    Group(
        "kernels/numba_cpu/hash_grid.py",
        ("tests/test_numba_kernels.py",),
        "hash_encode",
        (),
        (
            Mutant("if side * side * side <= rows:", "if side * side * side < rows:"),
            Mutant("range(thread, resolutions.shape[0], threads)", "range(0, resolutions.shape[0], threads)"),
            Mutant("column = level * FEATURES", "column = 0"),
            Mutant("if a != 0 or b != 0 or c != 0 or d != 0:", "if a != 0 or b != 0 or c != 0:"),
            Mutant("of_table if ctx.sink is None else None", "of_table"),
            Mutant("weight[corner * BLOCK + i] /= max", "weight[corner * BLOCK + i] *= max"),
            Mutant("scale = side / max(side", "scale = side * max(side"),
            Mutant("low += a * (dots", "low -= a * (dots"),
            Mutant("(one - b) * low + b * high", "b * low + (one - b) * high"),
            Mutant("at >= np.float32(0) and at <= one", "at > np.float32(0) and at < one"),
        ),
    ),
    Group(
        "kernels/numba_cpu/corners.py",
        ("tests/test_numba_kernels.py",),
        "hash_encode",
        ("kernels/numba_cpu/hash_grid.py",),
        (
            Mutant('builder.select(builder.icmp_signed("<", whole, last), whole, last)', "whole"),
            Mutant("805459861)", "805459863)"),
            Mutant("builder.and_(builder.xor(x[corner & 1], yz[corner >> 1]), mask)", "x[corner & 1]"),
            Mutant("z = [first, builder.add(first, layer)]", "z = [first, builder.add(first, line)]"),
            Mutant("[builder.fsub(floats(1.0), place), place]", "[place, builder.fsub(floats(1.0), place)]"),
            Mutant("xy[corner & 3], z[corner >> 2]", "xy[corner >> 1], z[corner & 1]"),
            Mutant(
                'builder.fcmp_ordered(">", along, one), one, along',
                'builder.fcmp_ordered(">", along, one), zero, along',
            ),
        ),
    ),
    Group(
        "kernels/numba_cpu/networks.py",
        ("tests/test_numba_kernels.py",),
        "radiance",
        (),
        (
            Mutant("if h[i] <= np.float32(0) else", "if h[i] < np.float32(0) else"),
            Mutant("exponential(min(max(density[i], -LIMIT), LIMIT))", "exponential(density[i])"),
            Mutant("density_gradient[first + i] * own[i]", "density_gradient[first + i]"),
            Mutant("sigmoid_slope(channels[i])", "sigmoid(channels[i])"),
            Mutant("_layer_32(g, back, C2, g2)", "_layer_32(g, back, C1, g2)"),
            Mutant("out[i * WIDTH + OUT + j] = harmonics[ray, j]", "out[i * WIDTH + OUT + j] = harmonics[0, j]"),
            Mutant("_weights_32(c0, g2, total, C1)", "_weights_32(h2, g2, total, C1)"),
            Mutant(
                "view_gradient[first + i, j] = g[i * WIDTH + OUT + j]", "view_gradient[i, j] = g[i * WIDTH + OUT + j]"
            ),
        ),
    ),
    Group(
        "kernels/numba_cpu/coordinates.py",
        ("tests/test_numba_kernels.py",),
        "sample_coordinates",
        (),
        (
            Mutant("if norm <= one:", "if norm <= two:"),
            Mutant("two * inverse * (inverse - one)", "two * inverse * (inverse + one)"),
            Mutant("by_direction[ray, 1] += b * t", "by_direction[ray, 1] += b"),
            Mutant("if contraction == 2:", "if contraction == 3:"),
        ),
    ),
    Group(
        "kernels/numba_cpu/rays.py",
        ("tests/test_numba_kernels.py",),
        "visible or ray_indices",
        ("kernels/numba_cpu/visible.py", "kernels/numba_cpu/marching.py"),
        (
            Mutant("return edges[k] + shift * (edges[k + 1] - edges[k])", "return edges[k]"),
            Mutant("] = ray\n", "] = ray + 1\n"),
        ),
    ),
    Group(
        "kernels/numba_cpu/steps.py",
        ("tests/test_numba_kernels.py",),
        "visible",
        ("kernels/numba_cpu/visible.py", "kernels/numba_cpu/marching.py"),
        (
            Mutant("builder.fsub(floats(2.0), builder", "builder.fadd(floats(2.0), builder"),
            Mutant("builder.select(inside, cell, ints(-1))", "cell"),
            Mutant("_larger(builder, square, floats(1.0))", "square"),
            Mutant("_larger(builder, x, y), _larger", "_smaller(builder, x, y), _larger"),
            Mutant("builder.fmul(jitter, builder.fsub(high, low))", "builder.fsub(high, low)"),
            Mutant("builder.fmul(builder.fadd(start, end), floats(0.5))", "start"),
        ),
    ),
    Group(
        "kernels/numba_cpu/tracing.py",
        ("tests/test_backends.py",),
        "",
        (),
        (
            Mutant("unseen[ray] + weight <= negligible", "weight <= negligible"),
            Mutant(
                "weight <= PART * negligible", "weight <= negligible", "the bound holds: only other samples go without"
            ),
            Mutant("colours[ray[i], channel] += weight[i] *", "colours[ray[i], channel] +="),
            Mutant("waiting_ray[waiting], waiting_weight[waiting] = ray, weight", "waiting_ray[waiting] = ray"),
            Mutant("harmonics[ray, j]", "harmonics[0, j]"),
            Mutant("UNSEEN * unseen[:, None]", "unseen[:, None]"),
            Mutant("UNSEEN * torch.from_numpy(unseen)", "0.0 * torch.from_numpy(unseen)"),
            Mutant("torch.where(stopped, left * behind, 0.0)", "torch.where(stopped, left, 0.0)"),
            Mutant("            place[ray] += 1\n", "            place[ray] += 0\n"),
        ),
    ),
    Group(
        "kernels/numba_cpu/visible.py",
        ("tests/test_numba_kernels.py",),
        "visible",
        (),
        (
            Mutant("(4.0 if contraction == 0 else 7.8)", "(40.0 if contraction == 0 else 78.0)"),
            Mutant("if not before < deepest:", "if not before < 2 * deepest:"),
            Mutant("own < least or own * np.exp(-before) < least", "own < least"),
            Mutant("own < least or own * np.exp(-before) < least", "own < least or np.exp(-before) < least"),
            Mutant("near[max(z - 1, 0) : z + 2, ", "near[z : z + 1, "),
            Mutant("past = i + 1", "past = i"),
            Mutant("cones[ray] * t * _stretch", "cones[ray] * _stretch"),
            Mutant("return (two - one / norm) / norm * quarter", "return (two - one / norm) * quarter"),
            Mutant("            place[ray] += 1\n", "            place[ray] += 0\n"),
        ),
    ),
    Group(
        "kernels/numba_cpu/row_adam.py",
        ("tests/test_numba_kernels.py",),
        "adam",
        (),
        (
            Mutant("builder.fmul(builder.fmul(builder.fsub(one, beta2), g), g)", "builder.fmul(g, g)"),
            Mutant('builder.fmul(of_each(builder, "llvm.sqrt", v), correction)', 'of_each(builder, "llvm.sqrt", v)'),
            Mutant("for distance in (1, 2):", "for distance in (1,):"),
            Mutant("builder.store(floats(0.0), gradient_at", "builder.store(g, gradient_at"),
            Mutant("builder.fsub(table, builder.fdiv", "builder.fadd(table, builder.fdiv"),
            Mutant("builder.fadd(gradient, builder.fmul(decay, table))", "gradient"),
            Mutant("builder.select(rows, new, old)", "new"),
            Mutant("whole[-rest:] = part[:rest]", "pass"),
        ),
    ),
    Group(
        "kernels/numba_cpu/pixels.py",
        ("tests/test_numba_kernels.py",),
        "pixel_rays",
        (),
        (
            Mutant('side="right") - 1', 'side="left") - 1'),
            Mutant("np.float32(255)", "np.float32(256)"),
            Mutant("row[2] * z", "row[2] * y"),
            Mutant("if weight[0] == np.float32(1):", "if False:"),
            Mutant("(corner >> 1) * below", "(corner >> 1) * width"),
            Mutant("return x * scale, y * scale, z * scale", "return x, y, z"),
        ),
    ),
    Group(
        "kernels/numba_cpu/exponential.py",
        ("tests/test_numba_kernels.py",),
        "exponential",
        (),
        (
            Mutant("5.0000001201e-1", "4.99e-1"),
            Mutant("x = min(max(x, np.float32(-87)), np.float32(88))", "x = min(x, np.float32(88))"),
            Mutant(
                "return tail / ((np.float32(1) + tail) * (np.float32(1) + tail))",
                "return tail / (np.float32(1) + tail)",
            ),
            Mutant("exponential(-abs(x))\n    return (np", "exponential(-x)\n    return (np"),
        ),
    ),
    Group(
        "kernels/numba_cpu/vector.py",
        ("tests/test_numba_kernels.py",),
        "radiance",
        ("kernels/numba_cpu/networks.py",),
        (
            Mutant(
                'builder.fcmp_ordered("<=", total, zero), zero, total)',
                'builder.fcmp_ordered("<=", total, zero), total, total)',
            ),
            Mutant(
                "\nproduct_32 = _block_product(ROWS_32, 2, begin=_zero, finish=_as_it_is)",
                "\nproduct_32 = _block_product(ROWS_32, 1, begin=_zero, finish=_as_it_is)",
            ),
        ),
    ),
    Group(
        "render/model.py",
        ("tests/test_sampling.py",),
        "",
        (),
        (Mutant("distance * max(1.0, distance)", "distance"),),
    ),
    Group(
        "kernels/harmonics.py",
        ("tests/test_field.py",),
        "",
        (),
        (
            Mutant("(3 * zz - 1)", "(3 * zz + 1)"),
            Mutant("math.sqrt(105 / (4 * math.pi))", "math.sqrt(104 / (4 * math.pi))"),
            Mutant(
                "math.sqrt(7 / (16 * math.pi)) * z * (5 * zz - 3)", "math.sqrt(7 / (16 * math.pi)) * z * (5 * zz - 2)"
            ),
        ),
    ),
    Group(
        "field/fourier_field.py",
        ("tests/test_field.py",),
        "",
        (),
        (
            Mutant("frequencies = math.pi *", "frequencies ="),
            Mutant("[phases.sin(), phases.cos()]", "[phases.cos(), phases.sin()]"),
        ),
    ),
    Group(
        "kernels/contraction.py",
        ("tests/test_field.py", "tests/test_reference_kernels.py"),
        "contract or cube or coordinates",
        (),
        (
            Mutant("return (2.0 - shrink / norm) *", "return (2.0 + shrink / norm) *"),
            Mutant(".maximum(shrink.square()).sqrt()", ".sqrt()"),
            Mutant("limit**-0.5 / 4, 1.0", "1.0, 1.0"),
            Mutant("contract(points) / 4.0 + 0.5", "contract(points) / 2.0 + 0.5"),
            Mutant("contract_to_cube(points) / 4.0 + 0.5", "contract_to_cube(points) / 4.0 + 0.4"),
            Mutant("return points / 2.0 + 0.5", "return points / 2.0 - 0.5"),
            Mutant("keepdim=True).clamp_min(1.0)", "keepdim=True)"),
            Mutant("largest = points.abs().amax(-1", "largest = points.amax(-1"),
            Mutant("(2.0 - 1.0 / largest)", "(2.0 - largest)"),
        ),
    ),
    Group(
        "kernels/contraction.py",
        ("tests/test_reference_kernels.py", "tests/test_numba_kernels.py", "tests/test_field.py"),
        "width or visible",
        (),
        (
            Mutant("return widths / 2.0\n", "return widths / 4.0\n"),
            Mutant("points.norm(dim=-1) if", "points.square().sum(-1) if"),
            Mutant("norm = norm.clamp_min(1.0)", "norm = norm.clamp_min(2.0)"),
            Mutant("(2.0 - 1.0 / norm) / norm / 4.0", "(2.0 - 1.0 / norm) / 4.0"),
            Mutant("rays.cones[index] * middles", "rays.cones[index]"),
            Mutant("middles = (starts + ends) / 2\n", "middles = starts\n"),
        ),
    ),
    Group(
        "kernels/numba_cpu/marching.py",
        ("tests/test_field_kinds.py",),
        "compiled_marching",
        (),
        (
            Mutant("                    count += 1\n", "                    count += 2\n"),
            Mutant("        at = offsets[ray]\n", "        at = offsets[0]\n"),
            Mutant("cut(edges, jitter[ray], first + i)", "cut(edges, jitter[ray], first)"),
            Mutant("first + i + 1)", "first + i)"),
            Mutant("= places[axis * CHUNK + i]", "= places[i]"),
            Mutant(
                "edges.shape[0] - 2 - CHUNK\n    for ray in numba.prange(origins.shape[0]):\n        places, cells = "
                "np.empty(3 * CHUNK, np.float32), np.empty(CHUNK, np.int32)\n        count",
                "edges.shape[0] - 3 - CHUNK\n    for ray in numba.prange(origins.shape[0]):\n        places, cells = "
                "np.empty(3 * CHUNK, np.float32), np.empty(CHUNK, np.int32)\n        count",
            ),
        ),
    ),
    Group(
        "render/occupancy.py",
        ("tests/test_occupancy.py",),
        "",
        (),
        (
            Mutant("DECAY = 0.8", "DECAY = 1.0"),
            Mutant("return ~(self.optical_depth <= self", "return (self.optical_depth > self"),
            Mutant("self.optical_depth.nanmean().clamp_max(optical_depth)", "optical_depth"),
            Mutant(".nanmean().clamp_max", ".mean().clamp_max"),
            Mutant(
                "numbers % side, numbers // side % side, numbers // side**2",
                "numbers // side**2, numbers // side % side, numbers % side",
            ),
            Mutant("(place + inside) / side", "place / side"),
            Mutant("radius * radius.clamp_min(1.0)", "radius"),
            Mutant(".clamp_min(shortest_step)  #", "  #"),
            Mutant("chosen.isinf(), 0.0, chosen * DECAY", "chosen.isinf(), chosen, chosen * DECAY"),
            Mutant("chosen * DECAY), density * step))", "chosen * DECAY), density))"),
            Mutant("torch.maximum(torch", "torch.minimum(torch"),
            Mutant('self.optical_depth = tensors["optical_depth"]', 'tensors["optical_depth"]'),
        ),
    ),
    Group(
        "field/contraction.py",
        ("tests/test_reference_kernels.py", "tests/test_field.py", "tests/test_selftest.py"),
        "",
        (),
        (
            Mutant("1.0 / (2.0 - norm)", "1.0 / (2.0 + norm)"),
            Mutant("(2.0 - norm).clamp_min(1.0 / LARGEST_RADIUS)", "(2.0 - norm)"),
            Mutant("(2.0 - largest).clamp_min(1.0 / LARGEST_RADIUS)", "(2.0 - largest)"),
            Mutant("clamp_min(1.0).sqrt()", "sqrt()"),
            Mutant("keepdim=True).clamp_min(1.0)\n", "keepdim=True)\n"),
            Mutant("(coordinates - 0.5) * 2.0", "(coordinates - 0.5) * 4.0 / 2.5"),
            Mutant("(coordinates - 0.5) * 4.0", "(coordinates - 0.5) * 2.0"),
        ),
    ),
    Group(
        "cameras/distortion.py",
        (
            "tests/test_lens_domain.py",
            "tests/test_lens_jacobians.py",
            "tests/test_lens_projections.py",
            "tests/test_camera.py",
        ),
        "",
        (),
        (
            Mutant("moved += 2 * (p @ plane) * plane", "moved += (p @ plane) * plane"),
            Mutant("moved += square * np.array(self.prism)", "moved -= square * np.array(self.prism)"),
            Mutant("bend = 2 * self._factor_slope", "bend = self._factor_slope"),
            Mutant("diagonal + bend * y * y", "diagonal + bend * x * x"),
            Mutant("-plane * factor * square**i", "plane * factor * square**i"),
            Mutant("6 * _size(distortion.tangential)", "0 * _size(distortion.tangential)"),
            Mutant("real.min(initial=np.inf)", "real.max(initial=0.0)"),
            Mutant("~(goals >= heights[-1])", "goals >= 0"),
            Mutant("close & (_radius(plane) < self.reach)", "close"),
            Mutant("(slope - self._factor(square) * bottom_slope)", "(slope + self._factor(square) * bottom_slope)"),
        ),
    ),
    Group(
        "cameras/rigid.py",
        ("tests/test_rigid.py",),
        "",
        (),
        (
            Mutant("2 * np.arctan2(sine,", "np.arctan2(sine,"),
            Mutant("(6, -120, 5040,", "(6, 120, 5040,"),
            Mutant("u + b * turned + c *", "u - b * turned + c *"),
            Mutant("np.sinc(half / np.pi) * vector / 2", "np.sinc(half / np.pi) * vector"),
            Mutant("np.cross(forward, right), forward]", "np.cross(right, forward), forward]"),
        ),
    ),
    Group(
        "render/visibility.py",
        ("tests/test_visibility.py",),
        "",
        (),
        (
            Mutant("np.floor(pixels[rows] + 0.5)", "np.floor(pixels[rows] + 1.5)"),
            Mutant("(0, 1, stride, stride + 1)", "(0,)"),
            Mutant("top * stride + left", "top * camera.width + left"),
            Mutant("<= SAME * distance", "<= 0.1 * distance"),
            Mutant("np.abs(bordered[corner + offset] - distance)", "(distance - bordered[corner + offset])"),
            Mutant("valid & (pixels >= 0).all(1)", "valid"),
            Mutant("(pixels <= (camera.width, camera.height)).all(1)", "True"),
            Mutant("cosines < np.cos", "cosines < 0 * np.cos"),
            Mutant("seen.sum(axis=1) > 1", "seen.sum(axis=1) > 2"),
            Mutant(
                "np.where(here, np.arange(len(used)), here.argmax(axis=1)[:, None])", "np.arange(len(used)) + 0 * here"
            ),
            Mutant(".amin((1, 2))", ".amin(1)[:, 0]"),
            Mutant("np.isfinite(points).all(axis=1)", "np.isfinite(points).any(axis=1)"),
        ),
    ),
    Group(
        "export/one_frame.py",
        ("tests/test_visibility.py",),
        "render",
        (),
        (
            Mutant("(picture.coverage >= request.min_views) & ", ""),
            Mutant(" & (picture.parallax >= request.min_parallax_deg)", ""),
            Mutant("had & ~seen", "~seen"),
        ),
    ),
    Group(
        "surface/next_views.py",
        ("tests/test_next_views.py",),
        "not doctor",
        (),
        (
            Mutant("np.radians(angle_deg) * across", "angle_deg * across"),
            Mutant("np.cross(offset, up)", "np.cross(up, offset) * 0 + up"),
            Mutant("min((_near(photo)", "max((10 * _near(photo)"),
            Mutant("coverage < ENOUGH]", "coverage < 1]"),
            Mutant("coverage += seen[:, best]", "coverage += 0"),
            Mutant("np.argmax(gains)", "np.argmin(gains)"),
            Mutant("if not gains[best]:", "if False:"),
            Mutant("gains[[index for index, _ in chosen]] = 0", "pass"),
            Mutant("(points < grid.high)", "(points < grid.high - 0.3)"),
        ),
    ),
    Group(
        "render/depth_errors.py",
        ("tests/test_depth_errors.py",),
        "",
        (),
        (
            Mutant("counts[-1] >= LEAST_PIXELS and ", ""),
            Mutant("len(np.unique(photos[inside])) >= LEAST_PHOTOS", "True"),
            Mutant("np.where(number >= 0, 1.0 + of_strata[number], np.nan)", "1.0 + of_strata[number]"),
            Mutant('side="right"', 'side="left"'),
            Mutant("((1 - level) / 2, (1 + level) / 2)", "(1 - level, level)"),
            Mutant("(-tolerance, tolerance)", "(0.0, tolerance)"),
            Mutant("np.where(number >= 0, of_strata[number], np.nan)", "of_strata[number]"),
        ),
    ),
    Group(
        "viewer/coverage.py",
        ("tests/test_page.py",),
        "cells_hold",
        (),
        (
            Mutant("(z * side + y) * side + x", "(x * side + y) * side + z"),
            Mutant("photos, points[first])", "photos, points[: len(first)])"),
            Mutant("256 * np.rint(parallax)", "256 * np.rint(parallax / 2)"),
            Mutant("model.training_from_scene.apply(points)", "points"),
        ),
    ),
    Group(
        "evaluate/depth_errors.py",
        ("tests/test_depth_errors.py",),
        "",
        (),
        (
            Mutant("found.distances[chosen] / median - 1.0", "1.0 - found.distances[chosen] / median"),
            Mutant("photos[len(train) :], measured[len(train) :]", "photos[len(train) :], measured"),
            Mutant("bearings(pixels + 0.5)", "bearings(pixels * 0.0)"),
            Mutant("rays = points[own] - view.frame.centre", "rays = points[own]"),
        ),
    ),
)
