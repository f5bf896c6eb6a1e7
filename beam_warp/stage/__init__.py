"""What is rendered over time: assets, meshes, lights and cameras on a stage, and where frames go."""
