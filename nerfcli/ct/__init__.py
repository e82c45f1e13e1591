"""Transmission tomography: scans measured by I = I0 exp(-line integral), and volumes fitted to them."""
