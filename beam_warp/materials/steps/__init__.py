"""Steps of the main job, and the records that go from one to the next."""
