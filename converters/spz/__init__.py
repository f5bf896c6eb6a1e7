"""SPZ in and out: versions 1 to 4, plain, in streams, and within glTF."""
