"""The mutants of `mutants.py` in the GPU kernels, which Triton's interpreter runs."""

from mutant_list import Group, Mutant

KERNELS = ("tests/triton_kernels.py",)

TRITON: tuple[Group, ...] = (
    Group(
        "kernels/triton_cuda/compositing.py",
        KERNELS,
        "composite or distortion or digits or contracted",
        (),
        (
            Mutant("gained = _worth(rgb, by_weight, i + 1,", "gained = _worth(rgb, by_weight, i,"),
            Mutant("        behind += tl.sum(gained, 1)\n", ""),
            Mutant("    behind *= tl.load(transmittance", "    behind += tl.load(transmittance"),
            Mutant("return tl.where(x < 0.5, series, 1.0 - tl.exp(-x))", "return 1.0 - tl.exp(-x)"),
            Mutant("(2.0 * distances + weight * length / 3.0)", "(2.0 * distances + weight * length)"),
            Mutant("        mass += tl.sum(behind, 1)\n", ""),
            Mutant("tl.where(end <= 1.0, end, 2.0 - 1.0 /", "tl.where(end <= 1.0, end, 2.0 - 1.1 /"),
        ),
    ),
    Group(
        "kernels/triton_cuda/coordinates.py",
        KERNELS,
        "sample_coordinates",
        (),
        (
            Mutant("along = 2.0 * inverse * (inverse - 1.0)", "along = inverse * (inverse - 1.0)"),
            Mutant("third = (tl.abs(z) >= norm)", "third = (tl.abs(y) >= norm)"),
            Mutant("bz += tl.sum(c * t, 1)", "bz += tl.sum(c, 1)"),
        ),
    ),
    Group(
        "kernels/triton_cuda/depth.py",
        KERNELS,
        "light_ends or far_thin",
        (),
        (
            Mutant("V0 + x2 *", "V0 - x2 *"),
            Mutant("place = (at - start[:, None]) +", "place = at +"),
            Mutant("tl.minimum(tl.maximum(within, 0.0), span)", "within", "rounding alone leads out of the interval"),
            Mutant("tl.where(peak > most, first", "tl.where(peak < most, first"),
            Mutant("place < found, chosen", "place <= found, chosen", "both are equal only where nothing is crossed"),
        ),
    ),
    Group(
        "kernels/triton_cuda/harmonics.py",
        KERNELS,
        "networks",
        (),
        (
            Mutant("column == 8, -1.0925484305920792 * y, dy", "column == 8, 1.0925484305920792 * y, dy"),
            Mutant("0.3731763325901154 * z * (5.0", "0.3731763325901154 * z * (3.0"),
        ),
    ),
    Group(
        "kernels/triton_cuda/hash_grid.py",
        KERNELS,
        "hash_encode",
        (),
        (
            Mutant("805459861", "805459863"),
            Mutant("whole * whole * whole <= rows", "whole * whole * whole < rows"),
            Mutant("(at < 0.0) | (at > 1.0), 0.0, slope", "at < 0.0, 0.0, slope"),
            Mutant("by_y += dot * x * z", "by_y += dot * y * z"),
        ),
    ),
    Group(
        "kernels/triton_cuda/marching.py",
        KERNELS,
        "visible or occupied or faint or visits",
        (),
        (
            Mutant("if candidates <= room:", "if True:"),
            Mutant("fits = kept & (place < room)", "fits = kept"),
            Mutant("valid & (before < deepest)", "valid & (before <= 2.0 * deepest)"),
            Mutant("own * tl.exp(-before) < least", "own < least"),
            Mutant("            least = 0.0  # all", "            break  # all"),
            Mutant("mask=reached & (own == own)", "mask=reached & (own >= least)"),
            Mutant("mask=reached & (own == own)", "mask=reached"),
            Mutant("middle + shift * (far - middle)", "middle + shift * (middle - near)"),
        ),
    ),
    Group(
        "kernels/triton_cuda/networks.py",
        KERNELS,
        "networks or densities",
        (),
        (
            Mutant("tl.where(h2 > 0, tl.dot(d, tl.trans(fourth)), 0.0)", "tl.dot(d, tl.trans(fourth))"),
            Mutant("slope = a / ((1.0 + a) * (1.0 + a))", "slope = a / (1.0 + a)"),
            Mutant("scale = LARGEST / tl.maximum(tl.load(largest), LEAST)", "scale = 1.0 + tl.load(largest) * 0.0"),
            Mutant("tl.clamp(first, -LIMIT, LIMIT, propagate_nan=tl.PropagateNan.ALL)", "first"),
        ),
    ),
    Group(
        "kernels/triton_cuda/row_adam.py",
        KERNELS,
        "adam or half_copy",
        (),
        (
            Mutant("    tl.store(half + at, value.to(tl.float16), mask=touched)\n", ""),
            Mutant("tl.zeros([BLOCK, 4], tl.float32), mask=touched", "g, mask=touched"),
            Mutant("tl.max(tl.where(g == 0.0, 0, 1), 1) > 0", "tl.min(tl.where(g == 0.0, 0, 1), 1) > 0"),
            Mutant("g += decay * value", "g += value"),
        ),
    ),
)
