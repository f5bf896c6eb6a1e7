"""Stress captures: captures on which reconstructions fail, and what must be detected in each.

A case that takes images away or changes their values writes nothing: its records read the given capture's files and
change them in memory. A case that shows another subject is path traced once, when it is asked for. One that looks as a
studio delivers it is a flawed copy, which `beam_warp.stability.flaws` writes.
"""

from beam_warp.stability.capture_cases import cameras, delivered, subjects, surfaces

SURFACE_CASES = [surfaces.no_shading, surfaces.mirror_like, surfaces.thin_staff, surfaces.hair, surfaces.close_layers]
"""Cases of surfaces that images say little about."""

CAPTURE_CASES = [
    subjects.as_it_is,
    subjects.every_second_frame,
    subjects.every_third_frame,
    subjects.no_texture,
    subjects.self_contact,
    *SURFACE_CASES,
    cameras.black_camera,
    cameras.empty_camera,
    cameras.camera_without_files,
    cameras.camera_that_stops,
    cameras.wrong_exposure,
    cameras.slightly_wrong_exposure,
    cameras.four_cameras,
    cameras.eight_cameras,
    subjects.object_appears,
    delivered.as_delivered,
    delivered.masks_off,
    delivered.poses_off,
]
"""Every case, in the order of the table; the first is the capture as it is."""

TRACED_CASES = [subjects.no_texture, subjects.self_contact, *SURFACE_CASES, subjects.object_appears]
"""Cases that show another subject than a given capture, and are path traced."""
