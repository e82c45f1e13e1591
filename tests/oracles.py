"""Slow, obviously correct float64 answers for the tests to compare with."""

import math

import numpy as np


def march_through_slabs(density, lengths, rgb, background):
    """Return weights, final transmittance and colour of one ray, by a double loop."""
    weights = []
    for i in range(len(density)):
        before = math.exp(-sum(density[j] * lengths[j] for j in range(i)))
        weights.append(before * -math.expm1(-density[i] * lengths[i]))
    transmittance = math.exp(-sum(d * length for d, length in zip(density, lengths, strict=True)))
    colour = np.asarray(background, dtype=np.float64) * transmittance
    for weight, value in zip(weights, rgb, strict=True):
        colour = colour + weight * np.asarray(value, dtype=np.float64)
    return np.array(weights), transmittance, colour


def quadrature_of_end_density(density, starts, ends, steps=20000):
    """Return the integrals of p(t), t p(t) and t^2 p(t), p = T sigma, for a piecewise constant density, by the midpoint
    rule."""
    moments, depth = np.zeros(3), 0.0
    for s, t0, t1 in zip(density, starts, ends, strict=True):
        h = (t1 - t0) / steps
        t = t0 + (np.arange(steps) + 0.5) * h
        p = s * np.exp(-(depth + s * (t - t0)))
        moments += np.stack([p, t * p, t * t * p]).sum(1) * h
        depth += s * (t1 - t0)
    return moments
