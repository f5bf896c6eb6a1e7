"""The rasteriser: projection, tiles, compositing, their adjoints, and losses on images."""
