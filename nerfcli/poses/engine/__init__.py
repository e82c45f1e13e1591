"""The worker process that runs pycolmap (features, matches, mapping attempts), and its supervision."""
