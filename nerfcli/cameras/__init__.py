"""Camera geometry in NumPy float64: rigid transforms, lens models and camera paths; no torch."""
