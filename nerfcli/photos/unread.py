"""Pictures that are not read, by the suffix of their file, and why."""

_FLOAT = "has float pixels, whose white level is unknown: save it with 8 or 16 bits per channel"
_RAW = "is a raw file: develop it to JPEG or 16-bit TIFF"
_LAYERS = "is a picture of several layers: export it as JPEG or 16-bit TIFF"
_PAIR = "holds the two pictures of a stereo camera: save each as a JPEG"
_OTHER = "is a picture in a format that is not read: convert it to JPEG or PNG"
# Not .raw, .ptx and .cap, which are raw photos of few cameras, but dumps of depths, scans and recordings beside photos.
UNREAD = {
    **dict.fromkeys((".dng", ".cr2", ".cr3", ".crw", ".nef", ".nrw", ".arw", ".srf", ".sr2", ".raf", ".orf"), _RAW),
    **dict.fromkeys((".rw2", ".pef", ".srw", ".x3f", ".3fr", ".iiq", ".rwl", ".gpr", ".fff", ".mos"), _RAW),
    **dict.fromkeys((".kdc", ".dcr", ".k25", ".erf", ".mef", ".mrw"), _RAW),
    **dict.fromkeys((".exr", ".hdr", ".pfm"), _FLOAT),
    **dict.fromkeys((".psd", ".psb", ".xcf"), _LAYERS),
    **dict.fromkeys((".jps", ".pns"), _PAIR),
    **dict.fromkeys((".apng", ".dds", ".dib", ".heics", ".heifs", ".pcx", ".qoi", ".sgi"), _OTHER),
    ".jxl": "is a JPEG XL file: convert it to JPEG",
    ".insp": "holds the two circles of a 360-degree camera: export it as one equirectangular picture",
}
