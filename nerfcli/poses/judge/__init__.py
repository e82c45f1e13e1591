"""Whether a model of structure from motion may be believed, and how sharp its poses are."""
