"""Scans of the phantom, computed from its closed-form chords without any projector of the program."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from ellipsoids import Ellipsoid, bean, line_integrals

from nerfcli.ct.geometry import Beam, Circle, ScanGeometry
from nerfcli.ct.scan import Scan, held_out_views


def phantom_circle(*, beam: Beam = "cone", views: int = 24, span_deg: float = 360.0, columns: int = 40) -> Circle:
    """Return a circle around the phantom of `bean`, about 20 wide, with a fan of 40 degrees for a cone beam."""
    angles = np.radians(span_deg / views * np.arange(views))
    side = 24 / columns * (2.0 if beam == "cone" else 1.0)
    return Circle(
        beam,
        tuple(angles.tolist()),
        *(side, side, 1, columns),
        source_origin=34.0 if beam == "cone" else 0.0,
        source_detector=68.0 if beam == "cone" else 0.0,
    )


def transmissions(geometry: ScanGeometry, *, rows: int, columns: int) -> np.ndarray:
    """Return the transmissions (V, H, W) of the bean, each a mean over rows x columns rays through its pixel."""
    fine = replace(
        geometry,
        column_step=geometry.column_step / columns,
        row_step=geometry.row_step / rows,
        rows=geometry.rows * rows,
        columns=geometry.columns * columns,
    )
    passed = np.exp(-line_integrals(bean(), *fine.rays()))
    return passed.reshape(geometry.views, geometry.rows, rows, geometry.columns, columns).mean((2, 4))


def scan_of_phantom(
    circle: Circle, *, stated: Circle | None = None, photons: float | None = None, phantom: Sequence[Ellipsoid] = ()
) -> Scan:
    """Return a scan of the phantom: line integrals, or transmissions with counting noise if `photons` is given.

    Args:
        circle: the true geometry.
        stated: the geometry that the scan states; None for the true one.
        photons: mean count of an unobstructed pixel.
        phantom: instead of `bean`.
    """
    integrals = line_integrals(phantom or bean(), *circle.geometry().rays())
    held_out = held_out_views(len(circle.angles))
    geometry = (stated or circle).geometry()
    if photons is None:
        return Scan(geometry, "line_integral", integrals.astype(np.float32), held_out=held_out)
    counts = np.random.default_rng(0).poisson(photons * np.exp(-integrals))
    values = (counts / photons).astype(np.float32)
    return Scan(geometry, "transmission", values, photons_per_value=photons, held_out=held_out)
