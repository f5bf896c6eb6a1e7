"""SOG in and out: a palette-coded splat in WebP images."""
