"""Ablation: train a model with and without each component and compare on held-out photos."""
