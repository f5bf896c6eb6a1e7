"""Environments and lights made ready on a device: sampling, prefiltering, regions and the GGX lobe."""
