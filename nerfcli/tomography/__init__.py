"""Transmission tomography: scans measured by I = I0 exp(-line integral of the attenuation), and volumes fitted to them."""
