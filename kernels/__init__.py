"""The device side: Warp kernels and functions, one compile unit a file; imports nothing else of the package."""
