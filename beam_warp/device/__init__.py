"""Warp devices: choosing one, moving arrays there, graphs of steps, and spatial order."""
