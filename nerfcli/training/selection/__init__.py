"""Automatic selection of components: paired short trainings and their evaluation."""
