"""Photos and videos as files: pixels, EXIF, masks, panoramas; and photos loaded for training."""
