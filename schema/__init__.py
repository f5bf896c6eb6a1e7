"""The written contract of an asset on disk, and what reads, writes and validates it."""
