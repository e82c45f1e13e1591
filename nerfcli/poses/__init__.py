"""Structure from motion with pycolmap, in a separate process.

`structure_from_motion` is the entrance. `input` holds what it starts from: photos, masks, pairs, and the job of the
worker, a child process. `engine` supervises that process, finds features and maps; `model` knows lenses, pairs and
further photos; `judge` says whether a model may be believed.
"""
