"""Camera geometry in NumPy float64: rigid transforms, lens models, capture formats and camera paths; no torch."""
