"""Flawed captures: copies of a clean capture with the faults of a studio, each by a known amount.

`write_flawed` writes such a copy; what it did to every camera is returned and is not in the copy. The optics blur
(`optics`), a matte is cut (`mattes`), a sensor counts photons (`sensor`), and a calibration errs (`rig`).
"""
