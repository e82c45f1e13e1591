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
    """Return the integrals of p(t) and t p(t), p = T sigma, for a piecewise constant density, by the midpoint rule."""
    mass, first = 0.0, 0.0
    depth = 0.0
    for s, t0, t1 in zip(density, starts, ends, strict=True):
        h = (t1 - t0) / steps
        t = t0 + (np.arange(steps) + 0.5) * h
        p = s * np.exp(-(depth + s * (t - t0)))
        mass += p.sum() * h
        first += (t * p).sum() * h
        depth += s * (t1 - t0)
    return mass, first


def quadrature_of_squares(density, starts, ends, steps=20000):
    """Return the integral of t^2 p(t), as in `quadrature_of_end_density`."""
    second, depth = 0.0, 0.0
    for s, t0, t1 in zip(density, starts, ends, strict=True):
        h = (t1 - t0) / steps
        t = t0 + (np.arange(steps) + 0.5) * h
        second += (t * t * s * np.exp(-(depth + s * (t - t0)))).sum() * h
        depth += s * (t1 - t0)
    return second
