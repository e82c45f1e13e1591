"""Structure from motion with pycolmap, in a separate process.

`structure_from_motion` is the entry point. `input` prepares photos, masks, pairs and the job of the worker, a child
process. `engine` supervises that process, extracts features and maps; `model` handles lenses, pairs, sub-models and
further photos; `judge` decides whether a model can be accepted.
"""
