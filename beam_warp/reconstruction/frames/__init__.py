"""The steps of a reconstruction job: plan the frames, read their images, model them, store them, report."""
